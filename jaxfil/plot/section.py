"""A Poincaré section, the states at which a motion crosses it."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.model.labels import Labels, labels_of
from jaxfil.model.system import System
from jaxfil.model.types import States
from jaxfil.plot.canvas import BLACK, name_components, own_axes, styled
from jaxfil.plot.path import chosen


def poincare_section(
    xs: States,
    ax: Axes | None = None,
    components: Iterable[int] = (0, 1),
    system: System | None = None,
    **style: Any,
) -> Axes:
    """Draw one component against another at every state of a section.

    `jaxfil.bifurcation_diagram` samples a stroboscopic section, `diagram.xs[i]` for one value.
    Another section is `jaxfil.Solution.events.xs`, the states at contacts.

    **Arguments**

    - `xs`: states, shape (k, n) or (…, k, n); states that are not finite are omitted.
    - `ax`: the axes to draw on; by default new ones.
    - `components`: the numbers of two components, horizontal first, or of three.
    - `system`: the `System` with the names of the axes; by default x[0], x[1], ….
    - `style`: matplotlib's keywords of the dots, as `color`, `ms`, `alpha` or `label`.

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
    points, shown = section_points(xs, components, system, (2, 3))
    ax = own_axes(ax, "3d" if len(shown) == 3 else None)
    # Markers become smaller with the number of points, so that they do not overlap.
    size = float(np.clip(60 / np.sqrt(max(len(points), 1)), 1, 4))
    ours = {"marker": ".", "color": BLACK, "markersize": size, "markeredgewidth": 0}
    ours |= {"linestyle": "none", "rasterized": True}
    ax.plot(*points[:, shown].T, **styled(style, **ours))
    name_axes(ax, system, points.shape[1], shown)
    return ax


def section_points(
    xs: States, components: Iterable[int], system: System | None, counts: tuple[int, ...]
) -> tuple[Float[np.ndarray, "k n"], list[int]]:
    """The finite states of a section, and the components to be drawn."""
    if system is not None:
        check.system("system", system)
    given, xs = xs, np.asarray(xs)
    if xs.dtype.kind not in "fiu" or xs.ndim < 2 or xs.shape[-1] < 2:
        got = f"shape {xs.shape}" if xs.dtype.kind in "fiu" else type(given).__name__
        raise ValueError(f"`xs` must be states of shape (k, n) with n > 1, got {got}.")
    shown = chosen("components", components, xs.shape[-1], counts)
    points = xs.reshape(-1, xs.shape[-1])
    return points[np.isfinite(points).all(axis=1)], shown


def name_axes(ax: Axes, system: System | None, n: int, shown: list[int]) -> None:
    """Write the names of the components below and beside the axes."""
    labels = Labels() if system is None else labels_of(system, n)
    name_components(ax, labels, shown)
