"""The drawn parts of a motion: its path, contacts, jumps, and the spans of its modes.

`MARKERS` and `BANDS` define the style of each kind of contact and of each mode in all pictures.
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxfil.integrate.run.solution import Solution
from jaxfil.model import check
from jaxfil.model.outcomes import EventKind, outcome_names
from jaxfil.model.system import System
from jaxfil.plot.canvas import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, WHITE, YELLOW
from jaxfil.xla.known import part_of

# The colour and the legend entry of each mode.
BANDS = {1: ("H > 0", SKY), 0: ("sliding", ORANGE), 2: ("at rest", GREY), -1: ("H < 0", WHITE)}
# The marker of each kind of contact. The one that begins sliding has the colour of sliding.
MARKERS = {
    EventKind.crossing: ("o", BLUE),
    EventKind.stick: ("s", ORANGE),
    EventKind.slip: ("D", GREEN),
    EventKind.impact: ("^", PURPLE),
    EventKind.graze: ("*", YELLOW),
    EventKind.tick: ("P", VERMILLION),
    EventKind.carry: ("X", SKY),
}
# The kinds of contact at which the state jumps.
JUMPS = (EventKind.impact, EventKind.tick)


class Contacts(NamedTuple):
    """Time, state just before, kind and surfaces of every contact that the event table holds."""

    ts: np.ndarray
    xs: np.ndarray
    kinds: np.ndarray
    members: np.ndarray


def lanes(sol: Solution) -> list[Solution]:
    """The solutions of a batch, or the one of a single lane."""
    shape = np.shape(sol.t_final)
    if not shape:
        return [sol]
    return [part_of(sol, i) for i in np.ndindex(*shape)]


def drawn_lanes(sol: Solution) -> list[Solution]:
    """The lanes of a batch that have a path. Others stopped at their start and are left out."""
    every = lanes(sol)
    moved = [one for one in every if one.ts is not None and _is_saved(one).sum() > 1]
    return moved or every


def one_lane(sol: Solution) -> None:
    """Raise an error for the solution of a batch."""
    if np.ndim(sol.t_final):
        raise ValueError(f"`sol` must be of one lane, got {len(lanes(sol))} of them.")


def chosen(
    name: str, components: int | Iterable[int], n: int, counts: tuple[int, ...]
) -> list[int]:
    """The requested components, as many as `counts` allows; an empty `counts` allows any number."""
    one = isinstance(components, (int, np.integer))
    several = [components] if one else list(components)
    for i, c in enumerate(several):
        check.component(name if one else f"{name}[{i}]", c, n)
    if counts and len(several) not in counts:
        must = " or ".join(map(str, counts))
        raise ValueError(f"`{name}` must be {must} numbers of components, got {components!r}.")
    return [int(c) for c in several]


def saved(sol: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, states and modes that were saved and reached."""
    must = "`sol` must hold two saved times or more"
    if sol.ts is None or len(sol.ts) < 2:
        raise ValueError(
            f"{must}; solve with saveat=diffrax.SaveAt(t0=True, steps=True) or "
            "diffrax.SaveAt(ts=...)."
        )
    real = _is_saved(sol)
    if real.sum() < 2:
        raise ValueError(f"{must}, got a run that stopped before, {outcome_names(sol.result)}.")
    ts, xs, modes = (np.asarray(v)[real] for v in (sol.ts, sol.xs, sol.modes))
    # Rest looks the same from either side.
    return ts, xs, np.where(modes == -2, 2, modes)


def _is_saved(sol: Solution) -> np.ndarray:
    """Flags of the rows that were reached; others are padded with inf."""
    return np.isfinite(np.asarray(sol.ts)) & np.isfinite(np.asarray(sol.xs)).all(axis=1)


def contacts(sol: Solution) -> Contacts:
    """The contacts of the event table."""
    table = sol.events
    if table is None:
        n, m = np.size(sol.x_final), np.size(sol.mode_final)
        return Contacts(np.zeros(0), np.zeros((0, n)), np.zeros(0, int), np.zeros((0, m), bool))
    ts, xs, kinds, members = map(np.asarray, (table.ts, table.xs, table.kinds, table.members))
    real = kinds != EventKind.none
    return Contacts(ts[real], xs[real], kinds[real], members[real])


def path(sol: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Times and states saved, with the contacts among them in order and a gap at each jump."""
    ts, xs, _ = saved(sol)
    met = contacts(sol)
    jump = np.isin(met.kinds, JUMPS)
    # For a step that ends on a tick the state before it is saved too.
    last = np.append(ts[1:] != ts[:-1], True) | ~np.isin(ts, met.ts[jump])
    ts, xs = ts[last], xs[last]
    # A row of NaN after it breaks the line at the jump.
    behind = np.flatnonzero(jump) + 1
    events = np.insert(met.xs, behind, np.nan, axis=0)
    every = np.concatenate([np.insert(met.ts, behind, met.ts[jump]), ts])
    order = np.argsort(every if ts[0] <= ts[-1] else -every, kind="stable")
    return every[order], np.concatenate([events, xs])[order]


def jumps(
    sol: Solution, system: System | None, kind: EventKind
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time of each impact or tick, and the states before and after it. The state after an impact
    is the value of the system's reset, or otherwise, as after a tick, the next saved state."""
    met = contacts(sol)
    hit = met.kinds == kind
    times, before = met.ts[hit], met.xs[hit]
    ts, xs, _ = saved(sol)
    forward = ts[0] <= ts[-1]
    after = np.full(before.shape, np.nan)
    for i, t in enumerate(times):
        if system is not None and kind == EventKind.impact:
            surface = jnp.argmax(met.members[hit][i])
            after[i] = system.reset(jnp.asarray(t), jnp.asarray(before[i]), surface)
        elif (later := np.flatnonzero(ts >= t if forward else ts <= t)).size:
            after[i] = xs[ts == ts[later[0]]][-1]
    return times, before, after


def spans(
    ts: np.ndarray, modes: np.ndarray, met: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start, width and mode of each span of time over which the mode stays the same."""
    # The mode is known at saved times, and changes at the last contact between two of them, after
    # which the new mode holds.
    changes = np.flatnonzero(np.diff(modes))
    edges = [ts[0]]
    for before, after in zip(ts[changes], ts[changes + 1], strict=True):
        low, high = min(before, after), max(before, after)
        between = met[(low <= met) & (met <= high)]
        edges.append(between[-1] if between.size else after)
    edges.append(ts[-1])
    return np.array(edges[:-1]), np.diff(edges), modes[np.append(changes, len(modes) - 1)]
