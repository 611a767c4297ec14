"""The cubic of a section within a step: its first crossing, and whether it can be trusted.

A step of a Taylor method may be longer than a period of the motion. Where the motion is known as a
polynomial, the sections on it are compared with their cubics, and a part of a step on which they
differ is searched half by half.
"""

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import NEVER, SUSPICIOUS, Cubic, first_contact, lower_bound
from jaxfil.integrate.contacts.guards import NOISE
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import Motion
from jaxfil.integrate.loop.section_state import Watch
from jaxfil.integrate.surfaces.sections import Sight, WatchedSections
from jaxfil.integrate.system.components import Components, Polynomial, any_of, on_each
from jaxfil.xla.select import select

# Orders for each comparison in a step. A step of order p extends over some 0.3 p radians of the
# fastest oscillation.
_ORDERS = 8
# The shortest part of a step that is halved, since a kink of a section fits no cubic.
_SHORTEST = 1 / 64
# A section whose cubic is off by less than this part of its lower bound is far from zero.
_CLEAR = 1 / 4


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
        differs = on_each(lambda *v, at=theta: _differs(at, *v), Components(values), noise, *cubic)
        unlike = unlike | any_of(stop_gradient(differs))
    # The path of a rest is right at its end alone.
    long = abs(h) > _SHORTEST * abs(path.h)
    return unlike & long & ~path.ends & ~any_of(watch.owed)


def _differs(
    theta: float, value: Array, noise: Array, g0: Array, d0: Array, g1: Array, d1: Array
) -> Array:
    """Whether a value is farther from the cubic than the search allows."""
    inner = 4 * theta * (1 - theta)
    allowed = SUSPICIOUS * inner * inner * (abs(d0) + abs(d1))
    allowed = jnp.maximum(allowed, _CLEAR * abs(_least(g0, d0, g1, d1)))
    return abs(value - Cubic(g0, d0, g1, d1)(jnp.asarray(theta, g0.dtype))) > jnp.maximum(
        allowed, 4 * noise
    )


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
