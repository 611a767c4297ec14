"""One motion: its components against time, and against each other.

A solution enters; the axes it was drawn on leave.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from jaxfil.integrate.solution import Solution
from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.model.outcomes import EventKind
from jaxfil.model.system import System
from jaxfil.plot.canvas import BLACK, own_axes
from jaxfil.plot.surfaces import draw_surfaces

# The colour of each mode, and what the legend calls it.
BANDS = {
    1: ("H > 0", "#56B4E9"),
    0: ("sliding", "#E69F00"),
    2: ("at rest", "#999999"),
    -1: ("H < 0", "#FFFFFF"),
}
# The marker of each kind of contact.
MARKERS = {
    EventKind.crossing: ("o", "#0072B2"),
    EventKind.stick: ("s", "#D55E00"),
    EventKind.slip: ("D", "#009E73"),
    EventKind.impact: ("^", "#CC79A7"),
    EventKind.graze: ("*", "#F0E442"),
}


@draws(Solution)
def _solution(sol: Solution, ax: Axes | None = None) -> Axes:
    """The phase portrait, or the history of a state of one component."""
    picture = time_history if sol.x_final.shape[-1] == 1 else phase_portrait
    return picture(sol, ax=ax)


def time_history(sol: Solution, ax: Axes | None = None, component: int = 0) -> Axes:
    """Draw one component against time over bands that show the mode, one band for each surface.

    A band changes at the contact between two saved times, and once at most: save often, as
    `diffrax.SaveAt(t0=True, steps=True)` does.

    **Arguments**

    - `sol`: a `Solution` of one lane with two saved times or more.
    - `ax`: the axes to draw on; by default those of a figure of their own.
    - `component`: which one of the state, from 0.

    **Returns** the matplotlib axes.

    >>> import diffrax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0])
    >>> saveat = diffrax.SaveAt(t0=True, steps=True)
    >>> sol = jf.solve(system, x0, 0.0, 14.0, 0.1, stepper=jf.RK4(), saveat=saveat)
    >>> ax = jf.plot.time_history(sol, jf.plot.page().add_subplot(), component=1)
    >>> ax.get_ylabel(), [text.get_text() for text in ax.get_legend().get_texts()]
    ("x'", ['H > 0', 'sliding', 'H < 0'])
    """
    check.instance("sol", sol, Solution)
    ts, xs = _path(sol)
    check.component("component", component, xs.shape[1])
    ax = own_axes(ax)
    _shade_modes(ax, sol)
    ax.plot(ts, xs[:, component], color=BLACK, linewidth=1)
    ax.set_xlim(np.nanmin(ts), np.nanmax(ts))
    ax.set_xlabel(sol.labels.time)
    ax.set_ylabel(sol.labels.component(component))
    return ax


def phase_portrait(sol: Solution, ax: Axes | None = None, system: System | None = None) -> Axes:
    """Draw the second component against the first, with slides and contacts.

    Sliding segments are thick and every contact is marked by its kind. Surfaces are dashed, where
    they cut the plane of the two components, at the last time and with the other components as they
    are then.

    **Arguments**

    - `sol`: a `Solution` of one lane with two saved times or more.
    - `ax`: the axes to draw on; by default those of a figure of their own.
    - `system`: the `System` whose surfaces are drawn; by default none are.

    **Returns** the matplotlib axes.

    >>> import diffrax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0])
    >>> saveat = diffrax.SaveAt(t0=True, steps=True)
    >>> sol = jf.solve(system, x0, 0.0, 14.0, 0.1, stepper=jf.RK4(), saveat=saveat)
    >>> ax = jf.plot.phase_portrait(sol, jf.plot.page().add_subplot(), system=system)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['sliding', 'crossing', 'stick', 'H = 0']
    """
    check.instance("sol", sol, Solution)
    if system is not None:
        check.system("system", system)
    ts, xs = _path(sol)
    if xs.shape[1] < 2:
        raise ValueError("`sol` must have two components or more, got 1.")
    ax = own_axes(ax)
    ax.plot(xs[:, 0], xs[:, 1], color=BLACK, linewidth=1)
    _draw_slides(ax, sol, ts, xs)
    _, contacts, kinds, _ = _contacts(sol)
    for kind in np.unique(kinds):
        marker, color = MARKERS[EventKind(kind)]
        x, y = contacts[kinds == kind, :2].T
        ax.plot(x, y, marker, color=color, markeredgecolor=BLACK, label=EventKind(kind).name)
    if system is not None:
        draw_surfaces(ax, system, sol)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize="small", loc="best")
    ax.set_xlabel(sol.labels.component(0))
    ax.set_ylabel(sol.labels.component(1))
    return ax


def _draw_slides(ax: Axes, sol: Solution, ts: np.ndarray, xs: np.ndarray) -> None:
    """Thicken the path wherever it slides or rests on a surface."""
    times, _, modes = _saved(sol)
    contacts, _, _, members = _contacts(sol)
    labels: dict[int, str | None] = {mode: BANDS[mode][0] for mode in (0, 2)}
    for j in range(modes.shape[1]):
        for start, width, held in zip(
            *_spans(times, modes[:, j], contacts[members[:, j]]), strict=True
        ):
            low, high = min(start, start + width), max(start, start + width)
            part = xs[(low <= ts) & (ts <= high)]
            if held in labels and len(part) > 1:
                color, label = BANDS[held][1], labels[held]
                ax.plot(part[:, 0], part[:, 1], color=color, linewidth=4, zorder=1.5, label=label)
                labels[held] = None  # one entry in the legend


def _shade_modes(ax: Axes, sol: Solution) -> None:
    """Fill one band of the axes for each surface, the first lowest, with its mode's colour."""
    ts, _, modes = _saved(sol)
    times, _, _, members = _contacts(sol)
    m = modes.shape[1]
    for j in range(m):
        starts, widths, held = _spans(ts, modes[:, j], times[members[:, j]])
        for mode, (_, color) in BANDS.items():
            ax.broken_barh(
                list(zip(starts[held == mode], widths[held == mode], strict=True)),
                (j / m, 1 / m),
                transform=ax.get_xaxis_transform(),
                facecolor=color,
                alpha=0.5,
                linewidth=0,
            )
    shown = [
        Patch(facecolor=color, alpha=0.5, edgecolor=BLACK, linewidth=0.5, label=label)
        for mode, (label, color) in BANDS.items()
        if (modes == mode).any()
    ]
    if shown:
        ax.legend(handles=shown, fontsize="small", loc="best")


def _spans(
    ts: np.ndarray, modes: np.ndarray, contacts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start, width and mode of each span of time over which the mode stays the same."""
    # The mode is known at saved times, the time of its change from the contact between two of them:
    # the last one, if there are several, for it is after that one that the new mode holds.
    changes = np.flatnonzero(np.diff(modes))
    edges = [ts[0]]
    for before, after in zip(ts[changes], ts[changes + 1], strict=True):
        low, high = min(before, after), max(before, after)
        between = contacts[(low <= contacts) & (contacts <= high)]
        edges.append(between[-1] if between.size else after)
    edges.append(ts[-1])
    return np.array(edges[:-1]), np.diff(edges), modes[np.append(changes, len(modes) - 1)]


def _path(sol: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Times and states saved, with the contacts among them in order and a gap at each impact."""
    ts, xs, _ = _saved(sol)
    times, contacts, kinds, _ = _contacts(sol)
    impacts = times[kinds == EventKind.impact]
    # A state jumps at an impact: a row of NaN keeps its line from being drawn.
    gaps = np.full((impacts.size, xs.shape[1]), np.nan)
    every = np.concatenate([times, impacts, ts])  # so at one time: left limit, gap, right limit
    order = np.argsort(every if ts[0] <= ts[-1] else -every, kind="stable")
    return every[order], np.concatenate([contacts, gaps, xs])[order]


def _saved(sol: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, states and modes that were saved and reached."""
    if np.ndim(sol.t_final):
        raise ValueError(
            f"`sol` must be one lane, got {np.shape(sol.t_final)} of them: "
            "take lane i with jax.tree.map(lambda a: a[i], sol)."
        )
    # Times that were not reached are padded with inf.
    if sol.ts is not None:
        ts, xs, modes = map(np.asarray, (sol.ts, sol.xs, sol.modes))
        real = np.isfinite(ts) & np.isfinite(xs).all(axis=1)
        if real.sum() > 1:
            # Rest looks the same from either side.
            return ts[real], xs[real], np.where(modes[real] == -2, 2, modes[real])
    raise ValueError(
        "`sol` must hold two saved times or more: "
        "solve with saveat=diffrax.SaveAt(t0=True, steps=True) or diffrax.SaveAt(ts=...)."
    )


def _contacts(sol: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, state just before, kind and surfaces of every contact that the event table holds."""
    table = sol.events
    if table is None:
        n, m = np.size(sol.x_final), np.size(sol.mode_final)
        return np.zeros(0), np.zeros((0, n)), np.zeros(0, int), np.zeros((0, m), bool)
    ts, xs, kinds, members = map(np.asarray, (table.ts, table.xs, table.kinds, table.members))
    real = kinds != EventKind.none
    return ts[real], xs[real], kinds[real], members[real]
