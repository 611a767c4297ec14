"""What is kept on the way: saved states and the event table.

A lane before and after an iteration enters; its buffers with one more entry leave.
"""

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.components import Blocks, Scene, pack
from jaxfil.integrate.state import Lane, Policy, Saves, Span, Table, View
from jaxfil.model.outcomes import KINDS
from jaxfil.xla.masked_write import write


def _entered(record: Any, i: Array, yes: Array, entry: Any) -> Any:
    """`record`, of arrays of k entries, with `entry`, of one each, as number i where `yes`."""
    if all(isinstance(v, jax.Array) for v in vars(record).values()):
        return write(record, i, entry, yes)
    # The buffers of a loop that keeps checkpoints.
    # Equinox types it for Python's booleans; it takes arrays.
    put: Any = eqxi.buffer_at_set
    rows = {name: put(v, i, vars(entry)[name], pred=yes) for name, v in vars(record).items()}
    return type(record)(**rows)


def empty_table(scene: Scene, size: int | None) -> Table | None:
    """An event table without events; None if none is to be kept."""
    if size is None or scene.m == 0:
        return None
    return Table(
        ts=jnp.full((size,), jnp.inf, scene.dtype),
        xs=jnp.full((size, scene.n), jnp.inf, scene.dtype),
        members=jnp.zeros((size, scene.m), bool),
        kinds=jnp.zeros((size,), jnp.int8),
        modes=jnp.zeros((size, scene.m), jnp.int8),
    )


def empty_saves(scene: Scene, save: str, size: int) -> Saves | None:
    """Space for what the policy `save` keeps, `size` times; times and states not reached stay inf,
    as in diffrax."""
    if save == "none":
        return None
    told = 0 if save == "samples" else size
    return Saves(
        ts=jnp.full((told,), jnp.inf, scene.dtype),
        xs=jnp.full((size, scene.n), jnp.inf, scene.dtype),
        modes=jnp.zeros((told, scene.m), jnp.int8),
    )


def mode_codes(mode: Blocks) -> Array:
    """The modes as an (m,) array of small integers."""
    return jnp.stack(mode).astype(jnp.int8) if mode else jnp.zeros((0,), jnp.int8)


def _kind(lane: Lane, view: View, resets: bool) -> Array:
    """What the switch just made was, told from the modes of the surfaces hit."""
    kind: Any = jnp.asarray(KINDS.graze.value, jnp.int8)
    for hit, old, new in reversed(list(zip(lane.hit, lane.mode, view.mode, strict=True))):
        slip = jnp.where(old == 0, KINDS.slip.value, KINDS.crossing.value)
        change = jnp.where(new == 0, KINDS.stick.value, slip).astype(jnp.int8)
        kind = jnp.where(hit & (old != new), change, kind)
    if resets:
        impact = jnp.asarray(KINDS.impact.value, jnp.int8)
        kind = jnp.where(view.moved, impact, kind)
    return kind


@jax.custom_jvp
def _infinite_rate(gap: Array, touched: Array) -> Array:
    """Zero, with an infinite derivative with respect to the gap where it is touched: the time of a
    contact as the contact becomes a touch."""
    return jnp.zeros_like(gap)


@_infinite_rate.defjvp
def _infinite_rate_jvp(primals, tangents):
    gap, touched = primals
    # Twice the square root of the largest number: no change stays no change, where a product with
    # infinity would be NaN. The barrier keeps the two from being multiplied into one infinity.
    root = jnp.where(touched, 2 * jnp.sqrt(jnp.finfo(gap.dtype).max), 0.0).astype(gap.dtype)
    grown = jax.lax.optimization_barrier(tangents[0] * root)
    return jnp.zeros_like(gap), grown * root


def _event_time(span: Span, lane: Lane, view: View) -> Array:
    t = span.t0 + lane.tau
    for hit, g in zip(lane.hit, view.g, strict=True):
        t = t + _infinite_rate(g, lane.graze & hit)
    return t


def record_event(scene: Scene, span: Span, lane: Lane, view: View, made: Array) -> Table | None:
    """The event table of `lane` with the switch made in `view`, where one was made."""
    table = lane.table
    if table is None:
        return None
    size = table.ts.shape[0]
    entry = Table(
        ts=_event_time(span, lane, view),
        xs=pack(lane.x, scene.dtype),
        members=jnp.stack(lane.hit),
        kinds=_kind(lane, view, scene.resets),
        modes=mode_codes(view.mode),
    )
    i = jnp.minimum(lane.num_events, size - 1)
    return _entered(table, i, made & (lane.num_events < size), entry)


def keep_sample(policy: Policy, lane: Lane, after: Lane, x: Blocks, gridded: Array) -> Lane:
    """`after`, to which `lane` has gone on, with its state x saved if it is `gridded`, at a grid
    point just reached, and that is a sample."""
    assert lane.saves is not None and policy.first is not None and policy.every is not None
    # Counted, since a remainder for every lane would take 7 % of the time of a sweep.
    save = gridded & (after.index == policy.first + lane.num_saved * policy.every)
    xs = write(lane.saves.xs, lane.num_saved, jnp.stack(x), save)
    return eqx.tree_at(
        lambda lane: (lane.saves, lane.num_saved),
        after,
        (Saves(lane.saves.ts, xs, lane.saves.modes), lane.num_saved + save.astype(jnp.int32)),
    )


def save_state(scene: Scene, span: Span, lane: Lane, view: View, save: Array) -> Saves | None:
    """The saves of `lane` with the state of `view`, where `save` is set and space is left."""
    saves = lane.saves
    if saves is None:
        return None
    size = saves.ts.shape[0]
    entry = Saves(span.t0 + view.tau, pack(view.x, scene.dtype), mode_codes(view.mode))
    i = jnp.minimum(lane.num_saved, size - 1)
    return _entered(saves, i, save & (lane.num_saved < size), entry)
