"""A motion in the plane or in the space of its components, coloured by time."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from jaxfil.integrate.run.solution import Solution
from jaxfil.model import check
from jaxfil.plot.canvas import color_bar, name_components, own_axes
from jaxfil.plot.path import chosen, one_lane, path


def path_in_time(
    sol: Solution,
    ax: Axes | None = None,
    components: Iterable[int] = (0, 1),
    colorbar: bool | Axes = True,
    lw: float = 1.2,
) -> Axes:
    """Draw components against each other in colours that show the time.

    **Arguments**

    - `sol`: a `Solution` of one lane with two saved times or more.
    - `ax`: the axes to draw on, with `projection="3d"` for three components; by default new
      ones.
    - `components`: the numbers of two components, horizontal first, or of three.
    - `colorbar`: whether to draw the scale of times beside them, or the axes to draw it in.
    - `lw`: the width of the line in points.

    **Returns** the matplotlib axes.

    >>> import diffrax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0])
    >>> saveat = diffrax.SaveAt(t0=True, steps=True)
    >>> sol = jf.solve(system, x0, 0.0, 14.0, 0.1, stepper=jf.RK4(), saveat=saveat)
    >>> ax = jf.plot.path_in_time(sol, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), ax.figure.axes[1].get_ylabel()
    ('x', 't')
    """
    check.instance("sol", sol, Solution)
    one_lane(sol)
    shown = chosen("components", components, sol.x_final.shape[-1], (2, 3))
    ts, xs = path(sol)
    points = xs[:, shown]
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    real = np.isfinite(pieces).all(axis=(1, 2))
    ax = own_axes(ax, "3d" if len(shown) == 3 else None)
    lines = draw_in_colors(ax, list(pieces[real]), 0.5 * (ts[:-1] + ts[1:])[real], lw)
    color_bar(ax, lines, colorbar, label=sol.labels.time)
    name_components(ax, sol.labels, shown)
    return ax


def draw_in_colors(
    ax: Axes, curves: list[np.ndarray], numbers: np.ndarray, lw: float
) -> LineCollection:
    """Curves, shape (k, 2) each, or (k, 3) in space, in the colours of their numbers."""
    if curves[0].shape[1] == 3:
        from mpl_toolkits.mplot3d.art3d import Line3DCollection as Lines
    else:
        Lines = LineCollection
    lines = Lines(curves, array=numbers, cmap="viridis", linewidths=lw)
    ax.add_collection(lines)
    # Collections do not set the limits of axes in three dimensions.
    for name, column in zip("xyz", np.concatenate(curves).T, strict=False):
        low, high = np.nanmin(column), np.nanmax(column)
        margin = 0.05 * (high - low) or 1.0
        getattr(ax, f"set_{name}lim")(low - margin, high + margin)
    return lines
