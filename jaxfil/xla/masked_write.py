"""Masked writes: an entry of a table, written by the lanes that have one.

A loop over lanes stores its events, states and samples with them.
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
    """Arrays of k entries, with `row`, one entry for each array, as entry number i where `yes`.

    A batch of writes would be a scatter, which a single kernel cannot contain, and whose cost
    grows with all lanes although few write. Here it is a loop over the lanes, entered if any of
    them writes. It has only forward derivatives.
    """
    return _write(rows, i, row, yes)


@masked_write.defjvp
def _write_jvp(primals: tuple, tangents: tuple) -> tuple:
    _, i, _, yes = primals
    (leaves, tree), rows = jax.tree.flatten(tangents[0]), jax.tree.leaves(tangents[2])
    # Entries of integers have tangents of type float0, which have no numbers to write.
    real = [k for k, leaf in enumerate(leaves) if leaf.dtype != jax.dtypes.float0]
    moved = masked_write([leaves[k] for k in real], i, [rows[k] for k in real], yes)
    for k, leaf in zip(real, moved, strict=True):
        leaves[k] = leaf
    return masked_write(*primals), jax.tree.unflatten(tree, leaves)


@custom_vmap
def _write(rows: Any, i: Array, row: Any, yes: Array) -> Any:
    def written(rows: Array, row: Array) -> Array:
        # JAX clamps an index out of range in both operations, so that the old entry is written to
        # its own place.
        old = jax.lax.dynamic_index_in_dim(rows, i, keepdims=False)
        return jax.lax.dynamic_update_index_in_dim(rows, select(yes, row, old), i, 0)

    return jax.tree.map(written, rows, row)


@_write.def_vmap
def _write_batch(axis_size: int, batched: Any, *args: Any) -> tuple:
    if axis_size == 0:  # a batch of zero lanes
        out, *_ = _broadcast(axis_size, batched, args)
    elif jax.default_backend() != "cpu":
        axes = jax.tree.map(lambda flag: 0 if flag else None, list(batched))
        out = jax.vmap(_write.fun, tuple(axes), axis_size=axis_size)(*args)
    else:
        out = _write_lanes(*_broadcast(axis_size, batched, args))
    return out, jax.tree.map(lambda _: True, out)


def _broadcast(axis_size: int, batched: Any, args: Any) -> Any:
    """The arguments, all broadcast to the axis of the batch."""

    def rows(flag: bool, v: Array) -> Array:
        return v if flag else jnp.broadcast_to(v, (axis_size, *v.shape))

    return jax.tree.map(rows, list(batched), list(args))


@custom_vmap
def _write_lanes(rows: Any, i: Array, row: Any, yes: Array) -> Any:
    """`_write` for lanes along a first axis of all arguments."""
    # `kernel_if_it_fits` is not used, since its barrier would copy the rows. Distributed arrays are
    # written outside a kernel, since XLA would gather them inside it, which kernels do not support.
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
