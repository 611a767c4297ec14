"""What a lane knows of its sections, and what a trial step shows of them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane.state import CrossingTable
from jaxfil.integrate.surfaces.sections import Sight
from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.model.outcomes import RESULTS


class Watch(eqx.Module):
    """How far a lane has been watched for crossings of k sections. Lengths are signed times from
    the lane's state; components are k."""

    side: Components
    """Last sign of S, beyond rounding; 0: there has been none."""
    value: Components
    """S where it has been watched up to."""
    rate: Components
    """dS/dt there along the motion."""
    away: Components
    """Whether |S| exceeds its rounding there."""
    owed: Components
    """Whether S has jumped across zero there."""
    start: Array
    """Length up to there."""
    seeking: Array
    """Whether the next trial step is one to a crossing, looked at and taken back."""
    length: Array
    """Length of that step."""
    aim: Components
    """The section that it is to cross; none for a minimum of |S| to be looked at."""
    low: Array
    """Length before the crossing."""
    high: Array
    """Length after the crossing."""
    tries: Array
    """Trial steps that this crossing has taken."""
    counts: Components
    """Crossings so far of each section, in its direction."""
    total: Array
    """Crossings of all sections."""


class SectionState(eqx.Module):
    """What a lane knows of its sections."""

    watch: Watch
    table: CrossingTable | None
    """Crossings so far; None where none are kept."""


class Seen(eqx.Module):
    """What is known of the sections at the end of a trial step."""

    sight: Sight
    seeks: Array
    """Whether the trial step only looks for a crossing, or is taken back to do so."""
    watch: Watch
    """How the search goes on."""
    recorded: Array
    """Whether a crossing has been located."""
    number: Array
    """The section that is crossed."""
    tau: Array
    """Elapsed time of the crossing."""
    tau_low: Array
    """Low-order part of this time."""
    x: Components
    """State at the crossing."""
    result: RESULTS
    """What the crossing makes of the run."""


def unwatched(k: int, zero: Array) -> Watch:
    """The watch of k sections of which nothing is known."""
    false, none = jnp.zeros((), bool), jnp.zeros((), jnp.int32)
    nothing, flags = Components((zero,) * k), Components((false,) * k)
    return Watch(
        side=nothing,
        value=nothing,
        rate=nothing,
        away=flags,
        owed=flags,
        start=zero,
        seeking=false,
        length=zero,
        aim=flags,
        low=zero,
        high=zero,
        tries=none,
        counts=Components((none,) * k),
        total=none,
    )


def empty_crossings(system: ComponentSystem, size: int | None) -> CrossingTable | None:
    """A table without crossings; None if none are kept."""
    if size is None:
        return None
    return CrossingTable(
        ts=jnp.full((size,), jnp.inf, system.dtype),
        xs=jnp.full((size, system.n), jnp.inf, system.dtype),
        sections=jnp.full((size,), -1, jnp.int32),
        modes=jnp.zeros((size, system.m), jnp.int8),
    )
