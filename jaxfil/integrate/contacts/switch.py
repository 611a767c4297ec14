"""The switch: the motion at the end of a step, and the mode that continues after a contact.

A `StepEnd` holds the state (after the map of a tick or a reset, and projected onto its sliding
surfaces), the mode, its field, the guards and their rates. Only a lane whose last iteration reached
a contact or a tick changes its mode here, with all fields evaluated at the corrected state.
Evaluated before the correction, they would leave the state right and its derivative wrong in the
fourth digit. Each of several causes at one time has a switch of its own.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts import accumulation, resets
from jaxfil.integrate.contacts.decide import Decision, decided, later_contacts
from jaxfil.integrate.contacts.guards import (
    Surfaces,
    guards,
    is_close,
    larger,
    stays_on,
    surface_noise,
    unguarded,
    with_rounding_of_held,
)
from jaxfil.integrate.contacts.holding import with_rounding_of_forces
from jaxfil.integrate.contacts.in_turn import as_planned, in_turn
from jaxfil.integrate.contacts.maps import Maps, mapped, ticked
from jaxfil.integrate.contacts.resets import Impact
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import FreeStep, LoopState, Motion, StepEnd
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.surfaces import filippov, unilateral, weights as sliding_weights
from jaxfil.integrate.surfaces.corners import Corners, are_coupled
from jaxfil.integrate.surfaces.entering import fields_from_here, held_from_here
from jaxfil.integrate.surfaces.normals import project
from jaxfil.integrate.surfaces.second_order import met_here
from jaxfil.integrate.system.components import (
    Components,
    Forcing,
    all_finite,
    any_of,
    first_set,
    maximum,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select, select_all

# Backward in time the state at the end of a slide has the errors of both directions, hence this
# multiple of rounding.
_BACKWARD = 1024.0


def _surfaces_at(
    problem: Problem, state: LoopState, t: Array, x: Components, maps: Maps
) -> Surfaces:
    """The surfaces at (t, x), after maps."""
    system, pending = problem.system, state.pending
    h, h_t, normals = system.gradients(t, x)
    turns = pending.waits & ~pending.jumped & any_of(pending.surfaces)  # not a switch after another
    scale = larger(state.motion.scale, x, None if state.turn is None else turns)
    here = stop_gradient(maximum(abs(state.motion.x), abs(x)))
    noise = surface_noise(system, t, x, here, h_t, normals)
    gathered = surface_noise(system, t, x, scale, h_t, normals)
    if system.slides:
        gathered = select(problem.grid.direction < 0, _BACKWARD, 1.0) * gathered
    if (
        are_coupled(system)
        and (system.slides or system.resets)
        and system.structure.members is None
    ):
        noise, gathered = with_rounding_of_held(system, state.motion.mode, normals, noise, gathered)
    same = problem.same_time(state.motion.tau)
    # H has jumped by more than the rounding of times explains. The guard of a slide or a rest is
    # not H, and its rate may be anything where the state has been moved off the surface.
    rate = where(stays_on(system, state.motion.mode), 0.0, stop_gradient(state.motion.rate))
    away = abs(h) > gathered + 2 * same * abs(rate)
    off, something = pending.waits & pending.across & away, pending.waits & pending.jumped
    if maps.h is not None:
        # A map must have changed H itself; rounding of an unchanged H does not leave its surface.
        off = off | (maps.moved & (abs(h) > gathered) & (abs(h - maps.h) > gathered))
        something = something | maps.moved
    if problem.kept is not None:  # a lane pinned to its mode stays in it beyond its surfaces
        off = off & ~problem.kept.on
    unsettled = None
    if are_coupled(system):
        # An event on one surface may change the field on another.
        something = something | (pending.waits & ~pending.grazes)
    if system.m > 1 or system.clocks or system.resets:
        unsettled = something
    # The guard of a side has the rounding of the steps before, and of forces that hold.
    before = where(abs(state.motion.mode) == 1, state.motion.noise, 0.0)
    reached = maximum(gathered, stop_gradient(before))
    return Surfaces(h, h_t, normals, scale, noise, gathered, reached, off, unsettled)


def evaluate_step_end(
    problem: Problem,
    state: LoopState,
    length: Length,
    x: Components,
    forcing: Forcing,
    free: FreeStep | None = None,
) -> StepEnd:
    """The motion at the end of a step, after a pending switch has been carried out.

    `forcing` is the value of `ComponentSystem.forcing` at the end. For a lane that stays on its
    sides the results of a `free` step are used, bit for bit.
    """
    system = problem.system
    t = problem.grid.t0 + length.end
    if system.m == 0:
        return _smooth_end(problem, state, length.end, t, x, forcing)
    maps = mapped(problem, state, t, x)
    # The order matters. Maps come first, since all later values must belong to the state that
    # continues. Then the state is projected onto its surfaces, resets are followed up, fields and
    # rates are evaluated there, and the mode is decided from them.
    at, led = _surfaces_at(problem, state, t, maps.x, maps), None
    later = later_contacts(problem, state) if maps.reset is None else maps.reset.waits
    x = _held(problem, state, t, maps.x, at, later)
    if maps.reset is not None:
        x, led = resets.lead(problem, state, length, maps.reset, t, x, at)
        later = led.next
    fields, rates = filippov.corners(system, t, x, forcing=forcing)
    if system.slides or are_coupled(system):
        at = with_rounding_of_forces(problem, state, length, at, fields, x, led)
    choice = decided(problem, state, (t, x), (fields, rates), at, led, later)
    whole = as_planned(state, choice, later)
    choice, again, redone = in_turn(problem, state, maps, whole, later)
    if system.clocks or are_coupled(system):
        # A tick, or a contact or reset of another surface, may put the state where it then slides
        # or rests, also where it did so before; and H may jump there at a tick.
        # Surfaces of a located contact have this derivative through the time of the contact.
        put = stays_on(system, choice.mode) & ~state.pending.surfaces & ~at.off
        put = put & state.pending.waits
        # The last switch at this time knows all modes. Until then a surface that the state has been
        # moved off, or whose reset is due, has the mode that it had.
        if again is not None:
            put = put & ~again
        if later is not None:
            put = put & ~later
        if problem.kept is not None:
            put = put & ~problem.kept.on
        x = held_from_here(system, t, x, choice.mode, put)
        fields, rates = fields_from_here(system, t, x, (fields, rates))
    motion = _motion(problem, length.end, x, at, (fields, rates), choice, forcing)
    if redone is not None:
        motion = _without_undefined(state.motion, motion, redone)
    if free is not None:
        stays, found = ~state.pending.waits & ~state.held, (free.f, free.g, free.rate)
        found = select_all(stays, found, (motion.f, motion.g, motion.rate))
        motion = eqx.tree_at(lambda v: (v.f, v.g, v.rate), motion, found)
    # The guard of a slide or a rest is not H, so the accumulated rounding of H does not apply.
    gathered = where(stays_on(system, choice.mode), motion.noise, at.gathered)
    motion, num_modes = unguarded(problem.kept, motion, choice.count)
    end = StepEnd(
        motion=motion,
        gathered=gathered,
        num_modes=num_modes,
        moved=maps.moved,
        ticked=maps.ticked,
        off=at.off,
        members=_members(state, maps, motion, later),
        next=later,
        again=again,
        plan=None if again is None else whole.mode,
        planned=None if again is None else again & (whole.count == 1),
        ticks=_ticks_again(problem, state, length.end),
        misfit=None,
        jump=None,
        still=None,
        turn=None,
    )
    if led is not None:
        end = _led_on(end, led)
    end = _to_later(problem, state, end, at.reached)
    return accumulation.follow_turns(problem, state, length, end, maps.reset, led)


def _ticks_again(problem: Problem, state: LoopState, tau: Array) -> Array | None:
    """Whether the tick of another clock follows the one that waits."""
    if len(problem.system.clocks) < 2 or problem.tick is None:
        return None
    return state.pending.waits & problem.ticks_at(tau)


def _without_undefined(before: Motion, motion: Motion, redone: Array) -> Motion:
    """A motion between two maps, with the last numbers that are defined. The field of a side that
    the state has been carried away from, such as the root of a level, need not be defined here."""
    undefined = redone & ~all_finite(motion.f, motion.g, motion.rate)
    kept = {"tau": motion.tau, "x": motion.x, "scale": motion.scale, "mode": motion.mode}
    return select_all(undefined, dataclasses.replace(before, **kept), motion)


def _members(state: LoopState, maps: Maps, motion: Motion, later: Components | None) -> Components:
    """The surfaces of a switch's event, which are those hit and those whose mode it changes."""
    hit = state.pending.surfaces if later is None else state.pending.surfaces & ~later
    changed = state.pending.waits & (motion.mode != state.motion.mode)
    members = hit | changed
    if maps.reset is not None:
        members = where(maps.reset.moved, maps.reset.acted, members)
    return members


def _to_later(problem: Problem, state: LoopState, end: StepEnd, reached: Components) -> StepEnd:
    """The end of a switch, moved to the next contact at the same time. The time between them is
    zero and has a derivative of its own."""
    if end.next is None:
        return end
    system, direction = problem.system, problem.grid.direction
    falls = direction * end.motion.rate < 0
    here = (abs(end.motion.g) <= reached) | is_close(problem, state, end.motion.g)
    comes = state.pending.waits & first_set(end.next) & falls & here
    at = problem.grid.t0 + end.motion.tau, end.motion.x
    motion, gap = (end.motion.mode, end.motion.f), (end.motion.g, end.motion.rate)
    delta, x = met_here(system, at, motion, gap, comes)
    jump = delta if end.jump is None else end.jump + delta
    misfit = None
    if state.pending.together is not None:
        # A contact that would not come, or has no mode after it, belongs to several surfaces at one
        # point, which are then decided together.
        fine = ~any_of(end.next & ~falls) & (end.num_modes == 1)
        misfit = state.pending.waits & any_of(end.next) & ~fine
    motion = dataclasses.replace(end.motion, x=x)
    return dataclasses.replace(end, motion=motion, jump=jump, misfit=misfit)


def _motion(
    problem: Problem,
    tau: Array,
    x: Components,
    at: Surfaces,
    on_sides: tuple[Corners, Corners],
    choice: Decision,
    forcing: Forcing,
) -> Motion:
    """The motion that continues from x in the chosen mode, given the fields on all sides with their
    rates."""
    (fields, rates), mode = on_sides, choice.mode
    system, t = problem.system.in_mode(mode), problem.grid.t0 + tau
    if system.asks_mode:  # the fields depend on the mode, which is known only now
        fields, _ = filippov.corners(system, t, x, forcing=forcing)
    # If no mode continues because a field is not finite, the outcome should say so; NaN does.
    blind = (choice.count == 0) & ~all_finite(rates)
    together = filippov.holds_together(system)
    shares, determinant = mode, None
    if together:
        held = filippov.balance(system, t, x, mode, fields, rates)
        f, determinant = held.field, system.hold(held.determinant)
    else:
        if system.slides:
            shares = sliding_weights.weights(mode, rates)
            known = stop_gradient((mode, rates, shares))
            determinant = system.hold(sliding_weights.determinant(*known))
        f = filippov.blend_fields(system, fields, mode, shares)
        if fields.flipped is not None and not system.slides:
            # A sum of changes has their rounding, beside which a field that is zero is not small.
            f = system.field(t, x, unilateral.sides_of(mode), forcing=forcing, term=True)
    f = system.hold(where(blind, jnp.nan, f))
    # The field of a `balance` contains the reactions.
    f = system.squared(f if together else with_reactions(system, t, x, mode, f))
    g, rate, noise = guards(system, t, x, f, mode, at.noise, forcing)
    return Motion(tau, x, f, at.scale, mode, g, rate, noise, determinant)


def _led_on(end: StepEnd, led: Impact) -> StepEnd:
    """The end of a step with the consequences of its reset."""
    motion = end.motion
    x = where(led.ends, motion.x + led.jump * motion.f + led.kick, motion.x)
    motion = dataclasses.replace(motion, x=x)
    # The mode after a chattering is decided at its end.
    planned = None if end.planned is None else end.planned & ~led.ends
    return dataclasses.replace(end, motion=motion, planned=planned, jump=led.jump, still=led.still)


def with_reactions(
    system: ComponentSystem, t: Array, x: Components, mode: Components, f: Components
) -> Components:
    """The field of a mode, with the reactions of its resting surfaces."""
    if not system.resets:
        return f
    resting = any_of(unilateral.rests_of(mode))

    def reacted(t: Array, x: Components, mode: Components, f: Components) -> Components:
        return unilateral.held_field(system, t, x, mode, f)[0]

    return system.where_any(resting, reacted, lambda t, x, mode, f: f, t, x, mode, f)


def _smooth_end(
    problem: Problem,
    state: LoopState,
    tau: Array,
    t: Array,
    x: Components,
    forcing: Forcing,
) -> StepEnd:
    """The end of a step in a system without surfaces, after a tick that waits."""
    system, number, moved = problem.system, problem.ticked, jnp.zeros((), bool)
    if system.ticks and number is not None:
        x, before = ticked(system, number, t, x), x
        moved = any_of(x != before)
    none, one = state.motion.mode, jnp.ones((), jnp.int32)
    f, scale = system.field(t, x, none, forcing=forcing), larger(state.motion.scale, x)
    motion = Motion(tau, x, f, scale, none, none, none, none, None)
    return StepEnd(
        motion=motion,
        gathered=none,
        num_modes=one,
        moved=moved,
        ticked=None,
        off=none,
        members=none,
        next=None,
        again=None,
        plan=None,
        planned=None,
        ticks=_ticks_again(problem, state, tau),
        misfit=None,
        jump=None,
        still=None,
        turn=None,
    )


def _held(
    problem: Problem,
    state: LoopState,
    t: Array,
    x: Components,
    at: Surfaces,
    later: Components | None,
) -> Components:
    """The state projected onto the surfaces that it slides or rests on or has just reached, so that
    a slide of any length stays exactly on its surface. Surfaces that it has been moved off, or that
    are decided later, are excluded."""
    system = problem.system
    if not system.slides and not system.resets:
        return x
    off = at.off
    if problem.kept is not None:  # a lane pinned to a slide need not be on the surface
        off = off | problem.kept.on
    landed = state.pending.waits & ~state.pending.grazes & state.pending.surfaces
    if later is not None:
        landed = landed & ~later
    stays = stays_on(system, state.motion.mode)
    on = (stays | landed) & ~off
    # At a switch the way back to a surface that was stayed on is along the field, not the normal;
    # `held_from_here` has its derivative.
    h = where(state.pending.waits & stays, stop_gradient(at.h), at.h)
    x = project(system, x, h, at.normals, on)
    if not system.structure.flat:
        # Of a step with an error d the normal leaves d² of H, from which a run that is continued
        # would start beside its surface, or beyond it.
        def again(x: Components) -> Components:
            h, _, normals = system.gradients(t, x)
            return project(system, x, h, normals, on)

        x = system.where_any(any_of(on), again, lambda x: x, x)
    return system.hold(x)
