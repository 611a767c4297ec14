"""Known numbers: values that are not traced, and can be read.

Outside every transformation a verb is a loop in Python around a few compiled functions that other
verbs share; inside one it is part of the program being traced.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.extend.core as jexc
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jax.typing import DTypeLike
from jaxtyping import Array

# Early versions of JAX have it in another module.
_MODULE: Any = jexc if hasattr(jexc, "get_opaque_trace_state") else jax.core
_state = _MODULE.get_opaque_trace_state
_F = TypeVar("_F", bound=Callable)
_Tree = TypeVar("_Tree")


def is_known(tree: Any) -> bool:
    """Whether no number of a tree is traced.

    >>> seen = []
    >>> _ = jax.jit(lambda x: seen.append(is_known(x)) or x)(1.0)
    >>> seen, is_known(1.0)
    ([False], True)
    """
    return not any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(tree))


def is_outside() -> bool:
    """Whether this is called outside of every transformation.

    >>> seen = [is_outside()]
    >>> _ = jax.grad(lambda x: seen.append(is_outside()) or x)(1.0)
    >>> seen
    [True, False]
    """
    with jax.core.eval_context():
        outside = _state()
    return _state() == outside


def without_derivatives(tree: Any) -> Any:
    """A tree whose numbers are constants to `grad`, `jacfwd` and the like. They are known unless
    `jit` or `vmap` traces them.

    >>> seen = []
    >>> _ = jax.grad(lambda x: seen.append(is_known(without_derivatives(x))) or x)(1.0)
    >>> seen
    [True]
    """
    return jax.tree.map(lambda v: stop_gradient(v) if eqx.is_array(v) else v, tree)


def array_of(value: Any, dtype: DTypeLike | None = None) -> Array:
    """`jnp.asarray` of a number or of arrays of numbers. Python and NumPy numbers are put on the
    device directly, since `jnp.asarray` would compile a program for each shape and type.

    >>> array_of(1), array_of(2.0, "float32").dtype
    (Array(1, dtype=int64, weak_type=True), dtype('float32'))
    """
    if isinstance(value, (int, float, np.number, np.ndarray)):
        array = jax.device_put(value if dtype is None else np.asarray(value, dtype))
        if is_known(array):
            return array
    return jnp.asarray(value, dtype)


def in_numpy(tree: Any) -> Any:
    """A tree with its arrays as NumPy arrays if they are known, whose arithmetic needs no
    compilation."""
    return jax.tree.map(np.asarray, tree) if is_known(tree) else tree


def part_of(tree: Any, index: Any) -> Any:
    """A tree with the part of each of its arrays at an index of their leading axes. Known arrays
    are indexed by NumPy, since JAX would compile programs for each shape and type.

    >>> part_of({"a": jnp.arange(6.0).reshape(3, 2), "b": jnp.arange(3), "f": len}, 1)
    {'a': Array([2., 3.], dtype=float64), 'b': Array(1, dtype=int64), 'f': <built-in function len>}
    """
    arrays, rest = eqx.partition(tree, eqx.is_array)  # a system may hold functions
    parts = jax.tree.map(lambda v: v[index], in_numpy(arrays))
    return eqx.combine(jax.device_put(parts) if is_known(parts) else parts, rest)


def stacked(trees: Sequence[_Tree]) -> _Tree:
    """Trees of arrays that are known, as one tree whose arrays have a leading axis. NumPy stacks
    them: JAX would compile programs for each number of trees.

    >>> stacked([{"a": jnp.zeros(2), "f": len}] * 3)["a"].shape
    (3, 2)
    """
    arrays = [eqx.filter(tree, eqx.is_array) for tree in trees]
    rows = jax.device_put(jax.tree.map(lambda *v: np.stack(v), *arrays))
    return eqx.combine(rows, eqx.filter(trees[0], eqx.is_array, inverse=True))


def power_of_two(count: int) -> int:
    """The smallest power of two that is at least `count`. Arrays are padded to this length if each
    exact length would need a compiled program of its own.

    >>> [power_of_two(count) for count in (1, 5, 8)]
    [1, 8, 8]
    """
    return 1 << (count - 1).bit_length()


def compiled_if_traced(function: _F) -> _F:
    """`function`, called directly if its arguments are known but for derivatives along them, and
    otherwise compiled as a whole, since under `vmap` alone it would be run operation by operation.
    """
    whole = eqx.filter_jit(function)

    @ft.wraps(function)
    def call(*args: Any) -> Any:
        if not is_known(without_derivatives(args)):
            return whole(*args)
        if not is_known(args):
            return function(*args)
        # A derivative may call this with known values; they must not be traced into it, so that the
        # programs are shared with other calls.
        with jax.core.eval_context():
            return function(*args)

    return call  # pyright: ignore[reportReturnType]
