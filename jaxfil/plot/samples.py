"""A bifurcation diagram, with every sample over its value."""

import textwrap
from typing import Any

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.plot.canvas import (
    BLACK,
    VERMILLION,
    Heading,
    marker_size,
    own_axes,
    points_of,
    styled,
)
from jaxfil.plot.legend import legend
from jaxfil.plot.periods import parameter_map
from jaxfil.sweep.diagram import BifurcationDiagram

# Samples further away than this multiple of the typical spread have diverged.
_FAR, _MOST = 100.0, (10.0, 90.0)
# Darkness of a point drawn once for each sample of a period-1 motion, and of dense chaos at most.
_DARK, _DENSE = 0.95, 0.6


@draws(BifurcationDiagram)
def _diagram(diagram: BifurcationDiagram, ax: Axes | None = None, component: int = 0) -> Axes:
    """The samples against one parameter, or on a grid of two the map of periods."""
    if isinstance(diagram.parameter, str):
        return bifurcation_diagram(diagram, ax, component)
    if component != 0:
        raise ValueError(
            "`component` must be omitted for a grid of two parameters, since a map of periods is "
            f"computed from all components, got {component!r}."
        )
    return parameter_map(diagram, ax)


def bifurcation_diagram(
    diagram: BifurcationDiagram, ax: Axes | None = None, component: int = 0, **style: Any
) -> Axes:
    """Draw one component of every sample against the parameter.

    New axes have the conditions as their title, until they are given another. A million samples
    take about a second, and a vector file stores them as an image. Values whose lane ended early
    are ticked along the lower edge; samples far beyond all others are outside the axes and counted.

    **Arguments**

    - `diagram`: a `BifurcationDiagram` of one parameter.
    - `ax`: the axes to draw on; by default new ones.
    - `component`: the component of the state, from 0.
    - `style`: matplotlib's keywords of the dots, as `color`, `ms`, `alpha` or `label`.

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
    new, ax = ax is None, own_axes(ax)
    column = xs[..., component]
    seen = np.isfinite(column)
    size = marker_size(ax, values.size)
    # One line of markers instead of a scatter plot, which draws each marker separately.
    ours = {"color": BLACK, "alpha": _alpha(ax, column.shape[1], size), "markersize": size}
    ours |= {"linestyle": "none", "marker": "o", "markeredgewidth": 0, "rasterized": True}
    xy = np.broadcast_to(values[:, None], column.shape)[seen], column[seen]
    ax.plot(*xy, **styled(style, **ours))
    _limit(ax, column[seen])
    _tick_failures(ax, values[~diagram.successful])
    # A value that is not finite belongs to a lane that failed.
    finite = values[np.isfinite(values)]
    if finite.size and finite.min() < finite.max():
        ax.set_xlim(finite.min(), finite.max())
    ax.set_xlabel(diagram.labels.parameter(diagram.parameter))
    ax.set_ylabel(diagram.labels.component(component, _sampled(diagram)))
    if new:
        width = max(20, int(points_of(ax)[0] / (0.58 * rcParams["font.size"])))  # in letters
        Heading(ax, "\n".join(textwrap.wrap(_told(diagram), width)))
    if style.get("label") is not None or (~diagram.successful).any():
        legend(ax, loc="upper right")
    return ax


def _alpha(ax: Axes, samples: int, size: float) -> float:
    """The opacity of a dot. A point on which all samples coincide is dark, and a column in which
    they spread over half of the height is not black."""
    overlap = samples * size / (0.5 * points_of(ax)[1])
    dense = 1 - (1 - _DENSE) ** (1 / max(overlap, 1e-9))
    return float(np.clip(max(dense, 1 - (1 - _DARK) ** (1 / samples)), 0.1, 1))


def _told(diagram: BifurcationDiagram) -> str:
    """The system, its other parameters, and the length of the run."""
    done = diagram.conditions
    values = [
        f"{diagram.labels.symbol(name)} = {float(value):.6g}"
        for name, value in done.parameters.items()
        if np.ndim(value) == 0
    ]
    start = "" if done.follow is None else f", followed {done.follow}"
    each = "periods" if done.section is None else "crossings"
    held = f"{np.shape(diagram.xs)[-2]} {each} after {done.transient}{start}"
    return f"{diagram.system}: {', '.join(values) + '; ' if values else ''}{held}"


def _sampled(diagram: BifurcationDiagram) -> str:
    """The label of a sampled component."""
    return "{} once a period" if diagram.conditions.section is None else "{} at the section"


def _limit(ax: Axes, samples: np.ndarray) -> None:
    """Exclude samples far beyond all others from the axis limits, and count them."""
    if not samples.size:
        return
    low, high = np.percentile(samples, _MOST)
    margin = _FAR * (high - low)
    beyond = (samples < low - margin) | (samples > high + margin)
    if margin > 0 and beyond.any():
        low, high = samples[~beyond].min(), samples[~beyond].max()
        ax.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
        told = f"{beyond.sum()} samples beyond the axis, to {abs(samples[beyond]).max():.3g}"
        ax.annotate(told, (0.99, 0.02), xycoords="axes fraction", ha="right", color=VERMILLION)


def _tick_failures(ax: Axes, values: np.ndarray) -> None:
    if values.size:
        label = f"{values.size} ended early"
        edge = {"transform": ax.get_xaxis_transform(), "clip_on": False, "label": label}
        ax.plot(values, np.zeros(values.size), "|", color=VERMILLION, **edge)
