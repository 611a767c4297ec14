"""The table of events, and the writing of an entry into a table."""

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
    """`record`, a record of arrays with k rows, with `entry` as row i where `yes`.

    A row must be written once and never read in the loop: in the buffers of a loop with checkpoints
    the derivative would be wrong.
    """
    if all(isinstance(v, jax.Array) for v in vars(record).values()):
        return masked_write(record, i, entry, yes)
    # A loop with checkpoints has buffers of equinox in place of arrays. The type annotation of
    # `buffer_at_set` allows only Python booleans as `pred`; the function accepts arrays.
    put: Any = eqxi.buffer_at_set
    rows = {name: put(v, i, vars(entry)[name], pred=yes) for name, v in vars(record).items()}
    return type(record)(**rows)


def empty_table(system: ComponentSystem, size: int | None) -> EventTable | None:
    """An event table without entries; None for a run without a table."""
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
    """The kind of the switch, from the modes of its surfaces before and after."""
    old, new = state.motion.mode, end.motion.mode
    left, held = old == 0, new == 0
    if problem.system.resets:
        left, held = left | (abs(old) == 2), held | (abs(new) == 2)
    slip = where(left, EventKind.slip.value, EventKind.crossing.value)
    kinds = where(held, EventKind.stick.value, slip).astype(jnp.int8)
    if problem.system.resets or problem.system.clocks:
        # The surface is on the other side without a zero of H in between.
        far = state.pending.jumped & (old * new == -1) & (end.motion.g > end.gathered)
        kinds = where(far, EventKind.carry.value, kinds).astype(jnp.int8)
    graze = jnp.asarray(EventKind.graze.value, jnp.int8)
    # A contact that changes no mode is a graze.
    changed = end.members & (old != new)
    # The lowest surface that changes determines the kind.
    first = largest(where(first_set(changed), kinds, 0))
    kind = select(any_of(changed), first, graze)
    if problem.system.resets:
        kind = select(end.moved, jnp.asarray(EventKind.impact.value, jnp.int8), kind)
    if end.ticked is not None:
        # After the impact, since `moved` includes the map of a tick.
        kind = select(end.ticked, jnp.asarray(EventKind.tick.value, jnp.int8), kind)
    return kind


@jax.custom_jvp
def _infinite_rate(gap: Array, touched: Array) -> Array:
    """Zero, with an infinite derivative with respect to `gap` where `touched`. This is the limit of
    the derivative of a contact time as the contact becomes a graze."""
    return jnp.zeros_like(gap)


@_infinite_rate.defjvp
def _infinite_rate_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    gap, touched = primals
    # The factor 2 √max is applied twice. It overflows to infinity for a nonzero tangent and leaves
    # a zero tangent zero, where a product with infinity would be NaN. The barrier keeps XLA from
    # multiplying the two factors into one infinity.
    root = select(touched, 2 * jnp.sqrt(jnp.finfo(gap.dtype).max), 0.0).astype(gap.dtype)
    grown = jax.lax.optimization_barrier(tangents[0] * root)
    return jnp.zeros_like(gap), grown * root


def _event_time(problem: Problem, state: LoopState, end: StepEnd) -> Array:
    late = on_each(_infinite_rate, end.motion.g, state.pending.grazes & state.pending.surfaces)
    return problem.grid.t0 + state.motion.tau + total(late)


def record_event(
    problem: Problem, state: LoopState, end: StepEnd, made: Array
) -> EventTable | None:
    """The event table of a lane after a step, with an entry for its switch where one was made."""
    table = state.table
    if table is None:
        return None
    size = table.ts.shape[0]
    # Time and state at the landing, before maps, and the mode after them.
    entry = EventTable(
        ts=_event_time(problem, state, end),
        xs=pack(state.motion.x, problem.system.dtype),
        members=pack(end.members, bool),
        kinds=_kind(problem, state, end),
        modes=mode_codes(end.motion.mode),
    )
    i = jnp.minimum(state.counts.num_events, size - 1)
    return entered(table, i, made & (state.counts.num_events < size), entry)
