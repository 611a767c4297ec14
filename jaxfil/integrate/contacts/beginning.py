"""Beginnings: the start of a run on surfaces with resets.

A state alone does not tell which resets have already happened. The rules here decide, from the
state, on which sides the run starts, on which surfaces it rests, and which resets are due. A reset
is due only if the state cannot be its result.
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
from jaxfil.integrate.system.components import Components, any_of, pack, side_of, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.rows import Rows

# Rounding of H and of states, in eps of their terms.
_NOISE = 64


class Thrown(eqx.Module):
    """What the resets of a state do to it, as if it were on their surfaces. Components are m."""

    back: Components
    """Whether a motion that comes with this state is thrown back."""
    flat: Components
    """Whether dH/dt is zero within rounding."""
    seen: "Trace"
    """The effect of each reset."""
    h: Components
    """H."""
    constraints: Constraints
    """The surfaces as constraints."""
    a: Components
    """d²H/dt²."""
    by_time: Components
    """∂ψ/∂t of the constraints."""
    normals: Rows
    """∂H/∂x."""


class Beginning(eqx.Module):
    """The start of a run on surfaces with resets. Components are m."""

    sides: Components
    """The side to start on, unless another rule decides."""
    beside: Components
    """Surfaces that the state is off after all."""
    known: Components
    """Surfaces whose mode is decided here."""
    owed: Components
    """Surfaces whose reset is due at t0."""
    still: Components
    """Surfaces with zero rate, on which the motion may rest."""
    rests: Components
    """Surfaces that the motion rests on; for several surfaces only with the field on side +."""
    consistent: Array
    """Whether the reactions of these are consistent (see `unilateral.pressed`)."""
    differentiable: Array
    """Whether the resets of the surfaces that it stands still on have finite derivatives, from
    which a rest follows."""
    constraints: Constraints
    """The surfaces as constraints."""
    by_time: Components
    """∂ψ/∂t of the constraints."""


def begin(
    problem: Problem,
    x: Components,
    on: Components,
    sides: Components,
    rates: Components,
    noise: Components,
) -> Beginning:
    """The start of a run on the surfaces marked `on`, given the rates of H on side + with the sign
    of the first derivative that does not vanish, and the rounding of H at this state alone.

    A surface whose reset throws back bounds H ≥ 0. A motion towards H < 0 then starts with an
    impact at t0, a pressed motion without a rate rests, and any other is off the surface. Any
    other surface is reached from the side that the motion comes from, by the sign of its rate, and
    its reset is due if the state cannot be the result of one. If it can, as for a kick that adds a
    constant, the reset counts as applied, since the span is open at t0. The same holds for a
    surface that depends on time alone, like a tick. Beyond the rounding of H at this state, by
    which the end of a run counts a contact as its own, such a state is off the surface instead.
    Backward in time a reset is only undone if the state after it is on the side from which the
    motion comes.
    """
    system, t, direction = problem.system, problem.grid.t0, problem.grid.direction
    above = sides.like(jnp.ones_like(t))
    thrown = thrown_at(problem, x)
    c, a, seen, flat = thrown.constraints, thrown.a, thrown.seen, thrown.flat
    wall = on & thrown.back
    unmade = seen.unmade & stop_gradient(_changed(system, t, x, on & ~thrown.back))
    # Along the motion H falls if the motion comes from side +.
    side = where(direction * rates < 0, above, -1.0)
    # Where ∂H/∂x = 0 the surface depends on time alone.
    timed = abs(thrown.normals) @ x.like(jnp.ones_like(t)) == 0
    returns = seen.off & (side * seen.h > 0)
    back = on & ~thrown.back & ~flat
    # A reset to the side from which the motion comes is due in either direction of time. Any other
    # can be due only forward in time.
    back = back & (returns | (unmade & ~timed & (direction > 0)))
    owed = (wall & (direction * rates < 0) & ~flat) | back
    beside = on & ~thrown.back & ~back & (abs(thrown.h) > noise)
    start = where(wall, 1.0, where(back, side, where(beside, side_of(thrown.h), sides)))
    # A rate within rounding has an unknown sign, so the acceleration decides, and where that
    # vanishes the first higher derivative that does not.
    lean = where(flat, where(a != 0, direction * a, rates), a)
    rests, consistent = unilateral.pressed(c.reaction, lean, above, wall & flat)
    return Beginning(
        sides=start,
        beside=beside,
        known=wall | back,
        owed=owed,
        still=wall & flat,
        rests=rests,
        consistent=consistent,
        differentiable=~any_of(on & flat & ~c.known),
        constraints=c,
        by_time=thrown.by_time,
    )


def thrown_at(problem: Problem, x: Components) -> Thrown:
    """What the resets at the start of a run do to its state x. It need not be on the surfaces."""
    system, t, direction = problem.system, problem.grid.t0, problem.grid.direction
    # A wall bounds H ≥ 0, so fields, rates and reactions are evaluated on side +.
    above = system.for_each_surface(jnp.ones_like(t))
    c = unilateral.constraints(system, t, x, above)
    f = system.field(t, x, above)
    a = unilateral.accelerations(system, t, x, above, f)
    h, h_t, normals = system.gradients(t, x)
    inside, surfaces = system.rate_rounding(t, x, above), (h_t, normals)
    by_time, dt = a - c.gradients @ f, typical_step(problem)
    noise = unilateral.rate_noise(system, t, abs(x), inside, dt, f, c, by_time, surfaces)
    rounding = _NOISE * system.eps * (abs(normals) @ abs(x))
    # Only flags follow from the traces, so they have no derivative.
    seen = stop_gradient(_traces(system, t, x, h, rounding))
    # Here it is unknown whether the motion comes from side +.
    incoming = direction * c.rate < -noise
    through = incoming & unilateral.lets_through(direction * seen.rate, noise)
    back = unilateral.reset_effect(system, t, x, c, normals).throws_back & ~through
    return Thrown(back, abs(c.rate) <= noise, seen, stop_gradient(h), c, a, by_time, normals)


class Trace(eqx.Module):
    """The effect of a surface's reset on a state on that surface. Components are m."""

    h: Components
    """H after the reset."""
    off: Components
    """Whether the reset changes H."""
    unmade: Components
    """Whether the state cannot be the result of this reset alone. The reset then moves it, and is
    either idempotent or moves the state off the surface."""
    rate: Components
    """dH/dt after the reset, on side +."""


def _traces(
    system: ComponentSystem, t: Array, x: Components, before: Components, noise: Components
) -> Trace:
    """The effect of the resets of a state's surfaces, given H there and its rounding."""
    above = noise.like(jnp.ones_like(t))

    def own(number: Array) -> tuple[Array, Array, Array, Array]:
        once = system.reset(t, x, number)
        # Applied twice, since an idempotent reset is recognised by a second one without an effect.
        twice = system.reset(t, once, number)
        h = pack(system.switching(t, once), system.dtype)[number]
        rate = pack(unilateral.contact_rates(system, t, once, above), system.dtype)[number]
        return h, _differ(once, x), _differ(twice, once), rate

    if system.packed:
        found = jax.vmap(own)(jnp.arange(system.m, dtype=jnp.int32))
        h, moved, again, rate = (Components([v]) for v in found)
    else:
        each = zip(*(own(jnp.int32(j)) for j in range(system.m)), strict=True)
        h, moved, again, rate = map(Components, each)
    off = abs(h - before) > noise
    return Trace(h, off, moved & (~again | off), rate)


def _changed(system: ComponentSystem, t: Array, x: Components, on: Components) -> Array:
    """Whether the resets of the surfaces that a state is on, applied in order, change the state.
    Resets that undo each other do not, in a state that is the result of all of them."""
    numbers = pack(on, bool)

    def made(j: Array, x: Components) -> Components:
        return where(numbers[j], system.reset(t, x, jnp.asarray(j, jnp.int32)), x)

    if system.m == 1:
        return _differ(made(jnp.int32(0), x), x)
    # A loop, so that the program contains the reset once.
    return _differ(jax.lax.fori_loop(0, system.m, made, x), x)


def _differ(a: Components, b: Components) -> Array:
    """Whether two states differ by more than rounding."""
    size = abs(a) + abs(b)
    return any_of(abs(a - b) > _NOISE * float(jnp.finfo(size.parts[0].dtype).eps) * size)
