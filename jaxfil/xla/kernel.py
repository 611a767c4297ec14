"""One kernel for a whole function.

A function of arrays enters; the same function leaves, which XLA's CPU backend compiles into a
single kernel, its loops and conditionals included, instead of one kernel for each of their parts.
Starting kernels is then no reason to put many lanes in a batch, and a batch can be so small that
its numbers stay in the first-level cache.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.extend.core as jexc
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jax.interpreters import batching, mlir
from jaxtyping import Array

from jaxfil.xla.compiler import PARTS, WHOLE, makes_whole_kernels
from jaxfil.xla.fits import LARGE, fits
from jaxfil.xla.forward_jacobian import plainly, with_derivatives
from jaxfil.xla.matrix_product import by_sums
from jaxfil.xla.program import call_of, opened, operations
from jaxfil.xla.pushforward import Spread, rows_of
from jaxfil.xla.select import select

_Tree = TypeVar("_Tree")

BLOCK = 64
"""Lanes that are one kernel together, at most: few enough for all of their numbers to stay in the
first-level cache, and to wait for few others. A larger batch is so many of them at a time."""


def _kernel_of(program: Any) -> Callable:
    """A program that closes over nothing, as a function of its arguments and a single kernel."""
    run = call_of(by_sums(program))

    def call(*values: Any) -> Any:
        # On an argument that a kernel has no use for XLA aborts. The barriers keep all of them in
        # use: behind the kernel a number made of them all, which nobody else needs and XLA would
        # take out; before it those that XLA knows, such as a t0 of zero under a user's `jit`, and
        # would write into the kernel. (One of these alone did no harm, but as the copy of it that a
        # loop of the user's starts from it did.)
        whole = kernel_of_all(lambda *values: (run(*values), _all_used(values)))
        out = whole(*jax.lax.optimization_barrier(_in_memory(values)))
        out, _ = jax.lax.optimization_barrier(out)
        return out

    return call


def _in_memory(values: Sequence[Any]) -> list[Any]:
    """The same values, none of which is a large array that the compiler knows: on a kernel with one
    as an argument XLA aborts (jaxlib 0.7.2 to 0.10.2)."""
    large = [v.size * v.dtype.itemsize >= LARGE for v in values]
    if not any(large):
        return list(values)
    # A copy that is not to be known: the compiler does not know that no square ends in 3.
    number = jax.lax.optimization_barrier(_all_used(values)).astype(jnp.int32)
    never = (number * number) & 3 == 3
    return [
        select(never, jnp.zeros_like(v), v) if flag else v
        for v, flag in zip(values, large, strict=True)
    ]


def kernel_of_all(function: Callable) -> Callable:
    """`function` as a single kernel, where it uses all of its arguments and closes over nothing: on
    another one XLA (jaxlib 0.10.2) aborts."""
    if not makes_whole_kernels():
        return function

    def inside(*args: Any) -> Any:
        with set_xla_metadata(**PARTS):
            return function(*args)

    def call(*args: Any) -> Any:
        with set_xla_metadata(**WHOLE):
            return jax.jit(inside)(*args)

    return call


def _all_used(values: Sequence[Array]) -> Array:
    """A number made of all values."""
    firsts = [jnp.ravel(v)[0].astype(jnp.float32) for v in values if v.size]
    return jnp.asarray(sum(firsts), jnp.float32)


def kernel_if_it_fits(function: Callable, one_by_one: bool = False) -> Callable:
    """`function` of arrays as a single kernel on a CPU, if all of it fits into one.

    That is known from its operations, before it is compiled, so that this also serves inside of a
    transformation that somebody else compiles. So are its derivatives, of both modes: see
    `forward_jacobian`; and the blocks of a batch of either. Lanes that are run `one_by_one` take
    the program of one lane, which compiles in half the time of a block's; the directions of a
    Jacobian share a lane and stay a block.
    """

    def call(*args: Any) -> Any:
        # What the function has closed over becomes an argument: it may come as a batch.
        program, values, tree = opened(function, args)
        whole = fits(program.jaxpr)
        # What derivatives add to the arguments of a program are rates, the last ones of theirs.
        alone = len(values) if one_by_one else 0
        make = ft.partial(_whole, lanes=1, alone=alone) if whole else plainly
        return jax.tree.unflatten(tree, with_derivatives(program, make)(*values))

    return call


def tree_in_kernel(function: Callable[[], _Tree]) -> _Tree:
    """What a function returns, whose arrays are made by a single kernel if all of it fits into one.
    Many small parts take longer to compile than one kernel of them."""
    rest: list[Any] = []

    def arrays() -> Any:
        made, other = eqx.partition(function(), eqx.is_array)
        rest[:] = [other]
        return made

    return eqx.combine(kernel_if_it_fits(arrays)(), *rest)


def _whole(program: Any, spread: Spread, lanes: int, alone: int) -> Callable:
    """A program of so many lanes as a function, and as a single kernel. `spread` says which of its
    results are a batch's if some of its arguments are. A batch of any of the first `alone` ones is
    run one by one."""
    return ft.partial(kernel_p.bind, program=program, spread=spread, lanes=lanes, alone=alone)


# A kernel under `vmap` would be taken apart by JAX's own rules, and its parts put together again by
# XLA as it likes. Here the batch is a kernel again. (Tangents are too: see `pushforward`.) And what
# is put into a batch at once is not traced as one lane before.
kernel_p = jexc.Primitive("kernel")
kernel_p.multiple_results = True


def _run(*values: Any, program: Any, **_: Any) -> Any:
    return _kernel_of(program)(*values)


def _abstract(*_: Any, program: Any, **__: Any) -> list:
    return program.out_avals


def _batch(
    args: Any, dims: Any, *, program: Any, spread: Spread, lanes: int, alone: int
) -> tuple[list, list]:
    size, batched, values = rows_of(args, dims)
    spreads = spread(batched)
    out_axes = [0 if flag else None for flag in spreads]
    if size == 0:  # there is no lane to run, and none to take a result's shape from
        outs = zip(program.out_avals, spreads, strict=True)
        return [jnp.zeros(((0,) if flag else ()) + v.shape, v.dtype) for v, flag in outs], out_axes
    if any(batched[:alone]):
        whole = _whole(program, spread, lanes, alone)
        return _one_by_one(whole, batched, values), out_axes
    run, axes = operations(program), [0 if flag else None for flag in batched]
    # A batch of batches counts all its lanes: more than a block does not stay in the cache.
    rows = min(size, max(1, BLOCK // lanes))
    several = jax.vmap(run, axes, out_axes, axis_size=rows)
    some = [v[:rows] if flag else v for v, flag in zip(values, batched, strict=True)]
    together = jax.make_jaxpr(several)(*some)
    if not fits(together.jaxpr):  # sums that are long enough in a batch
        return jax.vmap(run, axes, out_axes, axis_size=size)(*values), out_axes
    block = _whole(together, spread, lanes * rows, alone)
    return _in_turns(block, batched, spreads, size, rows)(*values), out_axes


kernel_p.def_impl(_run)
kernel_p.def_abstract_eval(_abstract)
batching.primitive_batchers[kernel_p] = _batch


def _in_parts(*values: Any, program: Any, **_: Any) -> list:
    return operations(program)(*values)


def _lowered(context: Any, *values: Any, **params: Any) -> Any:
    """A kernel, or its parts where a program is made for several devices: XLA would spread its
    arrays over them, by functions that kernels are not linked with. Under `jax.shard_map` each
    device has a program of its own."""
    several = (getattr(context.module_context.axis_context, "num_devices", None) or 1) > 1
    lower = mlir.lower_fun(_in_parts if several else _run, multiple_results=True)
    return lower(context, *values, **params)


mlir.register_lowering(kernel_p, _lowered)


def _one_by_one(function: Callable, batched: Sequence[bool], values: Sequence[Any]) -> Any:
    """A function of the rows of those values that are `batched`, applied to one after the other."""

    def turn(row: list) -> Any:
        return function(*(v if own is None else own for own, v in zip(row, values, strict=True)))

    # A None is nothing to go along.
    return jax.lax.map(turn, [v if flag else None for v, flag in zip(values, batched, strict=True)])


def kernel_of_rows(function: Callable, size: int, *args: Any) -> Callable | None:
    """A function of `size` leading rows of all its arguments, for any number of rows: applied to so
    many of them at a time, each time as a single kernel. None where it does not fit into one.

    This is for lanes that wait for each other, as those of a sweep do, and have no derivatives:
    lanes that do not are `kernel_if_it_fits` under `jax.vmap`. `args` are what it will be called
    with, or arrays of the same shapes but for the number of rows.
    """
    some = jax.tree.map(lambda v: jnp.zeros((size, *v.shape[1:]), v.dtype), args)
    program, values, tree = opened(function, some)
    if not fits(program.jaxpr):
        return None
    count = len(jax.tree.leaves(args))
    # What the function has closed over comes first, and is the same for all rows.
    closed = values[: len(values) - count]
    batched = [False] * len(closed) + [True] * count
    every = [True] * len(program.out_avals)
    kernel = _kernel_of(program)

    def call(*args: Any) -> Any:
        rows = jax.tree.leaves(args)
        return jax.tree.unflatten(
            tree, _in_turns(kernel, batched, every, len(rows[0]), size)(*closed, *rows)
        )

    return call


def _in_turns(
    function: Callable, batched: Sequence[bool], spreads: Sequence[bool], p: int, size: int
) -> Callable:
    """A function of `size` rows of those arguments that are `batched`, for p rows: applied to
    `size` of them at a time. Of its results those that `spreads` flags are rows too."""
    count = -(-p // size)

    def call(*args: Any) -> Any:
        if p == size:
            return function(*args)
        pick = jnp.minimum(jnp.arange(count * size), p - 1).reshape(count, size)

        def turn(rows: Array) -> Any:
            return function(
                *(a[rows] if flag else a for a, flag in zip(args, batched, strict=True))
            )

        def joined(v: Array) -> Array:
            return v.reshape(count * size, *v.shape[2:])[:p]

        out = jax.lax.map(turn, pick)
        return [joined(v) if flag else v[0] for v, flag in zip(out, spreads, strict=True)]

    return call
