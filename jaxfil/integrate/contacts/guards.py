"""Guards: what is positive within a mode, what rounding does to them, and when they are armed.

A mode and a state enter; the guards of its surfaces leave, with their rates and their noise, and
after a step which of them count as left.
"""

import dataclasses
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import KeptMode, Problem
from jaxfil.integrate.lane.state import LoopState, Start, StepEnd
from jaxfil.integrate.surfaces import filippov, unilateral
from jaxfil.integrate.surfaces.normals import sizes
from jaxfil.integrate.system.components import Components, Forcing, Normals, any_of
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select

_At = TypeVar("_At", Start, StepEnd)

# A guard is zero to rounding below this many eps times the size of its terms.
NOISE = 32
# What is left after a step of the size of a state that decides on its rounding: a transient from
# 1e14 is forgotten after some five hundred, a period of forty steps is not.
_FADE = 15 / 16
# A turn of four contacts may make a state twenty times as small.
_FADE_IN_TURN = 1 / 4


def surface_noise(
    system: ComponentSystem, t: Array, size: Components, h_t: Components, normals: Normals
) -> Components:
    """What rounding of t and x does to H: a multiple of eps and of the size of its terms, given the
    size of x."""
    t, size, h_t, normals = stop_gradient((t, size, h_t, normals))
    each = zip(sizes(system, normals, size), h_t, strict=True)
    return tuple(NOISE * system.eps * (terms + abs(r * t)) for terms, r in each)


def larger(size: Components, x: Components, turns: Array | None = None) -> Components:
    """The largest |x| of late: what rounding it has left fades with the motion, and faster where it
    `turns` through the sides of surfaces."""
    fade = _FADE if turns is None else select(turns, _FADE_IN_TURN, _FADE)
    each = zip(*stop_gradient((size, x)), strict=True)
    return tuple(jnp.maximum(fade * s, abs(v)) for s, v in each)


def stays_on(system: ComponentSystem, mode: Components) -> Components:
    """The surfaces that a mode slides or rests on."""
    slides = tuple(s == 0 for s in mode)
    if not system.resets:
        return slides
    return tuple(a | b for a, b in zip(slides, unilateral.rests_of(mode), strict=True))


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
    g, rate = jax.jvp(
        lambda t, x, forcing: filippov.free_guard(system, t, x, mode, forcing),
        (t, x, forcing),
        (one, f, change),
    )
    # The guard of a slide, 1 - w², is of order one.
    slide = NOISE * system.eps
    noise = tuple(select(s == 0, slide, v) for s, v in zip(mode, noise, strict=True))
    if system.resets:
        g, rate, noise = _guards_of_rest(system, t, x, f, mode, (g, rate, noise))
    return system.hold(*g), stop_gradient(system.hold(*rate)), noise


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
            free = filippov.free_field(system, t, x, mode)
            return unilateral.held_field(system, t, x, mode, free)[1]

        value, slope = jax.jvp(force, (t, x), (jnp.ones_like(t), f))
        scale = unilateral.reaction_scale(system, t, x, mode)
        noise = tuple(stop_gradient(NOISE * system.eps * v) for v in scale)
        each = zip((value, slope, noise), known, strict=True)
        return tuple(
            tuple(select(r, a, b) for r, a, b in zip(rests, new, old, strict=True))
            for new, old in each
        )

    return system.where_any(any_of(rests), reactions, lambda t, x, f, known: known, t, x, f, known)


def unguarded(kept: KeptMode | None, at: _At) -> _At:
    """What is known at a point, with guards that are far from zero where a lane keeps its mode."""
    if kept is None:
        return at
    g = tuple(select(kept.on, 1.0, v) for v in at.g)
    rate = tuple(select(kept.on, 0.0, v) for v in at.rate)
    determinant = at.determinant
    if determinant is not None:
        determinant = select(kept.on, 1.0, determinant)
    num_modes = select(kept.on, 1, at.num_modes)
    return dataclasses.replace(at, g=g, rate=rate, num_modes=num_modes, determinant=determinant)


def rearm_guards(problem: Problem, state: LoopState, end: StepEnd) -> tuple[Components, ...]:
    """Guards, rates, arming and noise at the start of the next step.

    A surface just met counts as left only when its guard has risen above rounding. Until then the
    guard starts at exactly zero, and its rate at zero or above.
    """
    system, direction = problem.system, problem.grid.direction
    before, after = stays_on(system, state.mode), stays_on(system, end.mode)
    gs, rates, armed, noises = [], [], [], []
    for j in system.surfaces:
        hit = state.pending & state.hit[j]
        old_slide, sliding = before[j], after[j]
        # The rounding of the landing counts until the surface is left, also where the state has
        # become smaller since.
        kept = (hit | ~state.armed[j]) & ~old_slide
        noise = jnp.maximum(end.noise[j], select(kept, state.noise[j], 0.0))
        away = sliding | (~hit & state.armed[j]) | (end.g[j] > noise)
        # Leaving a slide, or a touch, is a double root of the guard: its rate is zero, whatever
        # rounding says. Taken as computed, 3e-15 of it held one lane on its stick for ever.
        double = hit & (old_slide | state.graze)
        if system.resets:
            double = double | end.still[j]
        rising = direction * jnp.maximum(direction * end.rate[j], 0.0)
        gs.append(select(away, jnp.maximum(end.g[j], 0.0), 0.0))
        rates.append(select(away, end.rate[j], select(double, 0.0, rising)))
        armed.append(away)
        noises.append(noise)
    return tuple(stop_gradient(g) for g in gs), tuple(rates), tuple(armed), tuple(noises)
