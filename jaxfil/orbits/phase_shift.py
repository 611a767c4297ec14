"""Change of the phase at which the orbits of a branch are shot, if a contact or a tick reaches it.

As one passes the phase t0 the orbit varies smoothly, but x(t0) jumps by a reset, or has a corner.
The branch is then shot from a phase far from all of them, and its points are converted back to t0.
"""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.lane.problem import NOTHING
from jaxfil.integrate.loop.iterate import integrate
from jaxfil.integrate.run.solution import Events, switches
from jaxfil.integrate.system.components import pack
from jaxfil.model.system import System
from jaxfil.orbits.closing import OrbitProblem
from jaxfil.orbits.corrector import OrbitPoint
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.known import array_of

# A contact is at the phase if it is nearer than this fraction of the period.
_NEAR = 1e-3


def contact_phases(problem: OrbitProblem, point: OrbitPoint) -> np.ndarray:
    """The phases of contacts and ticks after t0, as fractions of the period from 0 to 1,
    ascending."""
    system, period = _setting(problem, point)
    return _phases(system, point.shot.events, float(problem.options.t0), period)


def _phases(system: System, events: Events | None, t0: float, period: float) -> np.ndarray:
    ts = []
    if events is not None:
        ts.append(np.asarray(events.ts)[switches(events)])
    # The events of a system without surfaces are not recorded.
    for clock in system.clocks:
        step = float(clock.period)
        ts.append(float(clock.phase) + step * np.arange(np.ceil(period / step)))
    return np.sort((np.concatenate([np.zeros(0), *ts]) - t0) / period % 1.0)


def quiet_between(a: Orbit, b: Orbit, t0: float) -> float | None:
    """The middle of the longest time in which neither of two neighbours on a branch has a contact
    or a tick, as a fraction of the period after t0, if one of these passes t0 between them, or if
    one of the two starts elsewhere; otherwise None."""
    first, second = (_phases(v.system, v.events, t0, float(v.period)) for v in (a, b))
    if not first.size or first.size != second.size:
        return None

    def turned(shift: int) -> np.ndarray:
        number = np.arange(first.size) + shift
        return second[number % first.size] + number // first.size

    # Each contact of one belongs to the nearest of the other, in the same order.
    shifts = sorted(range(-first.size, first.size + 1), key=abs)
    best = min(shifts, key=lambda shift: np.max(abs(turned(shift) - first)))
    if best == 0 and float(a.options.t0) == float(b.options.t0):
        return None
    low, high = np.maximum(first, turned(best)), np.minimum(first, turned(best))
    return _middle_of_longest(low, np.append(high[1:], high[0] + 1))


def _middle_of_longest(starts: np.ndarray, ends: np.ndarray) -> float:
    """The middle of the longest of some intervals, as a phase."""
    longest = int(np.argmax(ends - starts))
    return float((starts[longest] + 0.5 * (ends - starts)[longest]) % 1.0)


def state_at(orbit: Orbit, t0: float, part: float) -> Array:
    """The state of an orbit at a fraction of its period after t0."""
    start, period = float(orbit.options.t0), float(orbit.period)
    t = start + (t0 + part * period - start) % period
    return orbit.states(array_of([t], orbit.x0.dtype))[0]


def _setting(problem: OrbitProblem, point: OrbitPoint) -> tuple[System, float]:
    """The system and the period of an orbit."""
    _, q = problem.split(array_of(point.u))
    system, period = problem.setting(q)
    return system, float(np.asarray(period))


def period_of(problem: OrbitProblem, point: OrbitPoint) -> float:
    """The period of an orbit."""
    return _setting(problem, point)[1]


def quiet_phase(problem: OrbitProblem, point: OrbitPoint) -> float | None:
    """The middle of the longest time without a contact or a tick, as a fraction of the period after
    t0, if one is at t0; otherwise None. Not for several arcs."""
    if problem.options.arcs > 1:
        return None
    phases = contact_phases(problem, point)
    if not phases.size or np.min(np.minimum(phases, 1 - phases)) > _NEAR:
        return None
    return _middle_of_longest(phases, np.append(phases[1:], phases[0] + 1))


def problem_at(problem: OrbitProblem, t0: float) -> OrbitProblem:
    """The same orbits, shot from another phase."""
    before = problem.options.t0
    options = dataclasses.replace(problem.options, t0=array_of(t0, before.dtype))
    return dataclasses.replace(problem, options=options)


def seen_from(problem: OrbitProblem, point: OrbitPoint, part: float) -> np.ndarray:
    """The unknowns of a point of the problem, with its state at a fraction of the period after
    t0."""
    u = array_of(point.u)
    state = _later(problem, u, array_of(part, u.dtype))
    n = np.shape(point.shot.ends)[-1]
    return np.append(np.asarray(state), point.u[n:])


@eqx.filter_jit
def _later(problem: OrbitProblem, u: Array, part: Array) -> Array:
    starts, q = problem.split(u)
    system, period = problem.setting(q)
    options, x = problem.options, starts[0]
    run = options.problem(system, x, options.t0, part * period, 1)
    run = dataclasses.replace(run, recording=NOTHING)
    return pack(integrate(run, run.system.unpack(x)).motion.x, u.dtype)
