"""Guards: what is positive within a mode, what rounding does to them, and when they are armed.

A mode and a state enter; the guards of its surfaces leave, with their rates and their noise, and
after a step which of them count as left.
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
from jaxfil.integrate.system.components import Components, Forcing, any_of, maximum, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.rows import Rows
from jaxfil.xla.select import select

# A guard is zero to rounding below this many eps times the size of its terms.
NOISE = 32
# What is rounded inside of H is rounded anew by each evaluation: it does not gather, as the
# rounding of states does. Twice the bound is how far two evaluations may differ.
_INSIDE = 2
# What is left after a step of the size of a state that decides on its rounding: a transient from
# 1e14 is forgotten after some five hundred, a period of forty steps is not.
_FADE = 15 / 16
# A turn of four contacts may make a state twenty times as small.
_FADE_IN_TURN = 1 / 4


class Surfaces(eqx.Module):
    """The surfaces at the end of a step. Components are m, unless said otherwise."""

    h: Components
    """H there, after a reset."""
    h_t: Components
    """∂H/∂t."""
    normals: Rows
    """∂H/∂x."""
    scale: Components
    """Running maximum of |x|, n components."""
    noise: Components
    """What rounding of this step does to H: it decides whether a contact is here."""
    gathered: Components
    """What all rounding since t0 may have done to H, which is of the largest state of late: it
    decides whether a touch is more than rounding."""
    off: Components
    """Surfaces that a jump of H, or a map, has led the state off."""
    unsettled: Array | None
    """Whether something has jumped, so that all surfaces that the state is on are decided anew,
    whatever the mode was. None where nothing but a contact changes a field, and no more than one.
    """


def surface_noise(
    system: ComponentSystem,
    t: Array,
    x: Components,
    size: Components,
    h_t: Components,
    normals: Rows,
) -> Components:
    """What rounding does to H: a multiple of eps and of the size of its terms. These are t and x,
    whose rounding is that of states of some `size`, and all that H makes of them on the way, as
    t + φ in a sine with a phase φ."""
    system, t, x, size, h_t, normals = stop_gradient((system, t, x, size, h_t, normals))
    noise = NOISE * system.eps * (abs(normals) @ size + abs(h_t * t))
    inside = system.rounding(t, x)
    return noise if inside is None else noise + _INSIDE * system.eps * inside


def larger(size: Components, x: Components, turns: Array | None = None) -> Components:
    """The largest |x| of late: what rounding it has left fades with the motion, and faster where it
    `turns` through the sides of surfaces."""
    fade = _FADE if turns is None else select(turns, _FADE_IN_TURN, _FADE)
    return maximum(fade * stop_gradient(size), abs(stop_gradient(x)))


def stays_on(system: ComponentSystem, mode: Components) -> Components:
    """The surfaces that a mode slides or rests on."""
    slides = mode == 0
    return slides | unilateral.rests_of(mode) if system.resets else slides


def guards(
    system: ComponentSystem,
    t: Array,
    x: Components,
    f: Components,
    mode: Components,
    noise: Components,
    forcing: Forcing,
) -> tuple[Components, Components, Components]:
    """The guards of a mode, their rates along its field f, and their noise, given that of H.
    `forcing` is that of t: see `ComponentSystem.forcing`."""
    one = jnp.ones_like(t)
    # Found once for the fields of all sides, as forcing is.
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
    # The guard of a slide, 1 - w², is of order one.
    noise = where(mode == 0, NOISE * system.eps, noise)
    if together:
        noise = _noise_of_rest(system, t, x, mode, noise)
    elif system.resets:
        g, rate, noise = _guards_of_rest(system, t, x, f, mode, (g, rate, noise))
    return system.hold(g), stop_gradient(system.hold(rate)), noise


def _noise_of_rest(
    system: ComponentSystem, t: Array, x: Components, mode: Components, noise: Components
) -> Components:
    """The same noise, with that of reactions where a mode rests."""
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
    """The same guards, rates and noise, with those of the surfaces that a mode rests on: the
    reactions."""
    rests = unilateral.rests_of(mode)

    def reactions(t: Array, x: Components, f: Components, known: tuple) -> tuple:
        def force(t: Array, x: Components) -> Components:
            return filippov.reaction(system, t, x, mode)

        value, slope = jax.jvp(force, (t, x), (jnp.ones_like(t), f))
        scale = unilateral.reaction_scale(system, t, x, mode)
        found = value, slope, stop_gradient(NOISE * system.eps * scale)
        return tuple(where(rests, new, old) for new, old in zip(found, known, strict=True))

    return system.where_any(any_of(rests), reactions, lambda t, x, f, known: known, t, x, f, known)


def unguarded(kept: KeptMode | None, motion: Motion, num_modes: Array) -> tuple[Motion, Array]:
    """A motion and the number of modes that could go on, with guards that are far from zero where a
    lane keeps its mode."""
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
    """The motion at the start of the next step, and which of its guards are armed.

    A surface just met counts as left only when its guard has risen above rounding. Until then the
    guard starts at exactly zero, and its rate at zero or above.
    """
    system, direction, motion = problem.system, problem.grid.direction, end.motion
    waits, before = state.pending.waits, stays_on(system, state.motion.mode)
    met = waits & state.pending.surfaces
    hit = met | (waits & (motion.mode != state.motion.mode))
    # The rounding of the landing counts until the surface is left, also where the state has
    # become smaller since.
    kept = (hit | ~state.armed) & ~before
    noise = maximum(motion.noise, where(kept, state.motion.noise, 0.0))
    armed = stays_on(system, motion.mode) | (~hit & state.armed) | (motion.g > noise)
    # Leaving a slide, or a touch, is a double root of the guard: its rate is zero, whatever
    # rounding says. Taken as computed, 3e-15 of it held one lane on its stick for ever.
    double = met & (before | state.pending.grazes)
    if end.still is not None:
        double = double | end.still
    rising = direction * maximum(direction * motion.rate, 0.0)
    start = dataclasses.replace(
        motion,
        g=stop_gradient(where(armed, maximum(motion.g, 0.0), 0.0)),
        rate=where(armed, motion.rate, where(double, 0.0, rising)),
        noise=noise,
    )
    return start, armed
