"""The decision of the mode that continues after a discontinuity.

Whether a contact, a tick of a clock or a map has brought the lane here, all surfaces that the state
is on are decided together, at the corrected state and in the fields that hold from now on. The
result is the mode and the number of modes in which the motion could continue. The side of all other
surfaces is the sign of H.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts import resets
from jaxfil.integrate.contacts.guards import NOISE, Surfaces, is_close
from jaxfil.integrate.contacts.resets import Impact
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.lane.step_length import moment, typical_step
from jaxfil.integrate.surfaces import (
    decision,
    filippov,
    next_derivatives,
    reactions,
    unilateral,
    weights as sliding_weights,
)
from jaxfil.integrate.surfaces.corners import Corners, are_coupled, steered
from jaxfil.integrate.surfaces.question import Question
from jaxfil.integrate.system.components import Components, any_of, first_set, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select

# At a graze a rate counts as nonzero above this multiple of the motion's own remaining rate.
_TANGENT = 64


class Decision(eqx.Module):
    """The mode after a switch, or the unchanged mode without one."""

    mode: Components
    """The mode, m components."""
    count: Array
    """Number of modes that could continue; at least 1 where a slide continues on its surfaces."""


def later_contacts(problem: Problem, state: LoopState) -> Components | None:
    """Surfaces reached at the same time as one that is switched first, in systems without resets.
    Each is a contact of its own, at a time with its own derivative. None if there cannot be any."""
    pending = state.pending
    if problem.system.m == 1 or problem.system.resets:
        return None
    in_turn = pending.waits & ~(pending.grazes | pending.jumped)
    if pending.together is not None:
        in_turn = in_turn & ~pending.together
    if state.turn is not None:
        in_turn = in_turn & ~state.turn.completed
    return in_turn & pending.surfaces & ~first_set(pending.surfaces)


def _once(system: ComponentSystem, mode: Components, count: Array) -> Decision:
    """A decision, computed once."""
    number = count.astype(system.dtype)
    if system.m > 1:
        mode, number = system.hold((mode, number))
        return Decision(mode, number.astype(jnp.int32))
    # With one surface |mode| ≤ 2, so mode and count fit in one number, and only one value needs a
    # fence.
    both = system.hold(mode + 8 * number)
    # |mode|/8 is at most 1/4, so the nearest whole number is the count.
    number = jnp.floor(0.125 * both.number(0) + 0.5)
    return Decision(both - 8 * number, number.astype(jnp.int32))


def decided(
    problem: Problem,
    state: LoopState,
    here: tuple[Array, Components],
    on_sides: tuple[Corners, Corners],
    at: Surfaces,
    led: Impact | None,
    later: Components | None,
) -> Decision:
    """The mode that continues from a time and state, given the fields on all sides and the rates of
    H along them. `later` are surfaces that are decided in another switch."""
    system, grid, waits = problem.system, problem.grid, state.pending.waits
    # The choice of a mode is discrete and has no derivative; the field of the mode has.
    fields, rates = stop_gradient(on_sides)
    # A graze does not switch the mode, even where two modes could continue. Backward in time it may
    # be the end of a slide, to which all motions that left the slide there return.
    grazes = jnp.zeros((), bool)
    if system.slides and not system.resets:
        grazes = waits & state.pending.grazes & (grid.direction < 0)
        rates = _rates_at_graze(problem, state, rates, at.gathered, grazes)
    forces, before = None, rates
    if led is not None and led.constraints is not None and led.by_time is not None:
        c, by_time, normals = stop_gradient((led.constraints, led.by_time, at.normals))
        known, walls = stop_gradient((system, *here)), unilateral.sides_of(state.motion.mode)
        forces = reactions.forces_of(*known, walls, c, by_time, normals, fields)
        before, _, _ = reactions.held(forces, rates, unilateral.rests_of(state.motion.mode))
    after, opened = _known(problem, state, before, at, led, later)
    on = opened | (grazes & state.pending.surfaces)
    if system.slides:
        on = on | (after == 0 if later is None else (after == 0) & ~later)
    decide = waits & ~state.pending.grazes & any_of(opened)
    # Where a slide on an intersection ends, both the slide and the next mode would be admissible
    # within rounding.
    threshold = select(waits, 0.0, NOISE * system.eps)
    instant, soon = problem.same_time(state.motion.tau), moment(problem, state)
    if are_coupled(system):
        kept, walls = opened & ~state.pending.surfaces, None
        if led is not None:
            walls, kept = decide & led.still & opened, kept & ~led.pushed
        second = None
        if forces is None or system.slides:
            second = _seconds(system, here, soon, rates, decide, after, on)
        if forces is not None and second is not None:
            assert walls is not None
            forces, second = forces.with_slides(second, walls | unilateral.rests_of(after)), None
        question = Question(
            rates=rates,
            fields=fields,
            following=second,
            mode=after,
            on=on,
            walls=walls,
            kept=kept,
            now=state.motion.mode,
            forces=forces,
            direction=grid.direction,
            steered=steered(system),
            threshold=threshold,
            leaves=decide,
            instant=instant,
            slides=system.slides,
        )
        chosen, count = _asked(system, question)
    else:
        beside = unilateral.beside(after) if system.resets else after
        second = None
        # Elsewhere all contacts are located, at a rate that does not vanish.
        if at.unsettled is not None:
            flat = filippov.is_flat(rates[0], rates) | filippov.is_flat(rates[1], rates)
            # Where something has jumped, also a rate that vanishes up to the rounding of the time.
            wanted = decide & any_of(on & (flat | at.unsettled))
            second = _seconds(system, here, soon, rates, wanted, beside, on)
        given = second, beside, on, grid.direction, steered(system), instant, system.slides
        chosen, count = filippov.choose(None, rates, *given)
    count = select(decide, count, jnp.maximum(count, 1))
    if led is None:
        return _once(system, where(decide, chosen, after), count)
    decide = decide if led.constraints is not None else decide & ~unilateral.rests_of(after)
    return _once(system, where(decide, chosen, after), select(led.consistent, count, 0))


def _known(
    problem: Problem,
    state: LoopState,
    rates: Corners,
    at: Surfaces,
    led: Impact | None,
    later: Components | None,
) -> tuple[Components, Components]:
    """The mode as far as the event determines it, and the surfaces that the state is on and that
    are still to be decided.

    A slide that has reached the end of its weight leaves to that side; a surface that the state is
    off goes to the side given by H; after a reset, `led` determines the rest.
    """
    mode, pending = state.motion.mode, state.pending
    switching, one = pending.waits & ~pending.grazes, jnp.ones_like(state.motion.tau)
    hit = pending.surfaces if later is None else pending.surfaces & ~later
    # A slide ends at w = ±1, where the blend equals the field of that side. At a limit of turns the
    # state is on the surfaces, so no slide ends there.
    leaving = hit & (mode == 0) & ~at.off
    if state.turn is not None:
        leaving = leaving & ~state.turn.completed
    after = where(leaving & switching, _ended_at(problem, state, rates), mode)
    settles = at.off & switching
    if later is not None:  # surfaces that the state was carried across are switched first
        settles = settles & ~later
    after = where(settles, where(at.h > 0, one, -one), after)
    on = (hit & ~leaving) | is_close(problem, state, at.h)
    if at.unsettled is not None:
        here = at.unsettled & (abs(at.h) <= at.reached)
        on = on | ((here | (after == 0)) & ~leaving)
    on = switching & on & ~at.off
    if later is not None:
        on = on & ~later
    if led is None:
        return after, on
    beside, on = unilateral.sides_of(after), on & ~led.walls
    # At a surface where a rest ends, or that needs a reset, the motion takes its side.
    ends = hit & unilateral.rests_of(after) & ~resets.at_limit(state)
    ends = ends if later is None else ends | later
    after = where((ends | led.pushed) & switching & ~settles, beside, after)
    if led.constraints is not None:
        after = where(led.still, beside, after)
        return after, (on & ~ends & ~unilateral.rests_of(after)) | (switching & led.still)
    after = where(led.still, where(led.rests, 2 * beside, beside), after)
    return after, on & ~ends & ~led.still & ~unilateral.rests_of(after)


def _ended_at(problem: Problem, state: LoopState, rates: Corners) -> Components:
    """The side at which each slide ends when its weight reaches ±1."""
    mode, one = state.motion.mode, jnp.ones_like(state.motion.tau)
    if not problem.system.slides:
        return mode
    current = sliding_weights.weights(unilateral.beside(mode), rates)
    return where(current > 0, one, -one)


def _asked(system: ComponentSystem, question: Question) -> tuple[Components, Array]:
    """`decision.decide`, evaluated only where the state is on a surface."""

    def same(question: Question) -> tuple[Components, Array]:
        return question.mode, jnp.ones((), jnp.int32)

    return system.where_any(any_of(question.on), decision.decide, same, question)


def _seconds(
    system: ComponentSystem,
    here: tuple[Array, Components],
    soon: Array,
    rates: Corners,
    wanted: Array,
    mode: Components,
    on: Components,
) -> Corners:
    """d²H/dt² on all sides of the surfaces that the state is on, beside kinks a time `soon` later;
    evaluated only in lanes where it is wanted."""
    system, known = stop_gradient((system, (*here, soon)))

    def found(t: Array, x: Components, soon: Array) -> Corners:
        return next_derivatives.second_derivatives(system, t, x, mode, on, soon)

    return system.where_any(wanted, found, lambda t, x, soon: rates, *known)


def _rates_at_graze(
    problem: Problem, state: LoopState, rates: Corners, gathered: Components, grazes: Array
) -> Corners:
    """dH/dt along the fields of all sides, with rounding removed on grazed surfaces.

    The rate of a grazed surface vanishes on the side of the motion, which stays there. Rates within
    rounding of zero are replaced by ones that point to this side.
    """
    direction, dt = problem.grid.direction, typical_step(problem, state)
    noise = _TANGENT * abs(state.motion.rate) + gathered / dt

    def told(rate: Components) -> Components:
        small = grazes & state.pending.surfaces & (abs(rate) <= noise)
        return where(small, state.motion.mode * direction * noise, rate)

    return rates.map(told)
