"""The cubic of a section within a step: its first crossing, and whether it can be trusted.

A step of a Taylor method may be longer than a period of the motion. Where the motion is known as a
polynomial, the sections on it are compared with their cubics, and a part of a step on which they
differ is searched half by half. Under a tolerance a step may be of any length where the state is
exact in it, as while a mass sticks; such a step is refused until the cubics follow the sections.
"""

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import NEVER, SUSPICIOUS, Cubic, first_contact, lower_bound
from jaxfil.integrate.contacts.guards import NOISE
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, Motion
from jaxfil.integrate.lane.step_length import typical_step
from jaxfil.integrate.loop.section_state import Watch
from jaxfil.integrate.surfaces.sections import Sight, WatchedSections, see
from jaxfil.integrate.system.components import Components, any_of, largest, on_each, sign, where
from jaxfil.integrate.system.smooth_field import Polynomial, horner
from jaxfil.xla.select import select

# Orders for each comparison in a step. A step of order p extends over some 0.3 p radians of the
# fastest oscillation.
_ORDERS = 8
# The shortest part of a step that is halved, since a kink of a section fits no cubic.
_SHORTEST = 1 / 64
# A section whose cubic is off by less than this part of its lower bound is far from zero.
_CLEAR = 1 / 4
# The fractions of a step at which a section is compared with its cubic under a tolerance. At the
# middle alone, one of the period of the step would not be seen.
_FRACTIONS = 0.2, 0.5, 0.7


def is_unresolved(
    watched: WatchedSections,
    problem: Problem,
    motions: tuple[Motion, Motion],
    sights: tuple[Watch, Sight],
    here: Array,
    path: Polynomial,
) -> Array:
    """Whether a section differs from its cubic between the start of the watch and a length `here`.
    `motions` are those at both ends of the step, and the sections are those at the start of the
    watch and `here`."""
    (start, end), (watch, sight) = motions, sights
    here, path = stop_gradient((here, path))
    h = here - watch.start
    cubic = watch.value, h * watch.rate, stop_gradient(sight.value), h * sight.rate
    noise = resolved(problem, sight)[1]
    count = max(1, (len(path.x) - 1) // _ORDERS)
    unlike = jnp.zeros((), bool)
    for i in range(count):
        theta = (i + 0.5) / count
        length = watch.start + theta * h
        t = problem.grid.t0 + start.tau + length
        x = path.at(length / select(path.h == 0, 1.0, path.h))
        each = range(len(watched.functions))
        values = [watched.value(j, problem.system, end.mode)(t, x) for j in each]
        off = on_each(lambda *v, at=theta: _deviation(at, *v), Components(values), noise, *cubic)
        unlike = unlike | any_of(stop_gradient(off) > 1)
    # The path of a rest is right at its end alone.
    long = abs(h) > _SHORTEST * abs(path.h)
    return unlike & long & ~path.ends & ~any_of(watch.owed)


def error_of_sections(
    watched: WatchedSections,
    problem: Problem,
    state: LoopState,
    watch: Watch,
    h: Array,
    end: Motion,
    path: Polynomial | None,
) -> Array:
    """The largest deviation of a section from its cubic in a trial step of length h, relative to
    the allowed one, as an error of the order of the stepper."""
    start, dt = state.motion, typical_step(problem, state)
    at = problem.grid.t0 + end.tau, end.x
    sight = see(watched, problem.system, at, (end.mode, end.f), end.scale, dt)
    start, end, sight = stop_gradient((start, end, sight))
    cubic = watch.value, h * watch.rate, sight.value, h * sight.rate
    # Hermite's cubic of the state, whose own error the stepper's estimate limits.
    rise, f0, f1 = end.x - start.x, h * start.f, h * end.f
    motion, off = (start.x, f0, 3 * rise - 2 * f0 - f1, f0 + f1 - 2 * rise), jnp.zeros_like(h)
    for theta in _FRACTIONS:
        at = problem.grid.t0 + start.tau + theta * h, horner(motion, jnp.asarray(theta, h.dtype))
        each = range(len(watched.functions))
        values = [watched.value(i, problem.system, end.mode)(*at) for i in each]
        noise = resolved(problem, sight)[1]
        one = on_each(lambda *v, at=theta: _deviation(at, *v), Components(values), noise, *cubic)
        off = jnp.maximum(off, largest(stop_gradient(one)))
    # Probes belong to a step that has been accepted already. On a path it is the search that is
    # refined (`is_unresolved`), since a step along it is longer than a cubic reaches; but while a
    # motion is held even a path has no longest step.
    whole = ~watch.seeking & (watch.start == 0)
    if path is not None:
        whole = whole & (path.ends | state.held)
    return select(whole, off, 0.0) ** (problem.tableau.order / 4)


def _deviation(
    theta: float, value: Array, noise: Array, g0: Array, d0: Array, g1: Array, d1: Array
) -> Array:
    """The distance of a value from the cubic, relative to the one that the search allows."""
    inner = 4 * theta * (1 - theta)
    allowed = SUSPICIOUS * inner * inner * (abs(d0) + abs(d1))
    allowed = jnp.maximum(allowed, _CLEAR * abs(_least(g0, d0, g1, d1)))
    allowed = jnp.maximum(allowed, 4 * noise)
    off = abs(value - Cubic(g0, d0, g1, d1)(jnp.asarray(theta, g0.dtype)))
    # A constant section without rounding has an allowance of zero, and is no farther away.
    return select(off > 0, off / select(allowed > 0, allowed, 1), 0.0)


def _least(*ends: Array) -> Array:
    """A lower bound of the absolute value of a cubic; 0 if it may be zero."""
    g0, d0, g1, d1 = ends
    below, above = lower_bound(*ends), lower_bound(-g0, -d0, -g1, -d1)
    return jnp.maximum(jnp.maximum(below, above), 0.0)


def resolved(problem: Problem, sight: Sight) -> tuple[Components, Components]:
    """Whether |S| exceeds its rounding error, and that error."""
    noises = NOISE * problem.system.eps * sight.terms
    return abs(stop_gradient(sight.value)) > noises, noises


def first_of_one(
    g0: Array, d0: Array, g1: Array, d1: Array, away: Array, noise: Array, wanted: Array
) -> tuple[Array, Array]:
    """θ of the first crossing of one section, with S multiplied by the side it comes from, and θ of
    a minimum to examine."""
    theta, low = first_contact(g0, d0, g1, d1, away, noise)
    over = g1 < -noise
    # If S is zero at the start and decreases, the crossing is at the start.
    theta = select((g0 < -noise) | (~away & (d0 <= 0) & over), 0.0, theta)
    # A crossing in the unwanted direction, without a later one, need not be located.
    passed = ~wanted & over
    return select(passed, NEVER, theta), select(passed, NEVER, low)


def nothing(g0: Array, *_: Array) -> tuple[Array, Array]:
    """The same for a section that is far from zero."""
    return jnp.full_like(g0, NEVER), jnp.full_like(g0, NEVER)


def is_wanted(watched: WatchedSections, problem: Problem, side: Components) -> Components:
    """Whether a crossing from these sides, along the motion, is in the section's direction. That is
    a direction of growing time, but a bound is left in either direction of time."""
    wanted = Components(watched.directions)
    along = Components(1 if bound else problem.grid.direction for bound in watched.bounds)
    return (side * along * wanted < 0) | (wanted == 0)


def sides_from(problem: Problem, watch: Watch, sight: Sight, h: Array) -> Components:
    """The sides from which sections start; for a section that is zero at the start, the side that
    the motion takes."""
    before, after, then = h * watch.rate, h * sight.rate, stop_gradient(sight.value)
    tells = abs(before) > problem.system.eps**0.5 * (abs(then) + abs(after))
    return where(watch.side == 0, sign(where(tells, before, then)), watch.side)
