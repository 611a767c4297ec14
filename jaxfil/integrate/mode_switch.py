"""The switch: what is known at the end of a step, and the mode that goes on after a contact.

A trial step's end enters; a `StepEnd` leaves: the state (reset, and held on the surfaces it slides
on), the mode, its field, the guards and their rates. Only a lane whose last iteration landed on a
contact changes its mode, here, where all fields are taken at the corrected state: taken before the
correction, they left the state right and its derivative wrong in the fourth digit.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate import filippov, impact, unilateral
from jaxfil.integrate.components import (
    Components,
    ComponentSystem,
    Forcing,
    all_finite,
    any_of,
    axpy,
    where,
)
from jaxfil.integrate.impact import Impact
from jaxfil.integrate.length import Length
from jaxfil.integrate.problem import Problem
from jaxfil.integrate.state import FreeStep, LoopState, StepEnd

# A guard is zero to rounding below this many eps times the size of its terms.
_NOISE = 32
# What is left after a step of the size of a state that decides on its rounding: a transient from
# 1e14 is forgotten after some five hundred, a period of forty steps is not.
_FADE = 15 / 16


def surface_noise(
    system: ComponentSystem, t: Array, size: Components, h_t: Components, normals: tuple
) -> Components:
    """What rounding of t and x does to H: a multiple of eps and of the size of its terms, given the
    size of x."""
    out = []
    for j in range(system.m):
        terms = sum(abs(v) * s for v, s in zip(normals[j], size, strict=True))
        out.append(stop_gradient(_NOISE * system.eps * (terms + abs(h_t[j] * t))))
    return tuple(out)


def _project(x: Components, h: Components, normals: tuple, on: Components) -> Components:
    """x moved along the normals onto the surfaces marked `on`, one after the other."""
    for h_j, normal, on_j in zip(h, normals, on, strict=True):
        size = sum(v * v for v in normal)
        push = jnp.where(on_j, h_j / jnp.where(size == 0, 1, size), 0.0)
        x = axpy(x, -push, normal)
    return x


def larger(size: Components, x: Components) -> Components:
    """The largest |x| of late: what rounding it has left fades with the motion."""
    each = zip(size, x, strict=True)
    return tuple(jnp.maximum(_FADE * s, stop_gradient(abs(v))) for s, v in each)


def evaluate_step_end(
    problem: Problem,
    state: LoopState,
    length: Length,
    x: Components,
    forcing: Forcing,
    free: FreeStep | None = None,
) -> StepEnd:
    """The state, mode, field, guards and rates at the end of a step; a pending switch is made.

    `forcing` is that of the end: see `ComponentSystem.forcing`. What a `free` step has found is
    taken for a lane that stays on its sides, to the last bit.
    """
    system, tau = problem.system, length.end
    t = problem.grid.t0 + tau
    if system.m == 0:
        return _smooth_end(system, state, tau, x, system.field(t, x, (), forcing=forcing))
    reset = impact.make_reset(system, state, t, x) if system.resets else None
    x = x if reset is None else reset.x
    # Everything from here on is taken after the reset: sides, rates and modes are those of the
    # state that goes on.
    h, h_t, normals = system.gradients(t, x)
    size = larger(state.size, x)
    # Two scales: what rounding of this step does to H, and what all rounding since t0 may have
    # done, which is of the largest state so far. The first tells whether a contact is here, the
    # second whether a touch is more than rounding.
    here = tuple(jnp.maximum(abs(a), abs(b)) for a, b in zip(state.x, x, strict=True))
    noise = surface_noise(system, t, here, h_t, normals)
    touch = surface_noise(system, t, size, h_t, normals)
    moved = jnp.zeros((), bool) if reset is None else reset.moved
    x = _held(system, state, x, h, normals, moved)
    led = None
    if reset is not None:
        seen = impact.view(problem, state, t, x, (h_t, normals))
        led = impact.follow(problem, state, length, reset, seen, h, touch)
        x = impact.held(state, reset, seen, x)
    fields, rates = filippov.corners(system, t, x, forcing=forcing)
    mode, num_modes = _switch(problem, state, rates, h, touch, moved, led)
    shares = filippov.weights(mode, rates) if system.slides else mode
    f = filippov.blend_fields(system, fields, mode, shares)
    # Where no mode goes on because a field is not finite, that is what is wrong.
    blind = (num_modes == 0) & ~all_finite(*rates)
    f = system.hold(*(jnp.where(blind, jnp.nan, v) for v in f))
    repels = jnp.zeros((), bool)
    if system.slides:
        repels = ~filippov.attracting(mode, rates, problem.grid.direction)
    f = with_reactions(system, t, x, mode, f)
    g, rate, noise = guards(system, t, x, f, mode, noise)
    if free is not None:
        stays = ~state.pending & ~state.held
        f, g, rate = where(stays, free.f, f), where(stays, free.g, g), where(stays, free.rate, rate)
    on = stays_on(system, mode)
    touch = tuple(jnp.where(s, v, w) for s, v, w in zip(on, noise, touch, strict=True))
    end = StepEnd(
        tau=tau,
        x=x,
        f=f,
        size=size,
        mode=mode,
        g=g,
        rate=rate,
        noise=noise,
        touch=touch,
        num_modes=num_modes,
        repels=repels,
        moved=moved,
        members=state.hit,
        next=(),
        jump=None,
        still=(),
    )
    return end if reset is None or led is None else _led_on(state, end, reset, led)


def _led_on(state: LoopState, end: StepEnd, reset: impact.Reset, led: Impact) -> StepEnd:
    """The end of a step with what follows from its reset."""
    # Surfaces that wait for their reset are met by another switch.
    members = tuple(
        jnp.where(reset.moved, acted | (hit & ~more), hit)
        for acted, hit, more in zip(reset.acted, state.hit, led.next, strict=True)
    )
    x = axpy(end.x, led.jump, end.f)
    x = tuple(a + b for a, b in zip(x, led.kick, strict=True))
    return dataclasses.replace(
        end,
        x=where(led.jump > 0, x, end.x),
        members=members,
        next=led.next,
        jump=led.jump,
        still=led.still,
    )


def stays_on(system: ComponentSystem, mode: Components) -> Components:
    """The surfaces that a mode slides or rests on."""
    slides = tuple(s == 0 for s in mode)
    if not system.resets:
        return slides
    return tuple(a | b for a, b in zip(slides, unilateral.rests_of(mode), strict=True))


def with_reactions(
    system: ComponentSystem, t: Array, x: Components, mode: Components, f: Components
) -> Components:
    """The field of a mode, with the reactions of the surfaces that it rests on."""
    if not system.resets:
        return f
    resting = any_of(unilateral.rests_of(mode))

    def reacted(t: Array, x: Components, mode: Components, f: Components) -> Components:
        return unilateral.held_field(system, t, x, mode, f)[0]

    return system.where_any(resting, reacted, lambda t, x, mode, f: f, t, x, mode, f)


def _smooth_end(
    system: ComponentSystem, state: LoopState, tau: Array, x: Components, f: Components
) -> StepEnd:
    """The end of a step where there are no surfaces."""
    one, false = jnp.ones((), jnp.int32), jnp.zeros((), bool)
    size = larger(state.size, x)
    return StepEnd(tau, x, f, size, (), (), (), (), (), one, false, false, (), (), None, ())


def _held(
    system: ComponentSystem,
    state: LoopState,
    x: Components,
    h: Components,
    normals: tuple,
    moved: Array,
) -> Components:
    """The state on the surfaces that it slides or rests on or has just met: a slide is exact in its
    surface, however long it lasts."""
    if not system.slides and not system.resets:
        return x
    landed = state.pending & ~state.graze & ~moved
    each = zip(stays_on(system, state.mode), state.hit, strict=True)
    on = tuple((stays & ~moved) | (landed & hit) for stays, hit in each)
    return system.hold(*_project(x, h, normals, on))


def guards(
    system: ComponentSystem,
    t: Array,
    x: Components,
    f: Components,
    mode: Components,
    noise: Components,
) -> tuple[Components, Components, Components]:
    """The guards of a mode, their rates along its field f, and their noise, given that of H."""
    g, rate = jax.jvp(
        lambda t, x: filippov.free_guard(system, t, x, mode), (t, x), (jnp.ones_like(t), f)
    )
    # The guard of a slide, 1 - w², is of order one.
    slide = _NOISE * system.eps
    noise = tuple(jnp.where(s == 0, slide, v) for s, v in zip(mode, noise, strict=True))
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
        noise = tuple(stop_gradient(_NOISE * system.eps * v) for v in scale)
        each = zip((value, slope, noise), known, strict=True)
        return tuple(
            tuple(jnp.where(r, a, b) for r, a, b in zip(rests, new, old, strict=True))
            for new, old in each
        )

    return system.where_any(any_of(rests), reactions, lambda t, x, f, known: known, t, x, f, known)


def _switch(
    problem: Problem,
    state: LoopState,
    rates: list[Components],
    h: Components,
    touch: Components,
    moved: Array,
    led: Impact | None,
) -> tuple[Components, Array]:
    """The mode after a landing and the number of admissible ones, computed once; elsewhere the old
    mode and 1."""
    system = problem.system
    mode, count = _chosen(problem, state, rates, h, touch, moved, led)
    # Where there is one surface, both are one number: mode + 8 count, and the mode is at most 2.
    number = mode[0] + 8 * count.astype(system.dtype)
    number, *others = system.hold(number, *mode[1:])
    count = jnp.floor(0.125 * number + 0.5)
    return (number - 8 * count, *others), count.astype(jnp.int32)


def _chosen(
    problem: Problem,
    state: LoopState,
    rates: list[Components],
    h: Components,
    touch: Components,
    moved: Array,
    led: Impact | None,
) -> tuple[Components, Array]:
    """The mode after a landing and the number of admissible ones; elsewhere the old mode and 1.

    A slide that has reached the end of its weight leaves to that side. A reset that has `moved` the
    state may have carried it off a surface, or across another one; what it has `led` to on others
    is known. Everything else is chosen among all modes on the surfaces the state is on: those hit,
    those slid on, and those met or left at the same time.
    """
    system, grid = problem.system, problem.grid
    # Which mode goes on is no number that could have a derivative; its field has.
    rates = jax.tree.map(stop_gradient, rates)
    # A graze only touches: it switches nothing, even where two modes could go on.
    switching = state.pending & ~state.graze
    current = filippov.weights(state.mode, rates) if system.slides else state.mode
    # A slide ends at w = ±1: it leaves to the side whose field has become the blend.
    leaving = tuple(hit & (s == 0) for hit, s in zip(state.hit, state.mode, strict=True))
    sides = tuple(jnp.where(w > 0, jnp.ones_like(w), -jnp.ones_like(w)) for w in current)
    left = tuple(
        jnp.where(go & switching, side, s)
        for go, side, s in zip(leaving, sides, state.mode, strict=True)
    )
    met = tuple(hit & ~go for hit, go in zip(state.hit, leaving, strict=True))
    left, met = _jumped(problem, state, left, met, h, touch)
    if led is not None:
        left, met = _left_by_reset(state, left, met, h, touch, moved, led)
    # A surface that will be met within the rounding of times is met now: its contact could not be
    # told from this one, and would follow it at once.
    same = grid.same_time(state.tau)
    on = []
    for j in range(system.m):
        close = abs(h[j]) < abs(state.rate[j]) * same
        if led is not None:
            close = close & ~led.next[j] & ~led.still[j] & (abs(left[j]) != 2)
        on.append(met[j] | (left[j] == 0) | ((state.mode[j] != 0) & close))
    decide = switching & any_of(met)
    beside = unilateral.beside(left) if system.resets else left
    chosen, count = filippov.choose(system.m, rates, beside, tuple(on), grid.direction)
    count = jnp.where(decide, count, 1)
    if led is None:
        return where(decide, chosen, left), count
    rests = unilateral.rests_of(left)
    mode = tuple(
        jnp.where(decide & ~rest, new, old)
        for rest, new, old in zip(rests, chosen, left, strict=True)
    )
    return mode, jnp.where(led.consistent, count, 0)


def _jumped(
    problem: Problem,
    state: LoopState,
    left: Components,
    met: Components,
    h: Components,
    touch: Components,
) -> tuple[Components, Components]:
    """The mode on surfaces whose H has jumped across zero, by more than rounding of times explains,
    and the surfaces met on which a mode is still to be chosen."""
    same, modes, open_ = problem.grid.same_time(state.tau), [], []
    for s, on, v, least, rate in zip(left, met, h, touch, state.rate, strict=True):
        across = on & (s * v < -(least + 2 * same * abs(stop_gradient(rate))))
        across = across & state.pending & ~state.graze
        modes.append(jnp.where(across, -s, s))
        open_.append(on & ~across)
    return tuple(modes), tuple(open_)


def _left_by_reset(
    state: LoopState,
    left: Components,
    met: Components,
    h: Components,
    touch: Components,
    moved: Array,
    led: Impact,
) -> tuple[Components, Components]:
    """The mode on surfaces that a reset has carried the state off, that it rests on and that wait
    for another switch, and the surfaces met on which a mode is still to be chosen."""
    switching = state.pending & ~state.graze
    modes, open_ = [], []
    for j, (s, v, least) in enumerate(zip(left, h, touch, strict=True)):
        one = jnp.ones_like(s)
        off = moved & (abs(v) > least)
        beside = jnp.where(s < 0, -one, one)
        rested = jnp.where(led.rests[j], 2 * beside, beside)
        # What ends a rest, and what asks for a reset, leaves to its side.
        ends = (state.hit[j] & (abs(s) == 2)) | led.next[j]
        mode = jnp.where(off & switching, jnp.where(v > 0, one, -one), s)
        mode = jnp.where(ends & switching, beside, mode)
        modes.append(jnp.where(led.still[j], rested, mode))
        open_.append(met[j] & ~off & ~ends & ~led.still[j])
    return tuple(modes), tuple(open_)


def rearm_guards(problem: Problem, state: LoopState, end: StepEnd) -> tuple[Components, ...]:
    """Guards, rates, arming and noise at the start of the next step.

    A surface just met counts as left only when its guard has risen above rounding. Until then the
    guard starts at exactly zero, and its rate at zero or above.
    """
    system, direction = problem.system, problem.grid.direction
    before, after = stays_on(system, state.mode), stays_on(system, end.mode)
    gs, rates, armed, noises = [], [], [], []
    for j in range(system.m):
        hit = state.pending & state.hit[j]
        old_slide, sliding = before[j], after[j]
        # The rounding of the landing counts until the surface is left, also where the state has
        # become smaller since.
        kept = (hit | ~state.armed[j]) & ~old_slide
        noise = jnp.maximum(end.noise[j], jnp.where(kept, state.noise[j], 0.0))
        away = sliding | (~hit & state.armed[j]) | (end.g[j] > noise)
        # Leaving a slide, or a touch, is a double root of the guard: its rate is zero, whatever
        # rounding says. Taken as computed, 3e-15 of it held one lane on its stick for ever.
        double = hit & (old_slide | state.graze)
        if system.resets:
            double = double | end.still[j]
        rising = direction * jnp.maximum(direction * end.rate[j], 0.0)
        gs.append(jnp.where(away, jnp.maximum(end.g[j], 0.0), 0.0))
        rates.append(jnp.where(away, end.rate[j], jnp.where(double, 0.0, rising)))
        armed.append(away)
        noises.append(noise)
    return tuple(stop_gradient(g) for g in gs), tuple(rates), tuple(armed), tuple(noises)
