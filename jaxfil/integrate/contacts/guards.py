"""Guards: functions that are positive within a mode, their rounding, and when they are armed.

They are evaluated with their rates and their noise at a state in a mode, and after a step it is
decided which of them are armed.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import KeptMode, Problem
from jaxfil.integrate.lane.state import LoopState, Motion, StepEnd
from jaxfil.integrate.surfaces import filippov, unilateral
from jaxfil.integrate.system.components import (
    Components,
    Forcing,
    any_of,
    maximum,
    on_each,
    where,
)
from jaxfil.integrate.system.functions import size_of_time
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.rows import Rows
from jaxfil.xla.select import select

# A guard counts as zero below this many eps times the size of its terms.
NOISE = 32
# Rounding inside H is independent in each evaluation, so it does not accumulate as the rounding of
# states does. The factor 2 is the largest difference between two evaluations.
_INSIDE = 2
# Factor per step by which the running maximum of |x| decreases. It forgets a transient from 1e14
# after about five hundred steps, but not a period of forty steps.
_FADE = 15 / 16
# Factor per switch in turns; a turn of four contacts may shrink a state twentyfold.
_FADE_IN_TURN = 1 / 4


class Surfaces(eqx.Module):
    """The surfaces at the end of a step. Components are m unless stated otherwise."""

    h: Components
    """H after a reset."""
    h_t: Components
    """∂H/∂t."""
    normals: Rows
    """∂H/∂x."""
    scale: Components
    """Running maximum of |x|, n components."""
    noise: Components
    """Rounding of H in this step, which decides whether a contact is here."""
    gathered: Components
    """Bound of the rounding of H since t0, from the largest recent state, which decides whether a
    graze is more than rounding."""
    reached: Components
    """That of the guards of sides too, within which a surface is decided with others, m
    components."""
    off: Components
    """Surfaces that the state has been moved off, by a jump of H or by a map."""
    unsettled: Array | None
    """Whether something has jumped, so that all surfaces that the state is on are decided again in
    any mode. None for systems in which only a contact changes a field, one at a time."""


def surface_noise(
    system: ComponentSystem,
    t: Array,
    x: Components,
    size: Components,
    h_t: Components,
    normals: Rows,
) -> Components:
    """The rounding of H, a multiple of eps and of the size of its terms. These are t and x, whose
    rounding is proportional to the running maximum `size` of states, and all intermediate values
    in H, such as t + φ in a sine with a phase φ."""
    system, t, x, size, h_t, normals = stop_gradient((system, t, x, size, h_t, normals))
    late = abs(h_t * size_of_time(system.clocks, t))
    noise = NOISE * system.eps * (abs(normals) @ size + late)
    inside = system.rounding(t, x)
    if inside is not None:
        noise = noise + _INSIDE * system.eps * inside
    if not system.may_lack_gradients:
        return noise
    # Without a gradient the rounding is unknown, and the surface is where H is exactly zero.
    return where(on_each(jnp.isfinite, noise), noise, 0.0)


def larger(size: Components, x: Components, turns: Array | None = None) -> Components:
    """The running maximum of |x|, with geometric forgetting, since the rounding of a large
    state decays with the motion. It forgets faster while the motion `turns` through the sides of
    surfaces."""
    fade = _FADE if turns is None else select(turns, _FADE_IN_TURN, _FADE)
    return maximum(fade * stop_gradient(size), abs(stop_gradient(x)))


def stays_on(system: ComponentSystem, mode: Components) -> Components:
    """The surfaces that a mode slides or rests on."""
    slides = mode == 0
    return slides | unilateral.rests_of(mode) if system.resets else slides


def with_rounding_of_held(
    system: ComponentSystem, mode: Components, normals: Rows, *noises: Components
) -> list[Components]:
    """The rounding of each H, with what the surfaces that the motion stays on add to it.

    A projection onto one of these moves the state by its rounding, and so another H, such as a
    distance that is zero beside large ones.
    """
    held = stays_on(system, mode)

    def found(normals: Rows, *noises: Components) -> list[Components]:
        # A component of the move along ∇H_k is |∇H_j·∇H_k| h_k/|∇H_k|².
        products, squares = abs(normals.products(normals)), normals.squares()
        parts = [where(held, v / where(squares == 0, 1.0, squares), 0.0) for v in noises]
        return [where(held, v, v + products @ own) for v, own in zip(noises, parts, strict=True)]

    def same(normals: Rows, *noises: Components) -> list[Components]:
        return list(noises)

    return system.where_any(any_of(held), found, same, stop_gradient(normals), *noises)


def guards(
    system: ComponentSystem,
    t: Array,
    x: Components,
    f: Components,
    mode: Components,
    noise: Components,
    forcing: Forcing,
) -> tuple[Components, Components, Components]:
    """The guards of a mode, their rates along its field f, and their noise, given the noise of H.
    `forcing` is the value of `ComponentSystem.forcing` at t."""
    one = jnp.ones_like(t)
    # Computed once for the fields of all sides, like the forcing itself.
    change = (
        system.once(lambda t: jax.jvp(system.forcing_at, (t,), (one,))[1], t) if forcing else []
    )
    together = filippov.holds_together(system)
    guard = filippov.guard_together if together else filippov.free_guard
    g, rate = jax.jvp(
        lambda t, x, forcing: guard(system, t, x, mode, forcing),
        (t, x, forcing),
        (one, f, change),
    )
    # The guard of a slide, 1 − w², has terms of order one.
    noise = where(mode == 0, NOISE * system.eps, noise)
    if together:
        noise = _noise_of_rest(system, t, x, mode, noise)
    elif system.resets:
        g, rate, noise = _guards_of_rest(system, t, x, f, mode, (g, rate, noise))
    if system.may_lack_gradients:
        # A surface that is not reached here needs no rate. Without one, as of |v| at rest, the
        # value and the rate at the end of the next step find its contact.
        known = on_each(jnp.isfinite, rate) | ~(abs(g) > noise)
        rate = where(known, rate, 0.0)
    # Rates have no derivative: Newton's correction δ = −g/ġ holds ġ constant, and its second
    # derivatives are added separately (`second_order`).
    return system.hold(g), stop_gradient(system.hold(rate)), noise


def _noise_of_rest(
    system: ComponentSystem, t: Array, x: Components, mode: Components, noise: Components
) -> Components:
    """The same noise, with the noise of reactions where a mode rests."""
    rests = unilateral.rests_of(mode)

    def of_forces(t: Array, x: Components, noise: Components) -> Components:
        scale = unilateral.reaction_scale(system, t, x, mode)
        return where(rests, stop_gradient(NOISE * system.eps * scale), noise)

    return system.where_any(any_of(rests), of_forces, lambda t, x, noise: noise, t, x, noise)


def _guards_of_rest(
    system: ComponentSystem,
    t: Array,
    x: Components,
    f: Components,
    mode: Components,
    known: tuple[Components, Components, Components],
) -> tuple[Components, Components, Components]:
    """The same guards, rates and noise, with reactions in their place on resting surfaces."""
    rests = unilateral.rests_of(mode)

    def reactions(t: Array, x: Components, f: Components, known: tuple) -> tuple:
        def force(t: Array, x: Components) -> Components:
            return filippov.reaction(system, t, x, mode)

        value, slope = jax.jvp(force, (t, x), (jnp.ones_like(t), f))
        scale = unilateral.reaction_scale(system, t, x, mode)
        found = value, slope, stop_gradient(NOISE * system.eps * scale)
        return tuple(where(rests, new, old) for new, old in zip(found, known, strict=True))

    return system.where_any(any_of(rests), reactions, lambda t, x, f, known: known, t, x, f, known)


def is_close(problem: Problem, state: LoopState, h: Components) -> Components:
    """Surfaces with these H that will be reached within the rounding of times. They count as
    reached, since their contacts would follow at the same rounded time; one that is not armed was
    left just now."""
    near = abs(state.motion.rate) * problem.same_time(state.motion.tau)
    return (state.motion.mode != 0) & (abs(h) < near) & state.armed


def unguarded(kept: KeptMode | None, motion: Motion, num_modes: Array) -> tuple[Motion, Array]:
    """A motion and the number of modes that could continue, with guards far from zero where a lane
    is pinned to its mode."""
    if kept is None:
        return motion, num_modes
    free = dataclasses.replace(
        motion,
        g=where(kept.on, 1.0, motion.g),
        rate=where(kept.on, 0.0, motion.rate),
        determinant=jax.tree.map(lambda v: select(kept.on, 1.0, v), motion.determinant),
    )
    return free, select(kept.on, 1, num_modes)


def rearmed(problem: Problem, state: LoopState, end: StepEnd) -> tuple[Motion, Components]:
    """The motion at the start of the next step, and the flags of its armed guards.

    A surface just reached is armed again once its guard has risen above rounding. Until then the
    guard starts at exactly zero, with a rate of zero or above.
    """
    system, direction, motion = problem.system, problem.grid.direction, end.motion
    waits, before = state.pending.waits, stays_on(system, state.motion.mode)
    met = waits & state.pending.surfaces
    hit = met | (waits & (motion.mode != state.motion.mode))
    # The rounding of the landing counts until the surface is armed again, even if the state has
    # become smaller since.
    kept = (hit | ~state.armed) & ~before
    noise = maximum(motion.noise, where(kept, state.motion.noise, 0.0))
    armed = stays_on(system, motion.mode) | (~hit & state.armed) | (motion.g > noise)
    # At w = ±1 the blend of a slide is the field of that side, so that leaving a slide is a double
    # root of the guard, like a graze, and its rate is set to exactly zero. With the computed rate,
    # 3e-15 from rounding, one lane never left its stick.
    double = met & (before | state.pending.grazes)
    if end.still is not None:
        double = double | end.still
    # Clipped along the motion, since backward in time a guard that rises has a negative rate.
    rising = direction * maximum(direction * motion.rate, 0.0)
    start = dataclasses.replace(
        motion,
        g=stop_gradient(where(armed, maximum(motion.g, 0.0), 0.0)),
        rate=where(armed, motion.rate, where(double, 0.0, rising)),
        noise=noise,
    )
    return start, armed
