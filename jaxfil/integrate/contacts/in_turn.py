"""The changes of a decision, one after the other.

A decision may change the modes of several surfaces. Each kind of change, such as the end of a slide
or the start of a rest, is an event of its own, with a switch of its own at the same time. The modes
are decided once, and the next switch carries out the rest of the decision, unless a reset comes
first.
"""

import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.contacts.decide import Decision
from jaxfil.integrate.contacts.guards import stays_on
from jaxfil.integrate.contacts.maps import Maps
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.system.components import Components, any_of, first_set, total, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select


def as_planned(state: LoopState, choice: Decision, later: Components | None) -> Decision:
    """The decision, or the switch before's if this one carries out the rest of it. No map is
    applied then, and the state is the same, but a surface may need a reset in the modes since."""
    pending = state.pending
    if pending.planned is None:
        return choice
    holds = pending.waits & pending.planned
    if later is not None:
        holds = holds & ~any_of(later)
    mode = where(holds, pending.plan, choice.mode)
    return Decision(mode, select(holds, 1, choice.count))


def in_turn(
    problem: Problem, state: LoopState, maps: Maps, choice: Decision, later: Components | None
) -> tuple[Decision, Array | None, Array | None]:
    """The part of the decision that belongs to this switch, whether another switch must follow at
    the same time, and whether the next switch decides all surfaces again. Changes that a contact or
    a map causes on other surfaces, such as the end of a slide, are events of their own."""
    system, mode = problem.system, state.motion.mode
    if system.m == 1 and maps.ticked is None:
        return choice, None, None
    hit = state.pending.surfaces if later is None else state.pending.surfaces & ~later
    if maps.reset is not None:
        hit = where(maps.reset.moved, maps.reset.acted, hit)
    switching, carried = state.pending.waits & ~state.pending.grazes, jnp.zeros((), bool)
    if later is not None:
        # While some surfaces have sides that the state is not on, no other one is decided.
        carried = any_of(later) & (maps.moved | state.pending.jumped)
    cause = (switching & (any_of(hit) | maps.moved)) | carried
    changed = choice.mode != mode
    # Without a contact or a map all changes belong to this switch that are of one kind.
    others = changed & ~where(cause, hit, _alike(system, mode, choice.mode))
    again = switching & any_of(others)
    if later is not None:
        # A surface that waits for its reset takes its side at once.
        others, again = others & ~later, again & ~any_of(later)
    # If the next switch decides again, a decision with no mode or several is not a failure yet.
    redone, count = again | carried, select(again, jnp.maximum(choice.count, 1), choice.count)
    count = select(carried, 1, count)
    kept = where(others & (cause | redone), mode, choice.mode)
    return Decision(kept, count), again, redone


def _alike(system: ComponentSystem, before: Components, after: Components) -> Components:
    """The surfaces whose mode changes in the same way as the lowest one's: to be held, to be no
    longer held, or from side to side."""
    one = jnp.ones((), system.dtype)
    ways = where(stays_on(system, before), one, 0.0 * one)
    ways = where(stays_on(system, after), 2.0 * one, ways)
    first = first_set(before != after)
    return ways == total(where(first, ways, 0.0))
