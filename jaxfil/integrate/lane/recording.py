"""The table of events, and how an entry is written into a table."""

from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import EventTable, LoopState, StepEnd
from jaxfil.integrate.system.components import (
    Components,
    any_of,
    first_set,
    largest,
    on_each,
    pack,
    total,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.model.outcomes import EventKind
from jaxfil.xla.masked_write import masked_write
from jaxfil.xla.select import select


def entered(record: Any, i: Array, yes: Array, entry: Any) -> Any:
    """`record`, of arrays of k entries, with `entry`, of one each, as number i where `yes`."""
    if all(isinstance(v, jax.Array) for v in vars(record).values()):
        return masked_write(record, i, entry, yes)
    # The buffers of a loop that keeps checkpoints.
    # Equinox types it for Python's booleans; it takes arrays.
    put: Any = eqxi.buffer_at_set
    rows = {name: put(v, i, vars(entry)[name], pred=yes) for name, v in vars(record).items()}
    return type(record)(**rows)


def empty_table(system: ComponentSystem, size: int | None) -> EventTable | None:
    """An event table without events; None if none is to be kept."""
    if size is None or system.m == 0:
        return None
    return EventTable(
        ts=jnp.full((size,), jnp.inf, system.dtype),
        xs=jnp.full((size, system.n), jnp.inf, system.dtype),
        members=jnp.zeros((size, system.m), bool),
        kinds=jnp.zeros((size,), jnp.int8),
        modes=jnp.zeros((size, system.m), jnp.int8),
    )


def mode_codes(mode: Components) -> Array:
    """The modes as an (m,) array of small integers."""
    return pack(mode, jnp.int8).astype(jnp.int8)


def _kind(problem: Problem, state: LoopState, end: StepEnd) -> Array:
    """What the switch just made was, told from the modes of the surfaces hit."""
    old, new = state.motion.mode, end.motion.mode
    left, held = old == 0, new == 0
    if problem.system.resets:
        left, held = left | (abs(old) == 2), held | (abs(new) == 2)
    slip = where(left, EventKind.slip.value, EventKind.crossing.value)
    kinds = where(held, EventKind.stick.value, slip).astype(jnp.int8)
    if problem.system.resets or problem.system.ticks:
        # Across without a zero of H on the way.
        far = state.pending.jumped & (old * new == -1) & (end.motion.g > end.gathered)
        kinds = where(far, EventKind.carry.value, kinds).astype(jnp.int8)
    graze = jnp.asarray(EventKind.graze.value, jnp.int8)
    changed = end.members & (old != new)
    first = largest(where(first_set(changed), kinds, 0))
    kind = select(any_of(changed), first, graze)
    if problem.system.resets:
        kind = select(end.moved, jnp.asarray(EventKind.impact.value, jnp.int8), kind)
    if end.ticked is not None:
        kind = select(end.ticked, jnp.asarray(EventKind.tick.value, jnp.int8), kind)
    return kind


@jax.custom_jvp
def _infinite_rate(gap: Array, touched: Array) -> Array:
    """Zero, with an infinite derivative with respect to the gap where it is touched: the time of a
    contact as the contact becomes a touch."""
    return jnp.zeros_like(gap)


@_infinite_rate.defjvp
def _infinite_rate_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    gap, touched = primals
    # Twice the square root of the largest number: no change stays no change, where a product with
    # infinity would be NaN. The barrier keeps the two from being multiplied into one infinity.
    root = select(touched, 2 * jnp.sqrt(jnp.finfo(gap.dtype).max), 0.0).astype(gap.dtype)
    grown = jax.lax.optimization_barrier(tangents[0] * root)
    return jnp.zeros_like(gap), grown * root


def _event_time(problem: Problem, state: LoopState, end: StepEnd) -> Array:
    late = on_each(_infinite_rate, end.motion.g, state.pending.grazes & state.pending.surfaces)
    return problem.grid.t0 + state.motion.tau + total(late)


def record_event(
    problem: Problem, state: LoopState, end: StepEnd, made: Array
) -> EventTable | None:
    """The event table of a lane with the switch made at the end of a step, where one was made."""
    table = state.table
    if table is None:
        return None
    size = table.ts.shape[0]
    entry = EventTable(
        ts=_event_time(problem, state, end),
        xs=pack(state.motion.x, problem.system.dtype),
        members=pack(end.members, bool),
        kinds=_kind(problem, state, end),
        modes=mode_codes(end.motion.mode),
    )
    i = jnp.minimum(state.counts.num_events, size - 1)
    return entered(table, i, made & (state.counts.num_events < size), entry)
