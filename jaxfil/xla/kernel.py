"""One kernel for a whole function.

On a CPU, XLA compiles a function into one kernel for each of its parts. The functions here make it
compile the whole function into a single kernel, loops and conditionals included. Large batches are
then no longer needed to amortise the start of kernels, and a batch can be small enough for its
numbers to stay in the first-level cache.
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
"""The largest number of lanes in one kernel. All of their numbers stay in the first-level cache,
and lanes wait for few others. A larger batch is processed in blocks of this size."""


def _kernel_of(program: Any) -> Callable:
    """A closed program as a function of its arguments, compiled into a single kernel."""
    run = call_of(by_sums(program))

    def call(*values: Any) -> Any:
        # XLA aborts on a kernel with an unused argument. Two barriers keep all of them in use. The
        # one after the kernel holds a number computed from all of them, which XLA would remove
        # otherwise. The one before it holds arguments that XLA knows as constants, such as a t0 of
        # zero under a user's `jit`, which it would write into the kernel. (One constant alone was
        # harmless; a copy of it as the initial value of a user's loop was not.)
        whole = kernel_of_all(lambda *values: (run(*values), _all_used(values)))
        out = whole(*jax.lax.optimization_barrier(_in_memory(values)))
        out, _ = jax.lax.optimization_barrier(out)
        return out

    return call


def _in_memory(values: Sequence[Any]) -> list[Any]:
    """The same values, with large constant arrays hidden from the compiler. XLA aborts on a kernel
    with one as an argument (jaxlib 0.7.2 to 0.10.2)."""
    large = [v.size * v.dtype.itemsize >= LARGE for v in values]
    if not any(large):
        return list(values)
    # A selection that XLA cannot fold, since it does not know that no square is 3 modulo 4.
    number = jax.lax.optimization_barrier(_all_used(values)).astype(jnp.int32)
    never = (number * number) & 3 == 3
    return [
        select(never, jnp.zeros_like(v), v) if flag else v
        for v, flag in zip(values, large, strict=True)
    ]


def kernel_of_all(function: Callable) -> Callable:
    """`function` as a single kernel. It must use all of its arguments and close over nothing, since
    XLA (jaxlib 0.10.2) aborts otherwise."""
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
    """A number computed from all values."""
    firsts = [jnp.ravel(v)[0].astype(jnp.float32) for v in values if v.size]
    return jnp.asarray(sum(firsts), jnp.float32)


def kernel_if_it_fits(function: Callable, one_by_one: bool = False) -> Callable:
    """`function` of arrays as a single kernel on a CPU, if all of it fits into one.

    This is decided from its operations before compilation, so that it also works inside a
    transformation that is compiled elsewhere. Its derivatives of both modes are single kernels too
    (`forward_jacobian`), and so are the blocks of a batch. Lanes that are run `one_by_one` use the
    program of one lane, which compiles in half the time of a block's; the directions of a Jacobian
    share a lane and remain a block.
    """

    def call(*args: Any) -> Any:
        # Values that the function closes over become arguments, since they may be batched.
        program, values, tree = opened(function, args)
        whole = fits(program.jaxpr)
        # The arguments that derivatives add to a program are rates, at the end of its arguments.
        alone = len(values) if one_by_one else 0
        make = ft.partial(_whole, lanes=1, alone=alone) if whole else plainly
        return jax.tree.unflatten(tree, with_derivatives(program, make)(*values))

    return call


def tree_in_kernel(function: Callable[[], _Tree]) -> _Tree:
    """The result of a function, with its arrays computed by a single kernel if they fit into one.
    Many small parts take longer to compile than one kernel of them."""
    rest: list[Any] = []

    def arrays() -> Any:
        made, other = eqx.partition(function(), eqx.is_array)
        rest[:] = [other]
        return made

    return eqx.combine(kernel_if_it_fits(arrays)(), *rest)


def _whole(program: Any, spread: Spread, lanes: int, alone: int) -> Callable:
    """A program for a number of lanes as a function, and as a single kernel. `spread` says which of
    its results are batched, given its batched arguments. If any of the first `alone` arguments is
    batched, the lanes are run one by one."""
    return ft.partial(kernel_p.bind, program=program, spread=spread, lanes=lanes, alone=alone)


# A primitive, since under `vmap` JAX's own rules would take a kernel apart, and XLA would fuse its
# parts in its own way. With the rule below, a batch is a kernel again. (So are tangents, see
# `pushforward`.) A function that is batched at once is also not traced for one lane before.
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
    if size == 0:  # a batch of zero lanes; the shapes of its results come from the program
        outs = zip(program.out_avals, spreads, strict=True)
        return [jnp.zeros(((0,) if flag else ()) + v.shape, v.dtype) for v, flag in outs], out_axes
    if any(batched[:alone]):
        whole = _whole(program, spread, lanes, alone)
        return _one_by_one(whole, batched, values), out_axes
    run, axes = operations(program), [0 if flag else None for flag in batched]
    # In a batch of batches all lanes count, since more than a block does not stay in the cache.
    rows = min(size, max(1, BLOCK // lanes))
    several = jax.vmap(run, axes, out_axes, axis_size=rows)
    some = [v[:rows] if flag else v for v, flag in zip(values, batched, strict=True)]
    together = jax.make_jaxpr(several)(*some)
    if not fits(together.jaxpr):  # sums may be too long in a batch
        return jax.vmap(run, axes, out_axes, axis_size=size)(*values), out_axes
    block = _whole(together, spread, lanes * rows, alone)
    return _in_turns(block, batched, spreads, size, rows)(*values), out_axes


kernel_p.def_impl(_run)
kernel_p.def_abstract_eval(_abstract)
batching.primitive_batchers[kernel_p] = _batch


def _in_parts(*values: Any, program: Any, **_: Any) -> list:
    return operations(program)(*values)


def _lowered(context: Any, *values: Any, **params: Any) -> Any:
    """A kernel, or its parts if the program is compiled for several devices. XLA would distribute
    the kernel's arrays over them, by functions that kernels are not linked with. Under
    `jax.shard_map` each device has a program of its own, so a kernel is possible."""
    several = (getattr(context.module_context.axis_context, "num_devices", None) or 1) > 1
    lower = mlir.lower_fun(_in_parts if several else _run, multiple_results=True)
    return lower(context, *values, **params)


mlir.register_lowering(kernel_p, _lowered)


def _one_by_one(function: Callable, batched: Sequence[bool], values: Sequence[Any]) -> Any:
    """A function applied to the rows of the `batched` values one after the other."""

    def turn(row: list) -> Any:
        return function(*(v if own is None else own for own, v in zip(row, values, strict=True)))

    # None is an empty tree, which `lax.map` ignores.
    return jax.lax.map(turn, [v if flag else None for v, flag in zip(values, batched, strict=True)])


def kernel_of_rows(function: Callable, size: int, *args: Any) -> Callable | None:
    """A function of `size` leading rows of all its arguments, extended to any number of rows. It is
    applied to `size` rows at a time, as a single kernel. None if it does not fit into one.

    This is for lanes that wait for each other, as in a sweep, and have no derivatives; for
    independent lanes use `kernel_if_it_fits` under `jax.vmap`. `args` are the arguments, or arrays
    of the same shapes up to the number of rows.
    """
    some = jax.tree.map(lambda v: jnp.zeros((size, *v.shape[1:]), v.dtype), args)
    program, values, tree = opened(function, some)
    if not fits(program.jaxpr):
        return None
    count = len(jax.tree.leaves(args))
    # Values that the function closes over come first, and are the same for all rows.
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
    """A function of `size` rows of the `batched` arguments, extended to p rows, by applying it to
    `size` of them at a time. The results flagged in `spreads` are rows too."""
    count = -(-p // size)

    def call(*args: Any) -> Any:
        if p == size:
            return function(*args)
        # The last block is filled up with copies of the last row, cut off again in `joined`.
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
