"""A Poincaré section: the states at which a motion meets it.

States enter; the axes they were drawn on leave.
"""

import numpy as np
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.model.labels import Labels, labels_of
from jaxfil.model.system import System
from jaxfil.model.types import States
from jaxfil.plot.canvas import BLACK, own_axes


def poincare_section(
    xs: States,
    ax: Axes | None = None,
    components: tuple[int, int] = (0, 1),
    system: System | None = None,
) -> Axes:
    """Draw one component against another at every state of a section.

    A stroboscopic section is what `jaxfil.bifurcation_diagram` samples: `diagram.xs[i]` for one
    value. One of another kind is `jaxfil.Solution.events.xs`, the states at contacts.

    **Arguments**

    - `xs`: states, shape (k, n) or (…, k, n); those that are not finite are left out.
    - `ax`: the axes to draw on; by default those of a figure of their own.
    - `components`: the numbers of the two components, that to the right first.
    - `system`: the `System` whose names the axes have; by default x[0], x[1], ….

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> sd = jf.systems.SDOscillator(zeta=0.1)
    >>> diagram = jf.bifurcation_diagram(
    ...     sd, "omega", jnp.array([0.5, 0.6]), jnp.array([1.0, 0.0]), transient=20, samples=8,
    ...     steps=20, stepper=jf.RK4(), progress=False)
    >>> ax = jf.plot.poincare_section(diagram.xs[0], jf.plot.page().add_subplot(), system=sd)
    >>> ax.get_xlabel(), ax.get_ylabel(), len(ax.lines[0].get_xdata())
    ('x', "x'", 8)
    """
    if system is not None:
        check.system("system", system)
    pair = tuple(components)
    if len(pair) != 2 or not all(isinstance(c, (int, np.integer)) for c in pair):
        raise ValueError(f"`components` must be two integers, got {components!r}.")
    given, xs = xs, np.asarray(xs)
    if xs.dtype.kind not in "fiu" or xs.ndim < 2 or xs.shape[-1] <= max(components):
        got = f"shape {xs.shape}" if xs.dtype.kind in "fiu" else type(given).__name__
        raise ValueError(
            f"`xs` must be states of shape (k, n) with n > {max(components)}, got {got}."
        )
    ax = own_axes(ax)
    points = xs.reshape(-1, xs.shape[-1])
    points = points[np.isfinite(points).all(axis=1)]
    # A point of a page covers some thousandth of it: so many that none hides the next.
    size = float(np.clip(60 / np.sqrt(max(len(points), 1)), 1, 4))
    x, y = (points[:, i] for i in components)
    ax.plot(x, y, ".", color=BLACK, markersize=size, markeredgewidth=0, rasterized=True)
    labels = Labels() if system is None else labels_of(system, xs.shape[-1])
    ax.set_xlabel(labels.component(components[0]))
    ax.set_ylabel(labels.component(components[1]))
    return ax
