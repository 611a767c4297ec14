"""Minima of the guard of a surface on the flights of an orbit.

Most are smooth. Where the state or the field jumps, at a tick or at another surface, a guard may be
least without a tangency.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.bifurcations.flights import Candidate, Flight, Steps, filled
from jaxfil.bifurcations.tangency import FAMILIES, SLIDE, least_between
from jaxfil.integrate.lane import clocks
from jaxfil.integrate.lane.problem import even_grid
from jaxfil.integrate.loop.extensions import problem_of
from jaxfil.integrate.run.options import resolution
from jaxfil.integrate.steppers.explicit import Stepper, tableau_of
from jaxfil.integrate.surfaces import filippov, weights as sliding_weights
from jaxfil.integrate.system import lowered
from jaxfil.integrate.system.components import pack
from jaxfil.model.system import System
from jaxfil.xla.known import array_of


def minima(steps: Steps, flights: list[Flight], j: int, kind: str) -> list[Candidate]:
    """Minima of the guard on all flights, with the time in which it would reach zero."""
    sliding, found, height = FAMILIES[kind] == SLIDE, [], float(np.finfo(steps.xs.dtype).tiny)
    for i, flight in enumerate(flights):
        if (flight.mode[j] == 0) == sliding:
            least, highest = _on_flight(steps, flight, j)
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


def _on_flight(steps: Steps, flight: Flight, j: int) -> tuple[list[Candidate], float]:
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
    rows = filled(times), filled(states), mode, j
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
        found.append(Candidate(least, j, side, mode, left, at, right, minimum=minimum))

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


def _abrupt(steps: Steps, flight: Flight, after: Flight, j: int) -> list[Candidate]:
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
    return [Candidate(least, j, side, flight.mode, stop, stop, stop, minimum="abrupt")]


def _guard_at(
    steps: Steps, flight: Flight, j: int, at: float, x: np.ndarray, way: float
) -> tuple[np.ndarray, np.ndarray]:
    """The guard of a flight and its rate just before or after an instant."""
    rows = filled(np.array([at], steps.ts.dtype)), filled(x[None]), array_of(flight.mode), j
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
