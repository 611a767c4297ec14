"""The turn of an accumulation that is under way (see `accumulation`)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.lowered import ComponentSystem

# A contact that is not repeated within this many others does not belong to a turn.
LONGEST = 16


class Turn(eqx.Module):
    """A turn through the sides of coupled surfaces, from one contact to the next of its kind."""

    kind: Array
    """The kind of the contact at which the turn started; −1 before the first contact."""
    tau: Array
    """Elapsed time of that contact."""
    tau_low: Array
    """Low-order part of this time."""
    x: Components
    """State at that contact, n components."""
    length: Array
    """Length in time of the turn before; 0 without one."""
    move: Components
    """Displacement of the state in the turn before, n components."""
    left: Array
    """Time from that contact to the limit of turns, as predicted by the turn before; inf without a
    prediction."""
    limit: Components
    """State at this limit, n components."""
    met: Components
    """The surfaces reached since that contact, m components."""
    late: Array
    """Uncertainty of the times of these contacts."""
    contacts: Array
    """Number of contacts since."""
    completed: Array
    """Whether the next switch is the one at the limit."""
    copy: Components | None
    """The state of the small copy of this turn, less ε times the state itself, n components; None
    without resets."""


def has_turns(system: ComponentSystem) -> bool:
    """Whether contacts may accumulate by turns, through the sides of coupled surfaces or from one
    wall to another."""
    return system.m > 1 and (system.resets or (system.slides and not system.structure.separate))


def no_turn(system: ComponentSystem, x: Components) -> Turn | None:
    """The turn at t0, before any contact."""
    if not has_turns(system):
        return None
    zero, false = jnp.zeros((), system.dtype), jnp.zeros((), bool)
    return Turn(
        kind=zero - 1,
        tau=zero,
        tau_low=zero,
        x=x,
        length=zero,
        move=x.like(zero),
        left=zero + jnp.inf,
        limit=x,
        met=system.for_each_surface(false),
        late=zero,
        # As after too many contacts, so that the first one starts a turn.
        contacts=jnp.full((), LONGEST, jnp.int32),
        completed=false,
        copy=x if system.resets else None,
    )
