"""Candidates of tangencies on an orbit, the guesses from which a bifurcation is located.

On one side of a bifurcation the orbit has a short piece that is absent on the other: a short flight
between two contacts; on the other side a guard with a minimum, or a contact with a small rate.
"""

import collections
import dataclasses
import functools as ft
import itertools
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.bifurcations.tangency import (
    ARRIVAL,
    FAMILIES,
    SLIDE,
    Tangency,
    approach,
    conditions,
    least_between,
)
from jaxfil.integrate.lane import clocks
from jaxfil.integrate.lane.problem import even_grid
from jaxfil.integrate.loop.extensions import problem_of
from jaxfil.integrate.loop.extremes import cubics_of
from jaxfil.integrate.run.options import resolution
from jaxfil.integrate.run.solution import Dense, evaluate, switches
from jaxfil.integrate.steppers.explicit import Stepper, tableau_of
from jaxfil.integrate.surfaces import filippov, weights as sliding_weights
from jaxfil.integrate.system import lowered
from jaxfil.integrate.system.components import pack
from jaxfil.model.outcomes import is_successful
from jaxfil.model.system import System
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.known import array_of, part_of, power_of_two
from jaxfil.xla.select import select

# Largest number of candidates for each surface.
_CANDIDATES = 3
# A reset that moves a state at rest on a wall by less than this part of its size, as one of a rate
# that is not linear, is the identity there.
_JUMP = 1e-2


@dataclasses.dataclass(frozen=True)
class _Steps:
    """The times ts (k,) and states xs (k, n) of all steps of an orbit, and of the parts of a step
    of a series, which may be as long as the period."""

    orbit: Orbit
    ts: np.ndarray
    xs: np.ndarray

    @property
    def period(self) -> float:
        """The period."""
        return float(self.orbit.period)

    @property
    def sizes(self) -> np.ndarray:
        """The largest size of each component; 1 for one that is zero."""
        sizes = np.max(abs(self.xs), axis=0)
        return np.where(sizes == 0, 1, sizes)


class _Candidate(NamedTuple):
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
class _Flight:
    """A stretch of an orbit in one mode, in times that may pass the end of the period."""

    start: float
    stop: float
    mode: np.ndarray
    surfaces: np.ndarray  # the surfaces of the contact at its end
    x: np.ndarray  # the state just before this contact


def _flights(orbit: Orbit) -> list[_Flight]:
    """The orbit cut at its contacts; an orbit without contacts is one endless flight."""
    t0, period = float(orbit.options.t0), float(orbit.period)
    first = np.asarray(orbit.first_mode).astype(float)
    events = orbit.events
    # A graze does not end a flight.
    ends = switches(events)
    count = ends.size
    if events is None or count == 0:
        x = np.full(orbit.x0.shape, np.nan)
        return [_Flight(-np.inf, np.inf, first, np.zeros(first.shape, bool), x)]
    ts = np.asarray(events.ts)[ends]
    # An orbit at a bifurcation has the contacts of its neighbour, which may start elsewhere.
    ts = np.where((ts < t0) | (ts > t0 + period), t0 + np.mod(ts - t0, period), ts)
    ends, ts = ends[np.argsort(ts, kind="stable")], np.sort(ts)
    modes = np.asarray(events.modes)[ends].astype(float)
    # The contact at the end of each flight.
    members = np.roll(np.asarray(events.members)[ends], -1, axis=0)
    xs = np.roll(np.asarray(events.xs)[ends], -1, axis=0)
    stops = np.append(ts[1:], ts[0] + period)
    return [_Flight(ts[i], stops[i], modes[i], members[i], xs[i]) for i in range(count)]


def guesses(orbit: Orbit, *kinds: str) -> list[list[tuple[Tangency, Array]]]:
    """For every lane the nearest candidates for a bifurcation of one of these kinds, each with a
    flag that it is missing. A lane without candidates, or with a failed orbit, has one of NaN."""
    with _concrete(orbit):
        if orbit.x0.ndim == 1:
            return [_guesses(orbit, kinds)]
        return [_guesses(part_of(orbit, i), kinds) for i in range(orbit.x0.shape[0])]


def approaches(orbit: Orbit) -> list[tuple[Tangency, Array]]:
    """The nearest candidates for the margin of one orbit, as in `guesses`, up to the least minimum
    of a guard, which is missing at a tick."""
    with _concrete(orbit):
        if not is_successful(orbit.result):
            return [_nowhere(orbit)]
        steps, found = _candidates(orbit, "grazing")
        tried = []
        for one in _nearest(found):
            nowhere = one.minimum == "abrupt"
            tried.append(_nowhere(orbit) if nowhere else (_tangency(steps, one), array_of(False)))
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


def attempts(
    orbit: Orbit, lanes: list[list[tuple[Tangency, Array]]]
) -> Iterator[tuple[Tangency, Array]]:
    """The result of `guesses`, one candidate of each lane at a time, batched like the orbit. Lanes
    with fewer candidates repeat their last one."""
    for i in range(max(len(lane) for lane in lanes)):
        tried = [lane[min(i, len(lane) - 1)] for lane in lanes]
        yield tried[0] if orbit.x0.ndim == 1 else jax.tree.map(lambda *v: jnp.stack(v), *tried)


def _guesses(orbit: Orbit, kinds: tuple[str, ...]) -> list[tuple[Tangency, Array]]:
    found = tangency_candidates(orbit, *kinds) if is_successful(orbit.result) else []
    return [(tangency, array_of(False)) for _, tangency in found] or [_nowhere(orbit)]


def _nowhere(orbit: Orbit) -> tuple[Tangency, Array]:
    """A candidate of NaN, which is missing."""
    nan, mode = jnp.full_like(orbit.period, jnp.nan), orbit.first_mode.astype(orbit.period.dtype)
    surface, struck = jnp.zeros((), jnp.int32), array_of(np.False_)
    return Tangency(orbit.x0, nan, nan, nan, mode, surface, nan, struck), array_of(True)


def tangency_candidates(orbit: Orbit, *kinds: str) -> list[tuple[float, Tangency]]:
    """The candidates of each surface for a bifurcation of one of these kinds, nearest first, each
    with the time by which the orbit misses it (or is past it)."""
    steps, found = _candidates(orbit, *kinds)
    smooth = [one for one in found if one.minimum != "abrupt"]
    return [(one.reach, _tangency(steps, one)) for one in _nearest(smooth)]


def _candidates(orbit: Orbit, *kinds: str) -> tuple[_Steps, list[_Candidate]]:
    """The steps of an orbit, and all candidates on them, nearest first."""
    flights, steps = _flights(orbit), _steps(orbit)
    found: list[_Candidate] = []
    for kind, j in itertools.product(kinds, range(flights[0].mode.size)):
        arrives = FAMILIES[kind] == ARRIVAL
        for i, flight in enumerate(flights):
            before, after = flights[i - 1], flights[(i + 1) % len(flights)]
            found += _short(flight, before, after, j, kind, len(flights))
            found += (_arrivals if arrives else _impacts)(steps, flight, after, j, kind)
        if not arrives:
            found += _minima(steps, flights, j, kind)
    found.sort(key=lambda one: one.reach)
    # Two kinds have the same minima.
    first = {(one.j, one.middle): one for one in reversed(found)}
    return steps, list(reversed(first.values()))


def _nearest(found: list[_Candidate]) -> list[_Candidate]:
    """The nearest candidates of each surface."""
    nearest, count = [], collections.Counter[int]()
    for one in found:
        count[one.j] += 1
        if count[one.j] <= _CANDIDATES:
            nearest.append(one)
    return nearest


def _steps(orbit: Orbit) -> _Steps:
    """The steps of an orbit."""
    dense = orbit.dense()
    real = np.isfinite(np.asarray(dense.ts))
    ts, xs = np.asarray(dense.ts)[real], np.asarray(dense.xs)[real]
    count = cubics_of(tableau_of(dense.stepper))
    if count == 1:
        return _Steps(orbit, ts, xs)
    lengths = np.diff(ts, append=ts[-1])
    divided = ts[:, None] + lengths[:, None] * (np.arange(count) / count)
    states = np.array(_states(dense, _filled(divided.ravel())))[: divided.size]
    states = states.reshape(*divided.shape, -1)
    states[:, 0] = xs
    # A step of length zero, a jump, has no parts.
    parts = (np.arange(count) == 0) | (lengths[:, None] > 0)
    return _Steps(orbit, divided[parts], states[parts])


@eqx.filter_jit
def _states(dense: Dense, ts: Array) -> Array:
    """The states at many times."""
    return jax.vmap(ft.partial(evaluate, dense))(ts)


def _short(
    flight: _Flight, before: _Flight, after: _Flight, j: int, kind: str, count: int
) -> list[_Candidate]:
    """A flight that may be born in the bifurcation, as its length and the tangency there."""
    a, b, c = before.mode[j], flight.mode[j], after.mode[j]
    patterns = {
        "grazing": a != 0 and c == a and b == -a,
        "grazing-sliding": a != 0 and c == a and b == 0,
        "adding-sliding": a == 0 and c == 0 and b != 0,
        "crossing-sliding": a != 0 and b == 0 and c == -a,
        "switching-sliding": a != 0 and b == -a and c == 0,
    }
    if not patterns[kind] or count < 2:
        return []
    side = {"adding-sliding": b, "crossing-sliding": c, "switching-sliding": b}.get(kind, a)
    # Half into the neighbours, because the flight without the short piece continues there, on
    # either side of the bifurcation.
    length = flight.stop - flight.start
    left = flight.start - 0.5 * (before.stop - before.start)
    right = flight.stop + 0.5 * (after.stop - after.start)
    middle = flight.start if FAMILIES[kind] == ARRIVAL else flight.start + 0.5 * length
    return [_Candidate(length, j, side, before.mode, left, middle, right)]


def _minima(steps: _Steps, flights: list[_Flight], j: int, kind: str) -> list[_Candidate]:
    """Minima of the guard on all flights, with the time in which it would reach zero."""
    sliding, found, height = FAMILIES[kind] == SLIDE, [], float(np.finfo(steps.xs.dtype).tiny)
    for i, flight in enumerate(flights):
        if (flight.mode[j] == 0) == sliding:
            least, highest = _minima_of(steps, flight, j)
            found += least
            if not sliding:
                found += _abrupt(steps, flight, flights[(i + 1) % len(flights)], j)
            height = max(height, highest)
    # The time of a sine with the guard's amplitude on the whole orbit. Among the minima of all
    # flights the lowest one is first.
    return [
        one._replace(reach=float(np.sqrt(max(one.reach, 0) / height) * steps.period / np.pi))
        for one in found
    ]


def _minima_of(steps: _Steps, flight: _Flight, j: int) -> tuple[list[_Candidate], float]:
    """Minima of the guard of a flight, with their values for a reach, and its largest value."""
    ts, period = steps.ts, steps.period
    # A flight may pass the end of the period; its steps are searched a period earlier and later.
    times = np.concatenate([ts[:-1] - period, ts[:-1], ts[:-1] + period])
    states = np.tile(steps.xs[:-1], (3, 1))
    low, high = max(flight.start, ts[0] - 0.5 * period), min(flight.stop, ts[-1] + period)
    inside = (times > low) & (times < high)
    times, states = times[inside], states[inside]
    if times.size < 2:
        return [], 0.0
    mode, stepper = array_of(flight.mode), steps.orbit.options.stepper
    rows = _filled(times), _filled(states), mode, j
    after = _guards(steps.orbit.system, *rows, stepper, 1.0)
    guard, rate, weight = (np.asarray(v)[: times.size] for v in after)
    before, arrives = guard, rate
    if steps.orbit.system.clocks:
        ends = _guards(steps.orbit.system, *rows, stepper, -1.0)
        before, arrives, _ = (np.asarray(v)[: times.size] for v in ends)
    found, first = [], max(flight.start, ts[0])

    def add(least: float, at: float, weight: float, minimum: str) -> None:
        if not first <= at < first + period:  # once in an endless flight
            return
        side = np.sign(weight) if flight.mode[j] == 0 else flight.mode[j]
        left = at - min(0.5 * (at - flight.start), 0.25 * period)
        right = at + min(0.5 * (flight.stop - at), 0.25 * period)
        mode = flight.mode
        found.append(_Candidate(least, j, side, mode, left, at, right, minimum=minimum))

    length = np.diff(times)
    for k in np.flatnonzero((rate[:-1] < 0) & (arrives[1:] >= 0) & (length > 0)).tolist():
        # Not at the ends of steps, where a higher minimum may seem to be the lower one.
        ends = (guard[k], before[k + 1]), (rate[k], arrives[k + 1])
        part, least = least_between(length[k], *ends)
        add(float(least), float(times[k] + part * length[k]), weight[k], "smooth")
    # At a tick the field may jump. The steps have it as steps of length zero.
    opens = np.flatnonzero(np.append(length > 0, True))
    closes = np.flatnonzero(np.append(True, length > 0))
    ends = (before[closes], arrives[closes]), (guard[opens], rate[opens])
    for i in np.flatnonzero((opens > closes) & _is_abrupt(*ends, abs(guard[opens]))).tolist():
        k = opens[i]
        add(float(min(before[closes[i]], guard[k])), float(times[k]), float(weight[k]), "abrupt")
    return found, float(np.max(guard))


def _abrupt(steps: _Steps, flight: _Flight, after: _Flight, j: int) -> list[_Candidate]:
    """A minimum at the end of a flight, where the state or the field jumps by a tick or at another
    surface."""
    at, side = after.start, flight.mode[j]
    if flight.surfaces[j] or after.mode[j] != side or not np.isfinite(at):
        return []
    late = at + resolution(steps.ts[0], steps.ts[-1], max)
    x = steps.xs[np.searchsorted(steps.ts, late, side="right") - 1]
    before, behind = (
        _guard_at(steps, one, j, at, x, way)
        for one, x, way in ((flight, flight.x, -1.0), (after, x, 1.0))
    )
    if not _is_abrupt(before, behind, np.maximum(abs(before[0]), abs(behind[0])))[0]:
        return []
    least, stop = float(np.minimum(before[0], behind[0])[0]), flight.stop
    return [_Candidate(least, j, side, flight.mode, stop, stop, stop, minimum="abrupt")]


def _guard_at(
    steps: _Steps, flight: _Flight, j: int, at: float, x: np.ndarray, way: float
) -> tuple[np.ndarray, np.ndarray]:
    """The guard of a flight and its rate just before or after an instant."""
    rows = _filled(np.array([at], steps.ts.dtype)), _filled(x[None]), array_of(flight.mode), j
    guard, rate, _ = _guards(steps.orbit.system, *rows, steps.orbit.options.stepper, way)
    return np.asarray(guard), np.asarray(rate)


def _is_abrupt(
    before: tuple[np.ndarray, np.ndarray], after: tuple[np.ndarray, np.ndarray], size: np.ndarray
) -> np.ndarray:
    """Whether a guard, with these values and rates before and after an instant, is least there."""
    jump = after[0] - before[0]
    falls, rises = before[1] < 0, after[1] >= 0
    rounding = np.finfo(size.dtype).eps ** 0.5 * size
    higher, lower = jump > rounding, jump < -rounding
    return np.where(higher, falls, np.where(lower, rises, falls & rises))


def _filled(rows: np.ndarray) -> Array:
    """Rows padded with the last one to a power of two."""
    return array_of(rows[np.minimum(np.arange(power_of_two(len(rows))), len(rows) - 1)])


@eqx.filter_jit
def _guards(
    system: System, ts: Array, xs: Array, mode: Array, j: int, stepper: Stepper, way: float
) -> tuple[Array, Array, Array]:
    """The guard of surface j, its rate and the sliding weight at many points of a flight, at a tick
    just after it if time goes the `way` +1, and just before it if −1."""

    def one(t: Array, x: Array) -> tuple[Array, Array, Array]:
        on_components = lowered.build(system, x, compact=True)
        grid = even_grid(t, jnp.asarray(way, t.dtype), jnp.int32(1))
        problem = problem_of(on_components, tableau_of(stepper), grid)
        on_components = clocks.just_after(problem, t).system
        modes = on_components.of_surfaces(mode)

        def guard(t: Array, x: Array) -> Array:
            return filippov.guard(on_components, t, on_components.unpack(x), modes).number(j)

        blocks = on_components.unpack(x)
        field = pack(filippov.field(on_components, t, blocks, modes), x.dtype)
        weight = jnp.zeros((), x.dtype)
        if on_components.slides:
            _, rates = filippov.corners(on_components, t, blocks)
            weight = sliding_weights.weights(modes, rates).number(j)
        return *jax.jvp(guard, (t, x), (jnp.ones_like(t), field)), weight

    return jax.vmap(one)(ts, xs)


def _impacts(steps: _Steps, flight: _Flight, after: _Flight, j: int, kind: str) -> list[_Candidate]:
    """Impacts, with the time in which the rate of approach would vanish."""
    side = flight.mode[j]
    if kind != "grazing" or not flight.surfaces[j] or side == 0 or after.mode[j] != side:
        return []
    reach, there = _reach(steps, flight, j, side)
    struck = bool(_is_struck(steps.orbit.system, there, array_of(steps.sizes)))
    period, at = steps.period, flight.stop
    left = at - min(0.5 * (at - flight.start), 0.25 * period)
    # After a reset the orbit is another one, and the full flow follows it.
    ahead = 0.0 if struck else min(0.5 * (after.stop - after.start), 0.25 * period)
    return [_Candidate(reach, j, side, flight.mode, left, at, at + ahead, struck)]


@eqx.filter_jit
def _is_struck(system: System, there: Tangency, sizes: Array) -> Array:
    """Whether the reset of a contact changes the state where the rate of approach is zero, the
    nearest such state in the scales of the orbit."""
    rate, slope = approach(system, there)
    slope = slope * sizes
    square = slope @ slope
    x = there.x - sizes * slope * rate / select(square == 0, 1, square)
    jump = system.reset(there.phase, x, there.surface) - x
    return jnp.max(abs(jump) / sizes) > _JUMP


def _reach(steps: _Steps, flight: _Flight, j: int, side: float) -> tuple[float, Tangency]:
    """The time in which Ḣ_s at the end of a flight would vanish, and that end."""
    # Of a reset the state before it; the steps have the one after it.
    x = array_of(flight.x)
    at = array_of(flight.stop, x.dtype)
    there = Tangency(
        x,
        phase=at,
        start=at,
        stop=at,
        mode=array_of(flight.mode, x.dtype),
        surface=array_of(j, jnp.int32),
        side=array_of(side, x.dtype),
        struck=array_of(np.False_),
    )
    found = conditions(steps.orbit.system, at, x, there)
    return abs(float(found.rate)) / max(abs(float(found.bend)), 1e-300), there


def _arrivals(
    steps: _Steps, flight: _Flight, after: _Flight, j: int, kind: str
) -> list[_Candidate]:
    """Contacts at which the orbit arrives near the end of the sliding region, with the time in
    which Ḣ_s would vanish."""
    a, c = flight.mode[j], after.mode[j]
    crosses, sticks = a != 0 and c == -a, a != 0 and c == 0
    if not flight.surfaces[j] or not (crosses or (sticks and kind == "switching-sliding")):
        return []
    at = flight.stop
    reach, _ = _reach(steps, flight, j, -a)
    left = at - min(0.5 * (at - flight.start), 0.25 * steps.period)
    return [_Candidate(reach, j, -a, flight.mode, left, at, at)]


def _tangency(steps: _Steps, found: _Candidate) -> Tangency:
    """The tangency as arrays, with its flight shifted to start within the known period."""
    t0, period, dtype = float(steps.orbit.options.t0), steps.period, steps.xs.dtype
    times = found.left, found.middle, found.right
    shift = period * np.floor((found.left - t0) / period)
    left, middle, right = (min(v - shift, t0 + 2 * period) for v in times)
    # Newton's method corrects it with the rest of the guess, which is no more exact.
    x = np.array([np.interp(left, steps.ts, v) for v in steps.xs.T])
    return Tangency(
        x=array_of(x, dtype),
        phase=array_of(middle / period, dtype),
        start=array_of(left / period, dtype),
        stop=array_of(right / period, dtype),
        mode=array_of(found.mode, dtype),
        surface=array_of(found.j, jnp.int32),
        side=array_of(found.side, dtype),
        struck=array_of(np.bool_(found.struck)),
    )
