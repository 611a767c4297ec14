"""Basins of attraction over a grid of initial states."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.plot.canvas import BLACK, WHITE, draw_cells, own_axes, shades
from jaxfil.sweep.basins import Basins

# Attractors beyond this fraction of the width have their number on their left side.
_RIGHT = 0.95


@draws(Basins)
def basins(found: Basins, ax: Axes | None = None, colorbar: bool | Axes = True) -> Axes:
    """Draw each initial state in the colour of its attractor.

    The section points of the attractors are drawn on top, each with its attractor's number. Black
    states have no detected period, white ones failed.

    **Arguments**

    - `found`: `Basins` over two values or more of each component.
    - `ax`: the axes to draw on; by default new ones.
    - `colorbar`: whether to draw the scale of colours beside them, or the axes to draw it in.

    **Returns** the matplotlib axes.

    >>> import jaxfil as jf
    >>> found = jf.basins_of_attraction(
    ...     jf.systems.SDOscillator(omega=0.6, zeta=0.1), ([-1.0, 1.0], [0.0, 0.1]), transient=20,
    ...     samples=8, steps=20, stepper=jf.RK4(), progress=False)
    >>> ax = jf.plot.basins(found, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('x at t = 0', "x' at t = 0")
    """
    check.instance("found", found, Basins)
    if min(found.labels.shape) < 2:
        raise ValueError(
            "`found` must be over a grid of two values or more of each component, got "
            f"{found.labels.shape}."
        )
    ax = own_axes(ax)
    # A mesh needs ascending axes and draws rows upwards, hence the order and the transpose.
    order = [np.argsort(axis) for axis in found.axes]
    labels = found.labels[np.ix_(*order)].T
    styles = {-1: (WHITE, "failed"), 0: (BLACK, "no period")}
    several = zip(shades(len(found.attractors)), found.attractors, strict=True)
    for k, (color, points) in enumerate(several, start=1):
        styles[k] = color, f"{k}: period {len(points)}"
    axes = [axis[o] for axis, o in zip(found.axes, order, strict=True)]
    draw_cells(ax, axes, labels, styles, colorbar)
    limits = ax.get_xlim(), ax.get_ylim()  # attractors may lie outside the grid
    for k, points in enumerate(found.attractors, start=1):
        x, y = (points[:, c] for c in found.components)
        ax.plot(x, y, "o", color=WHITE, markeredgecolor=BLACK, markersize=5)
        for place in zip(x, y, strict=True):
            # There is no space at the right edge.
            left = place[0] > _RIGHT * limits[0][1] + (1 - _RIGHT) * limits[0][0]
            number = ax.annotate(
                str(k),
                place,
                (-4 if left else 4, 3),
                textcoords="offset points",
                ha="right" if left else "left",
                annotation_clip=True,
            )
            number.set_path_effects([withStroke(linewidth=2, foreground=WHITE)])
    ax.set_xlim(limits[0])
    ax.set_ylim(limits[1])
    ax.set_xlabel(found.names.component(found.components[0], "{} at t = 0"))
    ax.set_ylabel(found.names.component(found.components[1], "{} at t = 0"))
    return ax
