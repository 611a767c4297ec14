"""Candidates of tangencies on an orbit, the guesses from which a bifurcation is located.

On one side of a bifurcation the orbit has a short piece that is absent on the other: a short flight
between two contacts; on the other side a guard with a minimum, or a contact with a small rate.
"""

import collections
import itertools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.bifurcations.flights import Candidate, Flight, Pieces, pieces_of, quiet_node
from jaxfil.bifurcations.minima import minima
from jaxfil.bifurcations.tangency import ARRIVAL, FAMILIES, Tangency, approach, conditions
from jaxfil.model.outcomes import is_successful
from jaxfil.model.system import System
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.known import array_of, part_of, stacked
from jaxfil.xla.select import select

# Largest number of candidates for each surface from which a bifurcation is searched.
_CANDIDATES = 3
# A reset that moves a state at rest on a wall by less than this part of its size, as one of a rate
# that is not linear, is the identity there.
_JUMP = 1e-2


class Guess(NamedTuple):
    """A candidate, a flag that it is missing, and the distance to it as the parameters change, to
    first order; 0 for the only one."""

    tangency: Tangency
    missing: Array
    away: np.ndarray = np.zeros(())


def guesses(
    orbit: Orbit, *kinds: str, away: Callable[[Orbit, Tangency, Array], Array]
) -> list[list[Guess]]:
    """For every lane the nearest candidates for a bifurcation of one of these kinds, by the
    distance `away` of the parameters to first order: the smallest change of these need not move the
    orbit to where it is nearest to a surface. A lane without candidates, or with a failed orbit,
    has one of NaN."""
    with _concrete(orbit):
        single = orbit.x0.ndim == 1
        orbits = [orbit] if single else [part_of(orbit, i) for i in range(orbit.x0.shape[0])]
        lanes = [_guesses(one, kinds) for one in orbits]
        if all(len(lane) == 1 for lane in lanes):
            return lanes
        distances = [
            np.reshape(away(orbit, tried.tangency, tried.missing), -1)
            for tried in attempts(orbit, lanes)
        ]
        each = zip(lanes, np.array(distances).T, strict=True)
        return [_nearest(lane, by) for lane, by in each]


def _nearest(lane: list[Guess], distances: np.ndarray) -> list[Guess]:
    """The candidates of a lane in the order of their distances, a few of each surface."""
    nearest, count = [], collections.Counter[int]()
    for i in np.argsort(distances[: len(lane)], kind="stable").tolist():
        surface = int(lane[i].tangency.surface)
        count[surface] += 1
        if count[surface] <= _CANDIDATES:
            nearest.append(lane[i]._replace(away=distances[i]))
    return nearest


def approaches(orbit: Orbit) -> list[Guess]:
    """The nearest candidates for the margin of one orbit, up to the least minimum of a guard, which
    is missing at a tick."""
    with _concrete(orbit):
        if not is_successful(orbit.result):
            return [_nowhere(orbit)]
        pieces, found = _candidates(orbit, "grazing")
        tried, count = [], collections.Counter[int]()
        for one in found:
            count[one.j] += 1
            if one.minimum == "abrupt":
                tried.append(_nowhere(orbit))
            elif one.minimum or count[one.j] <= _CANDIDATES:
                tried.append(Guess(_tangency(pieces, one), array_of(False)))
            if one.minimum:
                break
        return tried or [_nowhere(orbit)]


def _concrete(orbit: Orbit) -> AbstractContextManager:
    """A context in which a known orbit is evaluated, also while the system is traced."""
    if isinstance(orbit.x0, jax.core.Tracer):
        raise ValueError(
            "`orbit` must not be traced, got a traced Orbit. Compute it outside the transformation."
        )
    return jax.core.eval_context()


def attempts(orbit: Orbit, lanes: list[list[Guess]]) -> Iterator[Guess]:
    """The result of `guesses`, one candidate of each lane at a time, batched like the orbit. Lanes
    with fewer candidates repeat their last one."""
    for i in range(max(len(lane) for lane in lanes)):
        tried = [lane[min(i, len(lane) - 1)] for lane in lanes]
        yield tried[0] if orbit.x0.ndim == 1 else stacked(tried)


def _guesses(orbit: Orbit, kinds: tuple[str, ...]) -> list[Guess]:
    found = tangency_candidates(orbit, *kinds) if is_successful(orbit.result) else []
    return [Guess(tangency, array_of(False)) for _, tangency in found] or [_nowhere(orbit)]


def _nowhere(orbit: Orbit) -> Guess:
    """A candidate of NaN, which is missing."""
    nan, mode = jnp.full_like(orbit.period, jnp.nan), orbit.first_mode.astype(orbit.period.dtype)
    surface, struck = jnp.zeros((), jnp.int32), array_of(np.False_)
    nowhere = Tangency(orbit.starts, nan, nan, nan, nan, mode, surface, nan, struck)
    return Guess(nowhere, array_of(True))


def tangency_candidates(orbit: Orbit, *kinds: str) -> list[tuple[float, Tangency]]:
    """The candidates for a bifurcation of one of these kinds, nearest in time first, each with the
    time by which the orbit misses it (or is past it)."""
    pieces, found = _candidates(orbit, *kinds)
    return [(one.reach, _tangency(pieces, one)) for one in found if one.minimum != "abrupt"]


def _candidates(orbit: Orbit, *kinds: str) -> tuple[Pieces, list[Candidate]]:
    """The pieces of an orbit, and all candidates on them, nearest first."""
    pieces, found = pieces_of(orbit), list[Candidate]()
    flights = pieces.flights
    for kind, j in itertools.product(kinds, range(flights[0].mode.size)):
        arrives = FAMILIES[kind] == ARRIVAL
        for i, flight in enumerate(flights):
            after = flights[(i + 1) % len(flights)]
            found += _short(pieces, i, j, kind)
            found += (_arrivals if arrives else _impacts)(pieces, flight, after, j, kind)
        if not arrives:
            found += minima(pieces, j, kind)
    found.sort(key=lambda one: one.reach)
    # Two kinds have the same minima.
    first = {(one.j, one.middle): one for one in reversed(found)}
    return pieces, list(reversed(first.values()))


def _short(pieces: Pieces, i: int, j: int, kind: str) -> list[Candidate]:
    """A flight that may be born in the bifurcation, as its length and the tangency there."""
    flights = pieces.flights
    before, flight, after = flights[i - 1], flights[i], flights[(i + 1) % len(flights)]
    a, b, c = before.mode[j], flight.mode[j], after.mode[j]
    patterns = {
        "grazing": a != 0 and c == a and b == -a,
        "grazing-sliding": a != 0 and c == a and b == 0,
        "adding-sliding": a == 0 and c == 0 and b != 0,
        "crossing-sliding": a != 0 and b == 0 and c == -a,
        "switching-sliding": a != 0 and b == -a and c == 0,
    }
    if not patterns[kind] or len(flights) < 2:
        return []
    side = {"adding-sliding": b, "crossing-sliding": c, "switching-sliding": b}.get(kind, a)
    # Half into the neighbours, because the flight without the short piece continues there, on
    # either side of the bifurcation.
    length = flight.stop - flight.start
    left = flight.start - 0.5 * (before.stop - before.start)
    right = flight.stop + 0.5 * (after.stop - after.start)
    middle = flight.start if FAMILIES[kind] == ARRIVAL else flight.start + 0.5 * length
    if pieces.orbit.options.arcs > 1:
        left, right = max(left, middle - pieces.most), min(right, middle + pieces.most)
    return [Candidate(length, j, side, before.mode, left, middle, right)]


def _impacts(pieces: Pieces, flight: Flight, after: Flight, j: int, kind: str) -> list[Candidate]:
    """Impacts, with the time in which the rate of approach would vanish."""
    side = flight.mode[j]
    if kind != "grazing" or not flight.surfaces[j] or side == 0 or after.mode[j] != side:
        return []
    reach, there = _reach(pieces, flight, j, side)
    x, at = array_of(flight.x), flight.stop
    struck = bool(_is_struck(pieces.orbit.system, x, there, array_of(pieces.sizes)))
    left = at - min(0.5 * (at - flight.start), pieces.most)
    # After a reset the orbit is another one, and the full flow follows it.
    ahead = 0.0 if struck else min(0.5 * (after.stop - after.start), pieces.most)
    return [Candidate(reach, j, side, flight.mode, left, at, at + ahead, struck)]


@eqx.filter_jit
def _is_struck(system: System, x: Array, there: Tangency, sizes: Array) -> Array:
    """Whether the reset of a contact at x changes the state where the rate of approach is zero, the
    nearest such state in the scales of the orbit."""
    rate, slope = approach(system, there.phase, x, there)
    slope = slope * sizes
    square = slope @ slope
    x = x - sizes * slope * rate / select(square == 0, 1, square)
    jump = system.reset(there.phase, x, there.surface) - x
    return jnp.max(abs(jump) / sizes) > _JUMP


def _reach(pieces: Pieces, flight: Flight, j: int, side: float) -> tuple[float, Tangency]:
    """The time in which Ḣ_s at the end of a flight would vanish, and that end, with its time as the
    phase."""
    # Of a reset the state before it.
    x = array_of(flight.x)
    at = array_of(flight.stop, x.dtype)
    there = Tangency(
        x[None],
        node=at,
        phase=at,
        start=at,
        stop=at,
        mode=array_of(flight.mode, x.dtype),
        surface=array_of(j, jnp.int32),
        side=array_of(side, x.dtype),
        struck=array_of(np.False_),
    )
    found = conditions(pieces.orbit.system, at, x, there)
    return abs(float(found.rate)) / max(abs(float(found.bend)), 1e-300), there


def _arrivals(pieces: Pieces, flight: Flight, after: Flight, j: int, kind: str) -> list[Candidate]:
    """Contacts at which the orbit arrives near the end of the sliding region, with the time in
    which Ḣ_s would vanish."""
    a, c = flight.mode[j], after.mode[j]
    crosses, sticks = a != 0 and c == -a, a != 0 and c == 0
    if not flight.surfaces[j] or not (crosses or (sticks and kind == "switching-sliding")):
        return []
    at = flight.stop
    reach, _ = _reach(pieces, flight, j, -a)
    left = at - min(0.5 * (at - flight.start), pieces.most)
    return [Candidate(reach, j, -a, flight.mode, left, at, at)]


def _tangency(pieces: Pieces, found: Candidate) -> Tangency:
    """The tangency as arrays, with its flight shifted to start within the known period."""
    orbit, period, dtype = pieces.orbit, pieces.period, pieces.first.xs.dtype
    t0, arcs = float(orbit.options.t0), orbit.options.arcs
    times = found.left, found.middle, found.right
    shift = period * np.floor((found.left - t0) / period)
    left, middle, right = (min(v - shift, t0 + 2 * period) for v in times)
    node = quiet_node(pieces, left, right)
    # Newton's method corrects the states with the rest of the guess, which is no more exact.
    starts = np.array([pieces.state(node + period * i / arcs) for i in range(arcs)])
    return Tangency(
        starts=array_of(starts, dtype),
        node=array_of(node / period, dtype),
        phase=array_of(middle / period, dtype),
        start=array_of(left / period, dtype),
        stop=array_of(right / period, dtype),
        mode=array_of(found.mode, dtype),
        surface=array_of(found.j, jnp.int32),
        side=array_of(found.side, dtype),
        struck=array_of(np.bool_(found.struck)),
    )
