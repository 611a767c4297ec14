"""A motion in the plane or in the space of components of its state."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.typing import ColorType

from jaxfil.integrate.run.solution import Solution
from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.model.outcomes import EventKind
from jaxfil.model.system import System
from jaxfil.orbits.orbit import Orbit
from jaxfil.plot.canvas import BLACK, WHITE, name_components, own_axes, styled
from jaxfil.plot.history import time_history
from jaxfil.plot.legend import legend
from jaxfil.plot.path import (
    BANDS,
    JUMPS,
    MARKERS,
    chosen,
    contacts,
    drawn_lanes,
    jumps,
    path,
    saved,
    spans,
)
from jaxfil.plot.surfaces import draw_surfaces

# More contacts than this have smaller marks, which do not cover the motion; more motions than this
# have no arrows.
_MANY, _ARROWS = 25, 8


@draws(Solution)
def _solution(sol: Solution, ax: Axes | None = None) -> Axes:
    """The phase portrait, or the history of a state of one component."""
    picture = time_history if sol.x_final.shape[-1] == 1 else phase_portrait
    return picture(sol, ax=ax)


@draws(Orbit)
def _orbit(orbit: Orbit, ax: Axes | None = None) -> Axes:
    """The portrait of one turn, with the system's surfaces; over time for a single component."""
    sol = orbit.trajectory()
    if sol.x_final.shape[-1] == 1:
        return time_history(sol, ax, system=orbit.system)
    return phase_portrait(sol, ax, orbit.system)


def phase_portrait(
    sol: Solution,
    ax: Axes | None = None,
    system: System | None = None,
    components: Iterable[int] = (0, 1),
    **style: Any,
) -> Axes:
    """Draw components against each other, with slides, contacts and jumps.

    Sliding segments are thick, every contact is marked by its kind, and the jump of an impact is
    dotted. A hollow circle is the start, an arrow the direction. Surfaces are dashed. They
    are drawn in the plane of two components through the last state, at the last time. For a batch
    every lane is drawn, except those that stopped at their start.

    **Arguments**

    - `sol`: a `Solution` with two saved times or more.
    - `ax`: the axes to draw on, with `projection="3d"` for three components; by default new
      ones.
    - `system`: the `System` whose surfaces are drawn; None to omit them.
    - `components`: the numbers of two components, horizontal first, or of three.
    - `style`: matplotlib's keywords of the line, as `color`, `lw`, `alpha` or `label`.

    **Returns** the matplotlib axes.

    >>> import diffrax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0])
    >>> saveat = diffrax.SaveAt(t0=True, steps=True)
    >>> sol = jf.solve(system, x0, 0.0, 14.0, 0.1, stepper=jf.RK4(), saveat=saveat)
    >>> ax = jf.plot.phase_portrait(sol, jf.plot.page().add_subplot(), system=system)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['sliding', 'start', 'crossing', 'stick', 'H = 0']
    """
    check.instance("sol", sol, Solution)
    if system is not None:
        check.system("system", system)
    n = sol.x_final.shape[-1]
    if n < 2:
        raise ValueError("`sol` must have two components or more, got 1.")
    shown = chosen("components", components, n, (2, 3))
    ax = own_axes(ax, "3d" if len(shown) == 3 else None)
    motions = drawn_lanes(sol)
    for one in motions:
        _draw_motion(ax, one, system, shown, style, arrow=len(motions) <= _ARROWS)
    if system is not None and len(shown) == 2:
        draw_surfaces(ax, system, motions[-1], shown)
    name_components(ax, sol.labels, shown)
    legend(ax)
    return ax


def _draw_motion(
    ax: Axes,
    sol: Solution,
    system: System | None,
    shown: list[int],
    style: dict[str, Any],
    arrow: bool,
) -> None:
    """Draw one lane, with its path and slides, its start, contacts and jumps."""
    ts, xs = path(sol)
    (line,) = ax.plot(*xs[:, shown].T, **styled(style, color=BLACK, linewidth=1))
    _draw_slides(ax, sol, ts, xs[:, shown])
    color, size = line.get_color(), rcParams["lines.markersize"]
    hollow = {"markerfacecolor": WHITE, "markeredgecolor": color, "markersize": 0.8 * size}
    # A list of one point, because `plot` of 3-D axes does not accept scalars.
    ax.plot(*xs[:1, shown].T, "o", label="start", **hollow)
    if arrow and len(shown) == 2:
        _draw_arrow(ax, xs[:, shown], color)
    for kind in JUMPS:
        _, before, after = jumps(sol, system, kind)
        gap = np.full(before.shape, np.nan)
        if len(before):
            jump = np.stack([before, after, gap], axis=1).reshape(-1, xs.shape[1])
            ax.plot(*jump[:, shown].T, ":", color=color, linewidth=0.8)
    met = contacts(sol)
    size *= float(np.clip(np.sqrt(_MANY / max(met.ts.size, 1)), 0.3, 1))
    kinds, counts = np.unique(met.kinds, return_counts=True)
    for kind, count in zip(kinds, counts, strict=True):
        marker, fill = MARKERS[EventKind(kind)]
        ax.plot(
            *met.xs[met.kinds == kind][:, shown].T,
            marker,
            color=fill,
            markeredgecolor=BLACK,
            markeredgewidth=0.1 * size,
            markersize=size,
            label=EventKind(kind).name,
            zorder=3 - count / met.ts.size,  # rare ones above frequent ones
        )


def _draw_arrow(ax: Axes, xs: np.ndarray, color: ColorType) -> None:
    """The direction, a third of the way along the drawn line."""
    steps = np.linalg.norm(np.diff(xs, axis=0), axis=1)
    finite = np.flatnonzero(steps > 0)  # not across the gap of an impact, nor at rest
    if not finite.size:
        return
    length = np.cumsum(steps[finite])
    i = finite[np.searchsorted(length, length[-1] / 3)]
    ax.annotate(
        "",
        tuple(xs[i + 1]),
        tuple(xs[i]),
        arrowprops={"arrowstyle": "-|>", "color": color, "shrinkA": 0, "shrinkB": 0},
    )


def _draw_slides(ax: Axes, sol: Solution, ts: np.ndarray, xs: np.ndarray) -> None:
    """Thicken the path wherever it slides or rests on a surface."""
    times, _, modes = saved(sol)
    met = contacts(sol)
    for j in range(modes.shape[1]):
        held_spans = spans(times, modes[:, j], met.ts[met.members[:, j]])
        for start, width, held in zip(*held_spans, strict=True):
            low, high = min(start, start + width), max(start, start + width)
            part = xs[(low <= ts) & (ts <= high)]
            if held in (0, 2) and len(part) > 1:
                label, color = BANDS[held]
                ax.plot(*part.T, color=color, linewidth=4, zorder=1.5, label=label)
