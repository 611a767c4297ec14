"""What is kept on the way: saved states and the event table.

A lane before and after an iteration enters; its buffers with one more entry leave.
"""

import dataclasses
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem, Recording
from jaxfil.integrate.lane.state import EventTable, LoopState, SavedStates, StepEnd
from jaxfil.integrate.surfaces.filippov import ModeField
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


def empty_saves(system: ComponentSystem, recording: Recording) -> SavedStates | None:
    """Space for what is to be saved; times and states not reached stay inf, as in diffrax."""
    if recording.save == "none":
        return None
    size = recording.num_saves
    sampled = recording.save == "samples"
    return SavedStates(
        ts=jnp.full((0 if sampled else size,), jnp.inf, system.dtype),
        xs=jnp.full((size, system.n), jnp.inf, system.dtype),
        modes=jnp.zeros((0 if sampled and not recording.modes else size, system.m), jnp.int8),
    )


def mode_codes(mode: Components) -> Array:
    """The modes as an (m,) array of small integers."""
    return pack(mode, jnp.int8).astype(jnp.int8)


def _kind(problem: Problem, state: LoopState, end: StepEnd) -> Array:
    """What the switch just made was, told from the modes of the surfaces hit."""
    old, new = state.mode, end.mode
    left, held = old == 0, new == 0
    if problem.system.resets:
        left, held = left | (abs(old) == 2), held | (abs(new) == 2)
    slip = where(left, EventKind.slip.value, EventKind.crossing.value)
    kinds = where(held, EventKind.stick.value, slip).astype(jnp.int8)
    graze = jnp.asarray(EventKind.graze.value, jnp.int8)
    changed = end.members & (old != new)
    first = largest(where(first_set(changed), kinds, 0))
    kind = select(any_of(changed), first, graze)
    if problem.system.resets:
        kind = select(end.moved, jnp.asarray(EventKind.impact.value, jnp.int8), kind)
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
    late = on_each(_infinite_rate, end.g, state.graze & state.hit)
    return problem.grid.t0 + state.tau + total(late)


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
        xs=pack(state.x, problem.system.dtype),
        members=pack(end.members, bool),
        kinds=_kind(problem, state, end),
        modes=mode_codes(end.mode),
    )
    i = jnp.minimum(state.num_events, size - 1)
    return entered(table, i, made & (state.num_events < size), entry)


def keep_sample(
    problem: Problem, state: LoopState, after: LoopState, x: Components, gridded: Array
) -> LoopState:
    """`after`, to which `state` has gone on, with its state x saved if it is `gridded`, at a grid
    point just reached, and that is a sample."""
    recording = problem.recording
    assert state.saves is not None and recording.first is not None and recording.every is not None
    # Counted, since a remainder for every lane would take 7 % of the time of a sweep.
    save = gridded & (after.index == recording.first + state.num_saved * recording.every)
    saves = {"xs": state.saves.xs}, {"xs": pack(x, problem.system.dtype)}
    if recording.modes:
        saves[0]["modes"], saves[1]["modes"] = state.saves.modes, mode_codes(after.mode)
    kept = masked_write(saves[0], state.num_saved, saves[1], save)
    return dataclasses.replace(
        after,
        saves=dataclasses.replace(state.saves, **kept),
        num_saved=state.num_saved + save.astype(jnp.int32),
    )


class _InTime(eqx.Module):
    """A vector field as the rate of time and state together."""

    field: ModeField

    def __call__(self, at: Any) -> Any:
        t, x = at
        return jnp.ones_like(t), self.field(t, x)


class _Linearised(eqx.Module):
    """A field together with its linearisation, as the rate of what moves and of its tangent."""

    field: Any
    by_field: Any

    def __call__(self, at: Any) -> Any:
        now, rate = eqx.filter_jvp(lambda f, v: f(v), (self.field, at[0]), (self.by_field, at[1]))
        return now, _or_zero(rate, now)


def _or_zero(rate: Any, of: Any) -> Any:
    """A tangent, zero where equinox has left it out."""
    return eqx.combine(rate, jax.tree.map(jnp.zeros_like, of))


@eqx.filter_custom_jvp
def _moved(gap: Array, at: Any, field: Any) -> Any:
    """`at`, which moves along the field with a gap that is zero but for its derivatives. The field
    is computed for these alone."""
    return at


@_moved.def_jvp
def _moved_jvp(primals: tuple, tangents: tuple) -> tuple:
    gap, at, field = primals
    by_gap, rate, by_field = tangents
    rate = _or_zero(rate, at)
    # Both move themselves, which gives the second derivatives, and so on.
    at, rate = _moved(gap, (at, rate), _Linearised(field, by_field))
    if by_gap is not None:
        rate = jax.tree.map(lambda own, f: own + by_gap * f, rate, field(at))
    return at, rate


def _at_saving_time(problem: Problem, state: LoopState, end: StepEnd) -> tuple[Array, Components]:
    """Time and state at the end of a step to a saving time. A grid point there does not move with
    the saving time; what is saved does."""
    ts = problem.recording.ts
    t = problem.grid.t0 + end.tau
    if ts is None:
        return t, end.x
    gap = ts[jnp.minimum(state.num_saved, ts.shape[0] - 1)] - end.tau
    return _moved(gap, (t, end.x), _InTime(ModeField(problem.system, end.mode)))


def save_state(
    problem: Problem, state: LoopState, after: LoopState, end: StepEnd, save: Array
) -> LoopState:
    """`after`, to which `state` has gone on, with what is known at the end of the step saved where
    `save` is set and space is left."""
    saves = state.saves
    assert saves is not None
    size = saves.ts.shape[0]
    t, x = _at_saving_time(problem, state, end)
    entry = SavedStates(t, pack(x, problem.system.dtype), mode_codes(end.mode))
    i = jnp.minimum(state.num_saved, size - 1)
    return dataclasses.replace(
        after,
        saves=entered(saves, i, save & (state.num_saved < size), entry),
        num_saved=state.num_saved + save.astype(jnp.int32),
    )
