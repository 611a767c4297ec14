"""A branch of equilibria against its parameter."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxfil.equilibria.equilibrium_branch import EquilibriumBranch
from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.model.labels import labels_of
from jaxfil.plot.canvas import BLACK, ORANGE, own_axes
from jaxfil.plot.kinds import KINDS
from jaxfil.plot.legend import legend
from jaxfil.plot.orbits import draw_stability


@draws(EquilibriumBranch)
def equilibrium_branch(
    branch: EquilibriumBranch, ax: Axes | None = None, component: int = 0, **style: Any
) -> Axes:
    """Draw a branch of equilibria against its parameter, unstable parts dashed, parts that slide or
    rest on a surface underlaid, and special points marked.

    **Arguments**

    - `branch`: an `EquilibriumBranch`.
    - `ax`: the axes to draw on; by default new ones.
    - `component`: the component of the state to draw, from 0.
    - `style`: matplotlib's keywords of the lines, as `color` or `lw`.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> block = jf.systems.CoulombOscillator()
    >>> start = jf.equilibrium(block, jnp.array([0.1, 0.0]), mode=1)
    >>> branch = jf.continue_equilibrium(block, "friction", start, stop=0.2)
    >>> ax = jf.plot.equilibrium_branch(branch, jf.plot.page().add_subplot())
    >>> ax.get_xlabel()
    'F'
    """
    check.instance("branch", branch, EquilibriumBranch)
    n = branch.equilibria.x.shape[-1]
    ax = own_axes(ax)
    curve = np.asarray(branch.equilibria.x)[:, check.component("component", component, n)]
    held = np.any(abs(np.asarray(branch.equilibria.mode)) != 1, axis=1)
    if held.any():
        # A boundary equilibrium has the mode after it, and also ends the piece before it.
        ends = np.isin(np.arange(1, held.size), [point.index for point in branch.points])
        shown = held | np.append(False, held[:-1] & ends)
        heights = np.where(shown, curve, np.nan)
        ax.plot(branch.values, heights, color=ORANGE, linewidth=4.5, label="on a surface")
    draw_stability(ax, branch, curve, style)
    for point in branch.points:
        marker, color = KINDS[point.kind]
        at = point.value, float(point.equilibrium.x[component])
        ax.plot(*at, marker, color=color, markeredgecolor=BLACK, label=point.kind)
    labels = labels_of(branch.equilibria.system, n)
    ax.set_xlabel(labels.parameter(branch.parameter))
    ax.set_ylabel(labels.component(component))
    legend(ax)
    return ax
