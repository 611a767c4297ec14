"""The pieces of an orbit, its flights between contacts, and candidates of tangencies on them."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.lane import clocks
from jaxfil.integrate.lane.problem import even_grid
from jaxfil.integrate.loop.extensions import problem_of
from jaxfil.integrate.loop.extremes import cubics_of
from jaxfil.integrate.run.solution import Dense, step_again, switches, within_step
from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.integrate.surfaces import filippov, weights as sliding_weights
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system import lowered
from jaxfil.integrate.system.components import pack
from jaxfil.orbits.orbit import Orbit, dense_arcs
from jaxfil.xla.known import array_of, in_numpy, power_of_two


class Candidate(NamedTuple):
    """A tangency of surface j from a side in a mode, at time `middle` of a flight from `left` to
    `right`; `reach` is the time by which the orbit misses it. `struck` as in `Tangency`.
    A minimum of the guard is "smooth", or "abrupt" at a tick or a contact with another surface,
    where it is no tangency."""

    reach: float
    j: int
    side: float
    mode: np.ndarray
    left: float
    middle: float
    right: float
    struck: bool = False
    minimum: str = ""


@dataclasses.dataclass(frozen=True)
class Flight:
    """A stretch of an orbit in one mode, in times that may pass the end of the period."""

    start: float
    stop: float
    mode: np.ndarray
    surfaces: np.ndarray  # the surfaces of the contact at its end
    x: np.ndarray  # the state just before this contact


def flights_of(orbit: Orbit) -> list[Flight]:
    """The orbit cut at its contacts; an orbit without contacts is one endless flight."""
    t0, period = float(orbit.options.t0), float(orbit.period)
    first = np.asarray(orbit.first_mode).astype(float)
    events = orbit.events
    # A graze does not end a flight.
    ends = switches(events)
    count = ends.size
    if events is None or count == 0:
        x = np.full(orbit.x0.shape, np.nan)
        return [Flight(-np.inf, np.inf, first, np.zeros(first.shape, bool), x)]
    ts = np.asarray(events.ts)[ends]
    # An orbit at a bifurcation has the contacts of its neighbour, which may start elsewhere.
    ts = np.where((ts < t0) | (ts > t0 + period), t0 + np.mod(ts - t0, period), ts)
    ends, ts = ends[np.argsort(ts, kind="stable")], np.sort(ts)
    modes = np.asarray(events.modes)[ends].astype(float)
    # The contact at the end of each flight.
    members = np.roll(np.asarray(events.members)[ends], -1, axis=0)
    xs = np.roll(np.asarray(events.xs)[ends], -1, axis=0)
    stops = np.append(ts[1:], ts[0] + period)
    return [Flight(ts[i], stops[i], modes[i], members[i], xs[i]) for i in range(count)]


class Ends(NamedTuple):
    """Values at one end of each piece: the state, and of each surface the guard of its flight, the
    rate of the guard, and the sliding weight. A piece starts just after a tick or a contact there,
    and stops just before."""

    xs: np.ndarray
    guards: np.ndarray
    rates: np.ndarray
    weights: np.ndarray


@dataclasses.dataclass(frozen=True)
class Pieces:
    """An orbit in k pieces with no contact and no tick within: its steps, and the parts of a step
    of a series, which may be as long as the period. One follows another, in times that pass the
    end of the period where their flight does, and the first one follows the last."""

    orbit: Orbit
    flights: list[Flight]
    number: np.ndarray  # of the flight of each piece
    starts: np.ndarray
    stops: np.ndarray
    first: Ends
    last: Ends
    at: Callable[[np.ndarray, np.ndarray], Ends]
    """The values on pieces of these numbers, each after this part of its length."""

    @property
    def period(self) -> float:
        """The period."""
        return float(self.orbit.period)

    @property
    def most(self) -> float:
        """The longest time on either side of a tangency for a flight around it."""
        return 0.25 * self.period / self.orbit.options.arcs

    @property
    def sizes(self) -> np.ndarray:
        """The largest size of each component; 1 for one that is zero."""
        sizes = np.maximum(*(np.max(abs(ends.xs), axis=0) for ends in (self.first, self.last)))
        return np.where(sizes == 0, 1, sizes)

    def state(self, t: float) -> np.ndarray:
        """A state near a time, accurate enough for a guess."""
        since = np.mod(t - self.starts, self.period)
        i = int(np.argmin(since))
        part = min(since[i] / (self.stops[i] - self.starts[i]), 1.0)
        return (1 - part) * self.first.xs[i] + part * self.last.xs[i]


def pieces_of(orbit: Orbit) -> Pieces:
    """The pieces of an orbit."""
    flights, arcs = flights_of(orbit), dense_arcs(orbit)
    # The step of each piece, and the times from its start to both ends of the piece.
    ts, xs, modes, lows, highs = (
        np.concatenate(rows) for rows in zip(*(_parts_of(arc) for arc in arcs), strict=True)
    )
    # The middle of a piece is in its flight; the time of a contact itself is known to rounding.
    beginnings = np.array([flight.start for flight in flights])
    middles = ts + 0.5 * (lows + highs)
    shift = np.where(middles < beginnings[0], float(orbit.period), 0.0)
    number = np.searchsorted(beginnings, middles + shift, side="right") - 1
    order = np.argsort(middles + shift)
    ts, xs, modes, lows, highs, shift, number = (
        v[order] for v in (ts, xs, modes, lows, highs, shift, number)
    )
    flown = np.array([flight.mode for flight in flights])[number]
    run = dataclasses.replace(arcs[0], system=orbit.system, ts=None, xs=None, modes=None)

    def at(k: np.ndarray, part: np.ndarray) -> Ends:
        h, ways = (1 - part) * lows[k] + part * highs[k], np.where(part < 1, 1.0, -1.0)
        # As many rows as for all pieces, for the same program.
        rows = (filled(v, ts.size) for v in (ts[k], xs[k], modes[k], flown[k], h, ways))
        return Ends(*(np.asarray(v)[: k.size] for v in _ends_at(run, *rows)))

    all_pieces = np.arange(ts.size)
    first, last = (at(all_pieces, np.full(ts.shape, part)) for part in (0.0, 1.0))
    return Pieces(orbit, flights, number, ts + lows + shift, ts + highs + shift, first, last, at)


def quiet_node(pieces: Pieces, left: float, right: float) -> float:
    """The start of an arc that contains the flight from `left` to `right`. It is the start of the
    flight; for a system with clocks, whose ticks may pass this as the flight moves, it is before
    the flight, in the middle of a long time without a tick or a contact."""
    orbit, period = pieces.orbit, pieces.period
    if not orbit.system.clocks:
        return left
    low = right - period / orbit.options.arcs
    each = [(float(clock.phase), float(clock.period)) for clock in orbit.system.clocks]
    each += [(flight.start, period) for flight in pieces.flights if np.isfinite(flight.start)]
    times = [
        phase + step * np.arange(np.ceil((low - phase) / step), (left - phase) / step)
        for phase, step in each
    ]
    edges = np.sort(np.concatenate([[low, left], *times]))
    lengths, middles = np.diff(edges), 0.5 * (edges[1:] + edges[:-1])
    far = np.where(2 * lengths < lengths.max(), np.inf, abs(middles - 0.5 * (low + left)))
    return float(middles[np.argmin(far)])


def _parts_of(dense: Dense) -> tuple[np.ndarray, ...]:
    """The steps of a run in parts, each as the time, state and mode at the start of its step, and
    the times from there to both of its ends."""
    count = cubics_of(tableau_of(dense.stepper))
    ts, xs, modes = in_numpy((dense.ts, dense.xs, dense.modes))
    lengths = np.diff(ts[np.isfinite(ts)])
    (steps,) = np.nonzero(lengths)  # a step of length zero is a jump
    low, high = (np.outer(lengths[steps], np.arange(count) + i) / count for i in (0, 1))
    rows = np.repeat(steps, count)
    # The parts of a step share their ends to the last bit.
    return ts[rows], xs[rows], modes[rows], low.ravel(), high.ravel()


@eqx.filter_jit
def _ends_at(
    run: Dense, ts: Array, xs: Array, modes: Array, flown: Array, lengths: Array, ways: Array
) -> tuple[Array, Array, Array, Array]:
    """The states at times after the starts of steps of a run, and the values of `Ends` in the
    modes `flown`; of functions that jump at a tick there those just after it for a way of +1, just
    before it for −1."""

    def one(t: Array, x: Array, mode: Array, flown: Array, h: Array, way: Array) -> tuple:
        dtype = x.dtype
        system = lowered.build(run.system, x, compact=True)
        here = within_step(run, system, t)
        field = ModeField(here, here.of_surfaces(mode.astype(dtype)))
        end = step_again(run, here, field, t, here.unpack(x), h)
        t, x = t + h, pack(end, dtype)
        problem = problem_of(system, tableau_of(run.stepper), even_grid(t, way, jnp.int32(1)))
        system = clocks.just_after(problem, t).system
        modes = system.of_surfaces(flown)

        def guards(t: Array, x: Array) -> Array:
            return pack(filippov.guard(system, t, system.unpack(x), modes), dtype)

        blocks = system.unpack(x)
        along = pack(filippov.field(system, t, blocks, modes), dtype)
        weight = jnp.zeros_like(flown)
        if system.slides:
            _, rates = filippov.corners(system, t, blocks)
            weight = pack(sliding_weights.weights(modes, rates), dtype)
        return x, *jax.jvp(guards, (t, x), (jnp.ones_like(t), along)), weight

    return jax.vmap(one)(ts, xs, modes, flown, lengths, ways)


def filled(rows: np.ndarray, least: int = 0) -> Array:
    """Rows padded with the last one to a power of two, at least to this number."""
    return array_of(rows[np.minimum(np.arange(power_of_two(max(len(rows), least))), len(rows) - 1)])
