"""The orbits along a branch, in the plane or in the space of their components."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.model.labels import labels_of
from jaxfil.orbits.branch import Branch
from jaxfil.plot.canvas import color_bar, name_components, own_axes
from jaxfil.plot.path import chosen, path
from jaxfil.plot.path_in_time import draw_in_colors
from jaxfil.xla.known import part_of

# Approximate number of drawn orbits, evenly spaced in steps of the branch.
_SHOWN = 15


def branch_orbits(
    branch: Branch,
    ax: Axes | None = None,
    components: Iterable[int] = (0, 1),
    colorbar: bool | Axes = True,
    lw: float = 1.0,
) -> Axes:
    """Draw some fifteen orbits along a branch, in colours that show the parameter.

    **Arguments**

    - `branch`: a `Branch`.
    - `ax`: the axes to draw on, with `projection="3d"` for three components; by default new
      ones.
    - `components`: the numbers of two components, horizontal first, or of three.
    - `colorbar`: whether to draw the scale of the parameter beside them, or the axes to draw it in.
    - `lw`: the width of the lines in points.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=12.0)
    >>> orbit = jf.periodic_orbit(belt, jnp.array([0.1, 0.0]))
    >>> branch = jf.continue_orbit(belt, "omega", orbit, stop=10.0)
    >>> ax = jf.plot.branch_orbits(branch, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), ax.figure.axes[1].get_ylabel()
    ('x, m', 'ω, rad/s')
    """
    check.instance("branch", branch, Branch)
    n = branch.orbits.x0.shape[-1]
    shown = chosen("components", components, n, (2, 3))
    count = len(branch.values)
    picked = np.unique(np.linspace(0, count - 1, min(_SHOWN, count)).round().astype(int))
    curves = []
    for i in picked:
        orbit = part_of(branch.orbits, i)
        curves.append(path(orbit.trajectory())[1][:, shown])
    ax = own_axes(ax, "3d" if len(shown) == 3 else None)
    lines = draw_in_colors(ax, curves, branch.values[picked], lw)
    labels = labels_of(branch.orbits.system, n)
    color_bar(ax, lines, colorbar, label=labels.parameter(branch.parameter))
    name_components(ax, labels, shown)
    return ax
