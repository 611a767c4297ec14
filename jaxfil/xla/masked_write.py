"""An entry of a table, written by those lanes that have one.

Arrays of k entries, a number and one entry enter; the arrays with that entry leave. This is what a
loop over lanes keeps its events, states and samples with.
"""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array

from jaxfil.xla.compiler import may_be_spread
from jaxfil.xla.kernel import kernel_of_all
from jaxfil.xla.select import select


@jax.custom_jvp
def masked_write(rows: Any, i: Array, row: Any, yes: Array) -> Any:
    """Arrays of k entries, with `row`, one of each, as entry number i where `yes`.

    A batch of these would be a scatter, which no single kernel may hold and which takes the time of
    all lanes for the few that write. Here it is a loop over the lanes, entered if any of them
    writes. It has forward derivatives only.
    """
    return _write(rows, i, row, yes)


@masked_write.defjvp
def _write_jvp(primals: tuple, tangents: tuple) -> tuple:
    _, i, _, yes = primals
    (leaves, tree), rows = jax.tree.flatten(tangents[0]), jax.tree.leaves(tangents[2])
    real = [k for k, leaf in enumerate(leaves) if leaf.dtype != jax.dtypes.float0]
    moved = masked_write([leaves[k] for k in real], i, [rows[k] for k in real], yes)
    for k, leaf in zip(real, moved, strict=True):
        leaves[k] = leaf
    return masked_write(*primals), jax.tree.unflatten(tree, leaves)


@custom_vmap
def _write(rows: Any, i: Array, row: Any, yes: Array) -> Any:
    def written(rows: Array, row: Array) -> Array:
        old = jax.lax.dynamic_index_in_dim(rows, i, keepdims=False)
        return jax.lax.dynamic_update_index_in_dim(rows, select(yes, row, old), i, 0)

    return jax.tree.map(written, rows, row)


@_write.def_vmap
def _write_batch(axis_size: int, batched: Any, *args: Any) -> tuple:
    if axis_size == 0:  # none of them writes
        out, *_ = _broadcast(axis_size, batched, args)
    elif jax.default_backend() != "cpu":
        axes = jax.tree.map(lambda flag: 0 if flag else None, list(batched))
        out = jax.vmap(_write.fun, tuple(axes), axis_size=axis_size)(*args)
    else:
        out = _write_lanes(*_broadcast(axis_size, batched, args))
    return out, jax.tree.map(lambda _: True, out)


def _broadcast(axis_size: int, batched: Any, args: Any) -> Any:
    """Arguments all of which have the axis of the batch."""

    def rows(flag: bool, v: Array) -> Array:
        return v if flag else jnp.broadcast_to(v, (axis_size, *v.shape))

    return jax.tree.map(rows, list(batched), list(args))


@custom_vmap
def _write_lanes(rows: Any, i: Array, row: Any, yes: Array) -> Any:
    """`_write` for lanes along a first axis of all arguments."""
    # Not `kernel_if_it_fits`, whose barrier would copy the rows.
    # XLA would gather arrays that are spread inside of the kernel, which cannot.
    every = _write_each if may_be_spread() else kernel_of_all(_write_each)
    return jax.lax.cond(jnp.any(yes), every, lambda rows, *_: rows, rows, i, row, yes)


@_write_lanes.def_vmap
def _write_batches(axis_size: int, batched: Any, *args: Any) -> tuple:
    """A batch of batches is one batch."""
    args = _broadcast(axis_size, batched, args)
    shape = args[1].shape
    if 0 in shape:
        return args[0], jax.tree.map(lambda _: True, args[0])
    flat = jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), args)
    out = jax.tree.map(lambda v: v.reshape(*shape, *v.shape[1:]), _write_lanes(*flat))
    return out, jax.tree.map(lambda _: True, out)


def _write_each(rows: Any, i: Array, row: Any, yes: Array) -> Any:
    """`_write` for one lane after the other."""

    def write_lane(lane: Array, rows: Any) -> Any:
        def entered(rows: Array, row: Array) -> Array:
            place = (lane.astype(i.dtype), i[lane], *[jnp.zeros_like(i[lane])] * (rows.ndim - 2))
            return jax.lax.dynamic_update_slice(rows, row[lane][None, None], place)

        entry = ft.partial(jax.tree.map, entered)
        return jax.lax.cond(yes[lane], entry, lambda rows, _: rows, rows, row)

    return jax.lax.fori_loop(0, len(yes), write_lane, rows)
