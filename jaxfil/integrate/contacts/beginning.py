"""Beginnings: how a run starts on surfaces with resets.

A state on surfaces enters; leave the sides that it starts on, the surfaces that it rests on, and
those whose reset is owed: what a state says of the past is whether a reset can have led to it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.step_length import typical_step
from jaxfil.integrate.surfaces import unilateral
from jaxfil.integrate.surfaces.unilateral import Constraints
from jaxfil.integrate.system.components import Components, any_of, pack, where
from jaxfil.integrate.system.lowered import ComponentSystem

# Rounding of H and of states, in eps of their terms.
_NOISE = 64


class Beginning(eqx.Module):
    """How a run starts on surfaces with resets. Components are m."""

    sides: Components
    """The side to start on, where nothing else is said."""
    known: Components
    """Surfaces on which no mode is to be chosen."""
    owed: Components
    """Surfaces whose reset comes first."""
    still: Components
    """Surfaces without a rate, that may be rested on."""
    rests: Components
    """Surfaces rested on; of several surfaces with the field on side + alone."""
    consistent: Array
    """Whether their reactions are all that is needed."""
    constraints: Constraints
    """The surfaces as constraints."""
    by_time: Components
    """∂ψ/∂t of these."""


def begin(
    problem: Problem, x: Components, on: Components, sides: Components, rates: Components
) -> Beginning:
    """How a run starts on the surfaces marked `on`, given the rates of H on side + with the sign of
    the first derivative that does not vanish.

    A surface that throws back bounds H ≥ 0: a motion towards H < 0 is an impact at t0, one that
    has no rate and is pressed rests, any other has left. Any other surface is met from where the
    motion comes, by the sign of its rate, and the reset is owed if no reset can have led to this
    state. If one can, as to one whose kick is a sum, it has been made: the span is half open. So it
    has on a surface in time alone, as at a tick. Backward in time only that is undone which leads
    to where the motion comes from.
    """
    system, t, direction = problem.system, problem.grid.t0, problem.grid.direction
    above = sides.like(jnp.ones_like(t))
    c = unilateral.constraints(system, t, x, above)
    f = system.field(t, x, above)
    a = unilateral.accelerations(system, t, x, above, f)
    _, h_t, normals = system.gradients(t, x)
    inside, surfaces = system.rate_rounding(t, x, above), (h_t, normals)
    by_time, dt = a - c.gradients @ f, typical_step(problem)
    noise = unilateral.rate_noise(t, abs(x), inside, dt, f, c, by_time, surfaces)
    flat, wall = abs(c.rate) <= noise, on & c.throws_back
    rounding = _NOISE * system.eps * (abs(normals) @ abs(x))
    seen = stop_gradient(_traces(system, t, x, on & ~c.throws_back, rounding))
    side = where(direction * rates < 0, above, -1.0)
    timed = abs(normals) @ x.like(jnp.ones_like(t)) == 0
    returns = (abs(seen.h) > rounding) & (side * seen.h > 0)
    back = on & ~c.throws_back & ~flat
    back = back & (returns | (seen.unmade & ~timed & (direction > 0)))
    owed = (wall & (direction * rates < 0) & ~flat) | back
    start = where(wall, 1.0, where(back, side, sides))
    # Of a rate that is rounding not even the sign is known: the acceleration decides, and where
    # that vanishes the first higher derivative that does not.
    lean = where(flat, where(a != 0, direction * a, rates), a)
    rests, consistent = unilateral.pressed(c.reaction, lean, above, wall & flat)
    return Beginning(
        sides=start,
        known=wall | back,
        owed=owed,
        still=wall & flat,
        rests=rests,
        consistent=consistent,
        constraints=c,
        by_time=by_time,
    )


class Trace(eqx.Module):
    """What a state on a surface says of the reset of that surface. Components are m."""

    h: Components
    """H where the reset leads to."""
    unmade: Components
    """Whether no reset can have led to this state: this one moves it, and made twice it is made
    once, or leads off the surface."""


def _traces(
    system: ComponentSystem, t: Array, x: Components, on: Components, noise: Components
) -> Trace:
    """What a state says of the resets of its surfaces, given the rounding of H there."""

    def own(number: Array) -> tuple[Array, Array, Array]:
        once = system.reset(t, x, number)
        twice = system.reset(t, once, number)
        h = pack(system.switching(t, once), system.dtype)[number]
        return h, _differ(once, x), _differ(twice, once)

    if system.packed:
        found = jax.vmap(own)(jnp.arange(system.m, dtype=jnp.int32))
        h, moved, again = (Components([v]) for v in found)
    else:
        each = zip(*(own(jnp.int32(j)) for j in range(system.m)), strict=True)
        h, moved, again = map(Components, each)
    return Trace(h, moved & (~again | (abs(h) > noise)) & _changed(system, t, x, on))


def _changed(system: ComponentSystem, t: Array, x: Components, on: Components) -> Array:
    """Whether the resets of the surfaces that a state is on, made in turn, lead elsewhere. Of
    resets that undo each other, in the state that all of them have led to, they do not."""
    numbers = pack(on, bool)

    def made(j: Array, x: Components) -> Components:
        return where(numbers[j], system.reset(t, x, jnp.asarray(j, jnp.int32)), x)

    if system.m == 1:
        return _differ(made(jnp.int32(0), x), x)
    return _differ(jax.lax.fori_loop(0, system.m, made, x), x)


def _differ(a: Components, b: Components) -> Array:
    """Whether two states differ by more than rounding."""
    size = abs(a) + abs(b)
    return any_of(abs(a - b) > _NOISE * float(jnp.finfo(size.parts[0].dtype).eps) * size)
