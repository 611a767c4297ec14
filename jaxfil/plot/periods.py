"""A map of the period of the motion over the plane of two parameters."""

import numpy as np
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.plot.canvas import BLACK, COLORS, WHITE, YELLOW, draw_cells, own_axes
from jaxfil.plot.parameter_plane import label_plane, plane_of
from jaxfil.sweep.diagram import BifurcationDiagram

# Periods from this one on share a colour.
_MANY = len(COLORS) + 1
# A colour for each period, the same in every map.
PERIODS = {**dict(enumerate(COLORS, start=1)), _MANY: YELLOW, 0: BLACK, -1: WHITE}


def parameter_map(
    diagram: BifurcationDiagram, ax: Axes | None = None, colorbar: bool | Axes = True
) -> Axes:
    """Draw the period of the motion over a grid of two parameters, a colour for each.

    Periods are computed by `BifurcationDiagram.periods`, in forcing periods. Black stands for a
    period longer than half of the samples (chaos, a torus, or an unfinished transient), white for a
    failed lane.

    **Arguments**

    - `diagram`: a `BifurcationDiagram` over a grid of two parameters, two values or more of each.
    - `ax`: the axes to draw on; by default new ones.
    - `colorbar`: whether to draw the scale of colours beside them, or the axes to draw it in.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> diagram = jf.bifurcation_diagram(
    ...     jf.systems.SDOscillator(zeta=0.1), ("omega", "f0"),
    ...     (jnp.array([0.5, 0.6]), jnp.array([0.2, 0.25])), jnp.array([1.0, 0.0]),
    ...     transient=20, samples=8, steps=20, stepper=jf.RK4(), progress=False)
    >>> ax = jf.plot.parameter_map(diagram, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('Ω', 'f₀')
    """
    check.instance("diagram", diagram, BifurcationDiagram)
    axes, place = plane_of(diagram)
    ax = own_axes(ax)
    periods = np.minimum(diagram.periods(), _MANY)[place].T
    longest = diagram.xs.shape[-2] // 2
    many = f"{_MANY}–{longest}" if longest > _MANY else str(_MANY)
    told = {_MANY: many, 0: f"> {longest}", -1: "failed"}
    styles = {period: (color, told.get(period, str(period))) for period, color in PERIODS.items()}
    bar = draw_cells(ax, axes, periods, styles, colorbar)
    if bar is not None:
        bar.set_label("period")
    label_plane(ax, diagram)
    return ax
