"""The maps applied to a state at a switch: the tick of a clock, the reset of a surface."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.contacts import resets
from jaxfil.integrate.contacts.resets import Reset
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.system.components import Components, any_of, where
from jaxfil.integrate.system.lowered import ComponentSystem


class Maps(eqx.Module):
    """The maps applied to the state at this switch: a tick of a clock, a reset."""

    x: Components
    """The state after the maps, n components."""
    h: Components | None
    """H before the maps, m components; None for systems without maps."""
    moved: Array
    """Whether the state has changed."""
    ticked: Array | None
    """Whether a tick has changed it; None if ticks have no map."""
    reset: Reset | None
    """The reset; None without resets."""


def mapped(problem: Problem, state: LoopState, t: Array, x: Components) -> Maps:
    """The state after the map that is due, of a tick or of one surface."""
    system, number, before = problem.system, problem.ticked, x
    h = changed = None
    if system.ticks and number is not None:
        x = ticked(system, number, t, x)
        changed, h = any_of(x != before), system.switching(t, before)
    if not system.resets:
        return Maps(x, h, jnp.zeros((), bool) if changed is None else changed, changed, None)
    reset = resets.make_reset(system, state, t, x)
    if h is None or number is None or changed is None:
        return Maps(reset.x, reset.h, reset.moved, None, reset)
    # The tick comes before the reset, so H before both is H before the tick.
    h = where(number >= 0, h, reset.h)
    return Maps(reset.x, h, reset.moved | changed, changed, reset)


def ticked(system: ComponentSystem, number: Array, t: Array, x: Components) -> Components:
    """The state after the tick of a clock; −1 for none."""
    due = number >= 0

    # A closure, since a bound method of a module would be hashed, with its arrays.
    def moved(t: Array, x: Components, number: Array) -> Components:
        return system.tick(t, x, number)

    return where(due, system.where_any(due, moved, _unmoved, t, x, number), x)


def _unmoved(t: Array, x: Components, number: Array) -> Components:
    return x
