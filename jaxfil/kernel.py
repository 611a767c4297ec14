"""One kernel for a whole function, and rows written in it.

A function of arrays enters; the same function leaves, which XLA's CPU backend compiles into a
single kernel, its loops and conditionals included, instead of one kernel for each of their parts.
Starting kernels is then no reason to put many lanes in a batch, and a batch can be so small that
its numbers stay in the first-level cache.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array

# A call that XLA neither inlines nor splits. A version that does not know these ignores them.
_WHOLE = {"inlineable": "false", "xla_cpu_small_call": "true"}


def one_kernel(function: Callable) -> Callable:
    """`function` of arrays as a single kernel.

    It may hold arithmetic, control flow and slices; XLA refuses (`jax.errors.JaxRuntimeError`) to
    compile a scatter, a sort or a library call there.
    """

    def inside(*args):
        # The attributes are those of the call, not of what it calls.
        with set_xla_metadata(**dict.fromkeys(_WHOLE)):
            return function(*args)

    def call(*args):
        with set_xla_metadata(**_WHOLE):
            return jax.jit(inside)(*args)

    return call


@custom_vmap
def write_row(rows: Array, i: Array, row: Array, write: Array) -> Array:
    """`rows`, shape (k, n), with row number i set where `write`.

    A batch of these would be a scatter, which no single kernel may hold and which takes the time of
    all lanes for the few that write. Here it is a loop over the lanes, entered if any of them
    writes, and without a derivative in reverse mode.
    """
    return rows.at[i].set(jnp.where(write, row, rows[i]))


@write_row.def_vmap
def _write_rows(axis_size: int, batched: Any, *args: Array) -> tuple[Array, bool]:
    rows, i, row, write = (
        v if flag else jnp.broadcast_to(v, (axis_size, *v.shape))
        for v, flag in zip(args, batched, strict=True)
    )
    if jax.default_backend() != "cpu":
        return jax.vmap(lambda *a: write_row.fun(*a))(rows, i, row, write), True

    keep, every = (lambda rows, *_: rows), one_kernel(_write_each)
    return jax.lax.cond(jnp.any(write), every, keep, rows, i, row, write), True


def _write_each(rows: Array, i: Array, row: Array, write: Array) -> Array:
    """`write_row` for one lane after the other."""

    def write_lane(lane: Array, rows: Array) -> Array:
        new, zero = row[lane][None, None], jnp.zeros_like(i[lane])
        place = (lane.astype(i.dtype), i[lane], zero)
        written = ft.partial(jax.lax.dynamic_update_slice, update=new, start_indices=place)
        return jax.lax.cond(write[lane], written, lambda rows: rows, rows)

    return jax.lax.fori_loop(0, rows.shape[0], write_lane, rows)


def in_blocks(function: Callable, size: int) -> Callable:
    """A function of arrays with p leading rows, applied to `size` of them at a time, each time as a
    single kernel."""
    kernel = one_kernel(function)

    def blocks(*args):
        p = args[0].shape[0]
        count = -(-p // size)
        if count == 1:
            return kernel(*args)
        pick = jnp.minimum(jnp.arange(count * size), p - 1).reshape(count, size)
        out = jax.lax.map(lambda rows: kernel(*(a[rows] for a in args)), pick)
        return jax.tree.map(lambda v: v.reshape(count * size, *v.shape[2:])[:p], out)

    return blocks
