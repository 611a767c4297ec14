"""The switch: what is known at the end of a step, and the mode that goes on after a contact.

A trial step's end enters; a `StepEnd` leaves: the state (reset, and held on the surfaces it slides
on), the mode, its field, the guards and their rates. Only a lane whose last iteration landed on a
contact changes its mode, here, where all fields are taken at the corrected state: taken before the
correction, they left the state right and its derivative wrong in the fourth digit.
"""

import dataclasses

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts import accumulation, resets
from jaxfil.integrate.contacts.guards import (
    NOISE,
    guards,
    larger,
    stays_on,
    surface_noise,
    unguarded,
)
from jaxfil.integrate.contacts.resets import Impact
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import FreeStep, LoopState, StepEnd
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.surfaces import filippov, unilateral, weights as sliding_weights
from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.surfaces.normals import project
from jaxfil.integrate.system.components import (
    Components,
    Forcing,
    all_finite,
    any_of,
    maximum,
    sign,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.rows import Rows
from jaxfil.xla.select import select

# At a graze a rate is told from zero above this multiple of what is left of the motion's own.
_TANGENT = 64
# Backward in time a motion that has left a slide comes to its end with the errors of both ways:
# this multiple of rounding.
_BACKWARD = 1024.0


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
        return _smooth_end(system, state, tau, x, system.field(t, x, state.mode, forcing=forcing))
    reset = resets.make_reset(system, state, t, x) if system.resets else None
    x = x if reset is None else reset.x
    # Everything from here on is taken after the reset: sides, rates and modes are those of the
    # state that goes on.
    h, h_t, normals = system.gradients(t, x)
    size = larger(state.size, x, None if state.turn is None else state.pending)
    # Two scales: what rounding of this step does to H, and what all rounding since t0 may have
    # done, which is of the largest state so far. The first tells whether a contact is here, the
    # second whether a touch is more than rounding.
    here = stop_gradient(maximum(abs(state.x), abs(x)))
    noise = surface_noise(system, t, here, h_t, normals)
    touch = surface_noise(system, t, size, h_t, normals)
    moved = jnp.zeros((), bool) if reset is None else reset.moved
    if system.slides:
        wider = select(problem.grid.direction < 0, _BACKWARD, 1.0)
        touch = wider * touch
    jumped = _jumped(problem, state, h, touch)
    # Whose H the reset has changed: rounding of one that it has not is no way off its surface.
    carried, off = None, jumped
    if reset is not None:
        carried = moved & (abs(h) > touch) & (abs(h - reset.h) > touch)
        off = jumped | carried
    if problem.kept is not None:  # a slide that is kept needs not be on its surface
        off = off | problem.kept.on
    x = _held(system, state, x, h, normals, off)
    led = None
    if reset is not None:
        x, led = resets.lead(problem, state, length, reset, t, x, (h_t, normals), h, touch)
    fields, rates = filippov.corners(system, t, x, forcing=forcing)
    mode, num_modes = _switch(problem, state, rates, h, touch, carried, jumped, led)
    shares, determinant = mode, None
    if system.slides:
        shares = sliding_weights.weights(mode, rates)
        known = stop_gradient((mode, rates, shares))
        determinant = system.hold(sliding_weights.determinant(*known))
    f = filippov.blend_fields(system, fields, mode, shares)
    # Where no mode goes on because a field is not finite, that is what is wrong.
    blind = (num_modes == 0) & ~all_finite(rates)
    f = system.hold(where(blind, jnp.nan, f))
    f = with_reactions(system, t, x, mode, f)
    g, rate, noise = guards(system, t, x, f, mode, noise, forcing)
    if free is not None:
        stays = ~state.pending & ~state.held
        f, g, rate = where(stays, free.f, f), where(stays, free.g, g), where(stays, free.rate, rate)
    touch = where(stays_on(system, mode), noise, touch)
    at_end = StepEnd(
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
        determinant=determinant,
        moved=moved,
        members=state.hit,
        next=None,
        jump=None,
        still=None,
        turn=None,
    )
    end = unguarded(problem.kept, at_end)
    if reset is not None and led is not None:
        end = _led_on(state, end, reset, led)
    return accumulation.follow_turns(problem, state, length, end)


def _led_on(state: LoopState, end: StepEnd, reset: resets.Reset, led: Impact) -> StepEnd:
    """The end of a step with what follows from its reset."""
    # Surfaces that wait for their reset are met by another switch.
    members = where(reset.moved, reset.acted | (state.hit & ~led.next), state.hit)
    x = end.x + led.jump * end.f + led.kick
    return dataclasses.replace(
        end,
        x=where(led.jump > 0, x, end.x),
        members=members,
        next=led.next,
        jump=led.jump,
        still=led.still,
    )


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
    none = Components(())
    known = none, none, none, none, none
    return StepEnd(tau, x, f, size, *known, one, None, false, none, None, None, None, None)


def _held(
    system: ComponentSystem,
    state: LoopState,
    x: Components,
    h: Components,
    normals: Rows,
    off: Components,
) -> Components:
    """The state on the surfaces that it slides or rests on or has just met: a slide is exact in its
    surface, however long it lasts. Surfaces that are `off` have jumped, or were left by a reset."""
    if not system.slides and not system.resets:
        return x
    landed = state.pending & ~state.graze
    on = (stays_on(system, state.mode) | (landed & state.hit)) & ~off
    return system.hold(project(system, x, h, normals, on))


def _switch(
    problem: Problem,
    state: LoopState,
    rates: Corners,
    h: Components,
    touch: Components,
    carried: Components | None,
    jumped: Components,
    led: Impact | None,
) -> tuple[Components, Array]:
    """`_chosen`, computed once."""
    system = problem.system
    mode, count = _chosen(problem, state, rates, h, touch, carried, jumped, led)
    number = count.astype(system.dtype)
    if system.m > 1:
        mode, number = system.hold((mode, number))
        return mode, number.astype(jnp.int32)
    # Of one surface both are one number, |mode| ≤ 2, so that one value is held and not two.
    both = system.hold(mode + 8 * number)
    number = jnp.floor(0.125 * both.number(0) + 0.5)
    return both - 8 * number, number.astype(jnp.int32)


def _chosen(
    problem: Problem,
    state: LoopState,
    rates: Corners,
    h: Components,
    touch: Components,
    carried: Components | None,
    jumped: Components,
    led: Impact | None,
) -> tuple[Components, Array]:
    """The mode after a landing and the number of admissible ones; elsewhere the old mode, and of a
    slide the number of modes on its surfaces, at least 1.

    A slide that has reached the end of its weight leaves to that side. A reset may have
    `carried` the state off a surface, or across another one; what it has `led` to on others
    is known. Everything else is chosen among all modes on the surfaces the state is on: those hit,
    those slid on, and those met or left at the same time.
    """
    system, grid = problem.system, problem.grid
    # Which mode goes on is no number that could have a derivative; its field has.
    rates = stop_gradient(rates)
    # A graze only touches: it switches nothing, even where two modes could go on. Backward in time
    # it may be the end of a slide, to which all motions come that have left the slide there.
    switching, grazes = state.pending & ~state.graze, jnp.zeros((), bool)
    if system.slides and not system.resets:
        grazes = state.pending & state.graze & (grid.direction < 0)
        rates = _rates_at_graze(problem, state, rates, touch, grazes)
    current = sliding_weights.weights(state.mode, rates) if system.slides else state.mode
    # A slide ends at w = ±1: it leaves to the side whose field has become the blend. A limit of
    # turns is on their surfaces, and ends nothing.
    limit = jnp.zeros((), bool) if state.turn is None else state.turn.completed
    leaving = state.hit & (state.mode == 0) & ~limit
    one = jnp.ones_like(state.tau)
    sides = where(current > 0, one, -one)
    if state.ticks is not None:  # a surface that has jumped away from a slide leaves it on its side
        sides = where(jumped, sign(h), sides)
    left, met = where(leaving & switching, sides, state.mode), state.hit & ~leaving
    # A surface that has jumped across the state is left behind.
    across = jumped & met & (left * h < 0)
    left, met = where(across, -left, left), met & ~across
    if led is not None:
        assert carried is not None
        left, met = _left_by_reset(state, left, met, h, carried, led)
    # A surface that will be met within the rounding of times is met now: its contact could not be
    # told from this one, and would follow it at once.
    same = grid.same_time(state.tau)
    decide = switching & any_of(met)
    close = (state.mode != 0) & (abs(h) < abs(state.rate) * same)
    if led is not None:
        close = close & ~led.next & ~led.still & (abs(left) != 2)
    slid = left == 0 if system.slides else left.like(jnp.zeros((), bool))
    on = slid | (decide & (met | close)) | (grazes & met)
    # Where a slide on an intersection ends, another mode begins: rounding must not show both.
    least = select(state.pending, 0.0, NOISE * system.eps)
    beside = unilateral.beside(left) if system.resets else left
    chosen, count = _chosen_on(system, rates, beside, on, grid.direction, least)
    count = select(decide, count, jnp.maximum(count, 1))
    if led is None:
        return where(decide, chosen, left), count
    mode = where(decide & ~unilateral.rests_of(left), chosen, left)
    return mode, select(led.consistent, count, 0)


def _jumped(problem: Problem, state: LoopState, h: Components, touch: Components) -> Components:
    """The surfaces whose H has jumped away from zero, by more than rounding of times explains."""
    same = problem.grid.same_time(state.tau)
    rate = abs(stop_gradient(state.rate))
    return state.pending & state.jumped & (abs(h) > touch + 2 * same * rate)


def _left_by_reset(
    state: LoopState,
    left: Components,
    met: Components,
    h: Components,
    carried: Components,
    led: Impact,
) -> tuple[Components, Components]:
    """The mode on surfaces that a reset has carried the state off, that it rests on and that wait
    for another switch, and the surfaces met on which a mode is still to be chosen."""
    switching = state.pending & ~state.graze
    beside = unilateral.sides_of(left)
    # What ends a rest, and what asks for a reset, leaves to its side.
    ends = (state.hit & (abs(left) == 2) & ~resets.at_limit(state)) | led.next
    one = jnp.ones_like(state.tau)
    mode = where(carried & switching, where(h > 0, one, -one), left)
    mode = where((ends | led.pushed) & switching, beside, mode)
    rested = where(led.rests, 2 * beside, beside)
    return where(led.still, rested, mode), met & ~carried & ~ends & ~led.still


def _chosen_on(
    system: ComponentSystem,
    rates: Corners,
    mode: Components,
    on: Components,
    direction: Array,
    least: Array,
) -> tuple[Components, Array]:
    """`filippov.choose`, whose many candidates are tried only where the state is on a surface."""

    def choose(rates: Corners, mode: Components, on: Components, *rest: Array) -> tuple:
        return filippov.choose(system.m, rates, mode, on, *rest)

    def same(rates: Corners, mode: Components, on: Components, *rest: Array) -> tuple:
        return mode, jnp.ones((), jnp.int32)

    if system.structure.separate:
        return choose(rates, mode, on, direction, least)
    return system.where_any(any_of(on), choose, same, rates, mode, on, direction, least)


def _rates_at_graze(
    problem: Problem, state: LoopState, rates: Corners, touch: Components, grazes: Array
) -> Corners:
    """dH/dt along the fields of all sides, those of a surface that is grazed told from rounding.

    They vanish on the side of the motion, which stays there: what is no larger than that leads to
    this side too.
    """
    direction, dt = problem.grid.direction, abs(problem.grid.dt)
    noise = _TANGENT * abs(state.rate) + touch / dt

    def told(rate: Components) -> Components:
        small = grazes & state.hit & (abs(rate) <= noise)
        return where(small, state.mode * direction * noise, rate)

    return rates.map(told)
