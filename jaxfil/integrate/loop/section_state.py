"""The state of the section search of a lane, and its update in a trial step."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane.state import CrossingTable
from jaxfil.integrate.surfaces.sections import Sight
from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.lowered import ComponentSystem


class Watch(eqx.Module):
    """The state of the search for crossings of k sections. Lengths are signed times from the lane's
    state, components are k, and the "watched point" is the one up to which the search is done."""

    side: Components
    """Last sign of S beyond rounding; 0 at first."""
    value: Components
    """S at the watched point."""
    rate: Components
    """dS/dt at the watched point, along the motion."""
    away: Components
    """Whether |S| exceeds its rounding at the watched point."""
    owed: Components
    """Whether S has jumped across zero at the watched point."""
    start: Array
    """Length up to the watched point."""
    seeking: Array
    """Whether the next trial step is a probe for a crossing, which is taken back."""
    length: Array
    """Length of that probe."""
    aim: Components
    """The section that the probe aims at; empty for a minimum of |S|."""
    low: Array
    """Length before the crossing."""
    high: Array
    """Length after the crossing."""
    tries: Array
    """Number of trial steps in this search."""
    counts: Components
    """Number of crossings so far of each section, in its direction."""
    total: Array
    """Number of crossings of all sections."""


class SectionState(eqx.Module):
    """The sections' state of a lane."""

    watch: Watch
    table: CrossingTable | None
    """Crossings so far; None without a table."""


class Seen(eqx.Module):
    """The sections at the end of a trial step."""

    sight: Sight
    seeks: Array
    """Whether the trial step is a probe for a crossing, or is taken back to start one."""
    watch: Watch
    """The next state of the search."""
    recorded: Array
    """Whether a crossing has been located."""
    number: Array
    """The number of the crossed section."""
    tau: Array
    """Elapsed time of the crossing."""
    tau_low: Array
    """Low-order part of this time."""
    x: Components
    """State at the crossing."""
    mode: Components
    """Mode at the crossing."""


def unwatched(bounds: tuple[bool, ...], zero: Array) -> Watch:
    """The watch of k sections before the first evaluation, of which some are bounds."""
    k, false, none = len(bounds), jnp.zeros((), bool), jnp.zeros((), jnp.int32)
    nothing, flags = Components((zero,) * k), Components((false,) * k)
    # Side 0 stands for a section that has not been beyond its rounding. The search then assumes the
    # side to which the motion goes, so that a start on a section is not a crossing of it. A start
    # on a bound is within it, so that a motion to the other side leaves it.
    return Watch(
        side=Components(jnp.ones_like(zero) if bound else zero for bound in bounds),
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
    """A table without crossings; None for a run without one."""
    if size is None:
        return None
    # Unused rows keep inf and −1, which mark the padding of `Crossings`.
    return CrossingTable(
        ts=jnp.full((size,), jnp.inf, system.dtype),
        xs=jnp.full((size, system.n), jnp.inf, system.dtype),
        sections=jnp.full((size,), -1, jnp.int32),
        modes=jnp.zeros((size, system.m), jnp.int8),
    )
