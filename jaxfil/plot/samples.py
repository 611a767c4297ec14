"""A bifurcation diagram: every sample over its value.

A diagram enters; the axes it was drawn on leave.
"""

import numpy as np
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.plot.canvas import BLACK, VERMILLION, marker_size, own_axes
from jaxfil.plot.periods import parameter_map
from jaxfil.sweep.diagram import BifurcationDiagram


@draws(BifurcationDiagram)
def _diagram(diagram: BifurcationDiagram, ax: Axes | None = None, component: int = 0) -> Axes:
    """The samples against one parameter, or on a grid of two the map of periods."""
    if isinstance(diagram.parameter, str):
        return bifurcation_diagram(diagram, ax, component)
    return parameter_map(diagram, ax)


def bifurcation_diagram(
    diagram: BifurcationDiagram, ax: Axes | None = None, component: int = 0
) -> Axes:
    """Draw one component of every sample against the parameter.

    A million samples take about a second, and a vector file holds them as an image. Values whose
    lane ended early are ticked along the lower edge.

    **Arguments**

    - `diagram`: a `BifurcationDiagram` of one parameter.
    - `ax`: the axes to draw on; by default those of a figure of their own.
    - `component`: which one of the state, from 0.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> diagram = jf.bifurcation_diagram(
    ...     jf.systems.SDOscillator(zeta=0.1), "omega", jnp.array([0.5, 0.6]),
    ...     jnp.array([1.0, 0.0]), transient=20, samples=8, steps=20, stepper=jf.RK4(),
    ...     progress=False)
    >>> ax = jf.plot.bifurcation_diagram(diagram, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel(), len(ax.lines[0].get_xdata())
    ('Ω', 'x once a period', 16)
    """
    check.instance("diagram", diagram, BifurcationDiagram)
    if not isinstance(diagram.parameter, str):
        raise ValueError(
            f"`diagram` must be a sweep of one parameter, got {', '.join(diagram.parameter)}."
        )
    values, xs = np.asarray(diagram.values), np.asarray(diagram.xs)
    check.component("component", component, xs.shape[-1])
    ax = own_axes(ax)
    column = xs[..., component]
    seen = np.isfinite(column)
    # One line of markers and no scatter plot, which draws each of a million by itself.
    ax.plot(
        np.broadcast_to(values[:, None], column.shape)[seen],
        column[seen],
        color=BLACK,
        alpha=0.4,
        linestyle="none",
        marker="o",
        markersize=marker_size(ax, values.size),
        markeredgewidth=0,
        rasterized=True,
    )
    _tick_failures(ax, values[~diagram.successful])
    if values.min() < values.max():
        ax.set_xlim(values.min(), values.max())
    ax.set_xlabel(diagram.labels.parameter(diagram.parameter))
    ax.set_ylabel(diagram.labels.component(component, "{} once a period"))
    return ax


def _tick_failures(ax: Axes, values: np.ndarray) -> None:
    if values.size:
        label = f"{values.size} ended early"
        ax.plot(
            values,
            np.zeros(values.size),
            "|",
            color=VERMILLION,
            transform=ax.get_xaxis_transform(),
            clip_on=False,
            label=label,
        )
        ax.legend(fontsize="small", loc="upper right")
