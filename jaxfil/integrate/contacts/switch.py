"""The switch: what is known at the end of a step, and the mode that goes on after a contact.

A trial step's end enters; a `StepEnd` leaves: the state (reset, and held on the surfaces it slides
on), the mode, its field, the guards and their rates. Only a lane whose last iteration landed on a
contact changes its mode, here, where all fields are taken at the corrected state: taken before the
correction, they left the state right and its derivative wrong in the fourth digit.
"""

import dataclasses
import functools as ft

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts import accumulation, resets
from jaxfil.integrate.contacts.guards import (
    NOISE,
    Surfaces,
    guards,
    larger,
    stays_on,
    surface_noise,
    unguarded,
)
from jaxfil.integrate.contacts.resets import Impact, Reset
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import FreeStep, LoopState, Motion, StepEnd
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
from jaxfil.xla.select import select, select_all

# At a graze a rate is told from zero above this multiple of what is left of the motion's own.
_TANGENT = 64
# Backward in time a motion that has left a slide comes to its end with the errors of both ways:
# this multiple of rounding.
_BACKWARD = 1024.0


def _surfaces_at(
    problem: Problem, state: LoopState, t: Array, x: Components, reset: Reset | None
) -> Surfaces:
    """The surfaces at (t, x), where a reset has led to."""
    system = problem.system
    h, h_t, normals = system.gradients(t, x)
    scale = larger(state.motion.scale, x, None if state.turn is None else state.pending.waits)
    here = stop_gradient(maximum(abs(state.motion.x), abs(x)))
    noise = surface_noise(system, t, x, here, h_t, normals)
    gathered = surface_noise(system, t, x, scale, h_t, normals)
    if system.slides:
        gathered = select(problem.grid.direction < 0, _BACKWARD, 1.0) * gathered
    same = problem.grid.same_time(state.motion.tau)
    # Jumped by more than rounding of times explains.
    away = abs(h) > gathered + 2 * same * abs(stop_gradient(state.motion.rate))
    jumped = state.pending.waits & state.pending.jumped & away
    carried = None
    if reset is not None:
        # Whose H the reset has changed: rounding of one that it has not is no way off its surface.
        carried = reset.moved & (abs(h) > gathered) & (abs(h - reset.h) > gathered)
    return Surfaces(h, h_t, normals, scale, noise, gathered, jumped, carried)


def evaluate_step_end(
    problem: Problem,
    state: LoopState,
    length: Length,
    x: Components,
    forcing: Forcing,
    free: FreeStep | None = None,
) -> StepEnd:
    """The motion at the end of a step; a pending switch is made.

    `forcing` is that of the end: see `ComponentSystem.forcing`. What a `free` step has found is
    taken for a lane that stays on its sides, to the last bit.
    """
    system = problem.system
    t = problem.grid.t0 + length.end
    if system.m == 0:
        return _smooth_end(system, state, length.end, t, x, forcing)
    reset = resets.make_reset(system, state, t, x) if system.resets else None
    x = x if reset is None else reset.x
    # Everything from here on is taken after the reset: sides, rates and modes are those of the
    # state that goes on.
    at, led = _surfaces_at(problem, state, t, x, reset), None
    x = _held(problem, state, x, at)
    if reset is not None:
        x, led = resets.lead(problem, state, length, reset, t, x, at)
    fields, rates = filippov.corners(system, t, x, forcing=forcing)
    mode, num_modes = _switch(problem, state, rates, at, led)
    motion = _motion(problem, length.end, x, at, (fields, rates), (mode, num_modes), forcing)
    if free is not None:
        stays, found = ~state.pending.waits & ~state.held, (free.f, free.g, free.rate)
        found = select_all(stays, found, (motion.f, motion.g, motion.rate))
        motion = eqx.tree_at(lambda v: (v.f, v.g, v.rate), motion, found)
    gathered = where(stays_on(system, mode), motion.noise, at.gathered)
    motion, num_modes = unguarded(problem.kept, motion, num_modes)
    end = StepEnd(
        motion=motion,
        gathered=gathered,
        num_modes=num_modes,
        moved=jnp.zeros((), bool) if reset is None else reset.moved,
        members=state.pending.surfaces,
        next=None,
        jump=None,
        still=None,
        turn=None,
    )
    if reset is not None and led is not None:
        end = _led_on(state, end, reset, led)
    return accumulation.follow_turns(problem, state, length, end)


def _motion(
    problem: Problem,
    tau: Array,
    x: Components,
    at: Surfaces,
    on_sides: tuple[Corners, Corners],
    choice: tuple[Components, Array],
    forcing: Forcing,
) -> Motion:
    """The motion that goes on from x in the mode chosen, given the fields on all sides with their
    rates, and in how many modes it could."""
    system, t = problem.system, problem.grid.t0 + tau
    (fields, rates), (mode, num_modes) = on_sides, choice
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
    g, rate, noise = guards(system, t, x, f, mode, at.noise, forcing)
    return Motion(tau, x, f, at.scale, mode, g, rate, noise, determinant)


def _led_on(state: LoopState, end: StepEnd, reset: Reset, led: Impact) -> StepEnd:
    """The end of a step with what follows from its reset."""
    # Surfaces that wait for their reset are met by another switch.
    met, motion = state.pending.surfaces, end.motion
    x = where(led.jump > 0, motion.x + led.jump * motion.f + led.kick, motion.x)
    return dataclasses.replace(
        end,
        motion=dataclasses.replace(motion, x=x),
        members=where(reset.moved, reset.acted | (met & ~led.next), met),
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
    system: ComponentSystem,
    state: LoopState,
    tau: Array,
    t: Array,
    x: Components,
    forcing: Forcing,
) -> StepEnd:
    """The end of a step where there are no surfaces."""
    none, one = state.motion.mode, jnp.ones((), jnp.int32)
    f, scale = system.field(t, x, none, forcing=forcing), larger(state.motion.scale, x)
    motion = Motion(tau, x, f, scale, none, none, none, none, None)
    return StepEnd(motion, none, one, jnp.zeros((), bool), none, None, None, None, None)


def _held(problem: Problem, state: LoopState, x: Components, at: Surfaces) -> Components:
    """The state on the surfaces that it slides or rests on or has just met: a slide is exact in its
    surface, however long it lasts. Surfaces that have jumped, or were left by a reset, are left
    out."""
    system = problem.system
    if not system.slides and not system.resets:
        return x
    off = at.jumped if at.carried is None else at.jumped | at.carried
    if problem.kept is not None:  # a slide that is kept needs not be on its surface
        off = off | problem.kept.on
    landed = state.pending.waits & ~state.pending.grazes & state.pending.surfaces
    on = (stays_on(system, state.motion.mode) | landed) & ~off
    return system.hold(project(system, x, at.h, at.normals, on))


def _switch(
    problem: Problem, state: LoopState, rates: Corners, at: Surfaces, led: Impact | None
) -> tuple[Components, Array]:
    """`_chosen`, computed once."""
    system = problem.system
    mode, count = _chosen(problem, state, rates, at, led)
    number = count.astype(system.dtype)
    if system.m > 1:
        mode, number = system.hold((mode, number))
        return mode, number.astype(jnp.int32)
    # Of one surface both are one number, |mode| ≤ 2, so that one value is held and not two.
    both = system.hold(mode + 8 * number)
    number = jnp.floor(0.125 * both.number(0) + 0.5)
    return both - 8 * number, number.astype(jnp.int32)


def _chosen(
    problem: Problem, state: LoopState, rates: Corners, at: Surfaces, led: Impact | None
) -> tuple[Components, Array]:
    """The mode after a landing and the number of admissible ones; elsewhere the old mode, and of a
    slide the number of modes on its surfaces, at least 1.

    Where `_left` has not decided, it is chosen among all modes on the surfaces the state is on:
    those hit, those slid on, and those met or left at the same time.
    """
    system, grid, waits = problem.system, problem.grid, state.pending.waits
    # Which mode goes on is no number that could have a derivative; its field has.
    rates = stop_gradient(rates)
    # A graze only touches: it switches nothing, even where two modes could go on. Backward in time
    # it may be the end of a slide, to which all motions come that have left the slide there.
    grazes = jnp.zeros((), bool)
    if system.slides and not system.resets:
        grazes = waits & state.pending.grazes & (grid.direction < 0)
        rates = _rates_at_graze(problem, state, rates, at.gathered, grazes)
    left, met = _left(problem, state, rates, at, led)
    # A surface that will be met within the rounding of times is met now: its contact could not be
    # told from this one, and would follow it at once.
    near = abs(state.motion.rate) * grid.same_time(state.motion.tau)
    close = (state.motion.mode != 0) & (abs(at.h) < near)
    if led is not None:
        close = close & ~led.next & ~led.still & ~unilateral.rests_of(left)
    decide = waits & ~state.pending.grazes & any_of(met)
    on = (decide & (met | close)) | (grazes & met)
    on = on | (left == 0) if system.slides else on
    # Where a slide on an intersection ends, another mode begins: rounding must not show both.
    threshold = select(waits, 0.0, NOISE * system.eps)
    beside = unilateral.beside(left) if system.resets else left
    chosen, count = _chosen_on(system, rates, beside, on, grid.direction, threshold)
    count = select(decide, count, jnp.maximum(count, 1))
    if led is None:
        return where(decide, chosen, left), count
    mode = where(decide & ~unilateral.rests_of(left), chosen, left)
    return mode, select(led.consistent, count, 0)


def _left(
    problem: Problem, state: LoopState, rates: Corners, at: Surfaces, led: Impact | None
) -> tuple[Components, Components]:
    """The mode as far as it follows from what was left, and the surfaces met on which it is still
    to be chosen.

    A slide that has reached the end of its weight leaves to that side; a surface that has jumped
    away is left to the side that H says; of a reset `led` says what follows.
    """
    mode, hit = state.motion.mode, state.pending.surfaces
    switching, one = state.pending.waits & ~state.pending.grazes, jnp.ones_like(state.motion.tau)
    current = sliding_weights.weights(mode, rates) if problem.system.slides else mode
    # A slide ends at w = ±1, where the field of that side has become the blend. A limit of turns is
    # on their surfaces, and ends nothing.
    leaving = hit & (mode == 0)
    if state.turn is not None:
        leaving = leaving & ~state.turn.completed
    sides = where(at.jumped, sign(at.h), where(current > 0, one, -one))
    left, met = where(leaving & switching, sides, mode), hit & ~leaving
    # A surface that has jumped across the state is left behind.
    across = at.jumped & met & (left * at.h < 0)
    left, met = where(across, -left, left), met & ~across
    if led is None or at.carried is None:
        return left, met
    beside = unilateral.sides_of(left)
    # What ends a rest, and what asks for a reset, leaves to its side.
    ends = (hit & unilateral.rests_of(left) & ~resets.at_limit(state)) | led.next
    left = where(at.carried & switching, where(at.h > 0, one, -one), left)
    left = where((ends | led.pushed) & switching, beside, left)
    left = where(led.still, where(led.rests, 2 * beside, beside), left)
    return left, met & ~at.carried & ~ends & ~led.still


def _chosen_on(
    system: ComponentSystem, rates: Corners, mode: Components, on: Components, *rest: Array
) -> tuple[Components, Array]:
    """`filippov.choose`, whose many candidates are tried only where the state is on a surface."""

    def same(rates: Corners, mode: Components, on: Components, *rest: Array) -> tuple:
        return mode, jnp.ones((), jnp.int32)

    choose = ft.partial(filippov.choose, system.m)
    if system.structure.separate:
        return choose(rates, mode, on, *rest)
    return system.where_any(any_of(on), choose, same, rates, mode, on, *rest)


def _rates_at_graze(
    problem: Problem, state: LoopState, rates: Corners, gathered: Components, grazes: Array
) -> Corners:
    """dH/dt along the fields of all sides, those of a surface that is grazed told from rounding.

    They vanish on the side of the motion, which stays there: what is no larger than that leads to
    this side too.
    """
    direction, dt = problem.grid.direction, abs(problem.grid.dt)
    noise = _TANGENT * abs(state.motion.rate) + gathered / dt

    def told(rate: Components) -> Components:
        small = grazes & state.pending.surfaces & (abs(rate) <= noise)
        return where(small, state.motion.mode * direction * noise, rate)

    return rates.map(told)
