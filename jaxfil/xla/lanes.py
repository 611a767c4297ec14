"""The number of lanes in a call.

It is the size of the batch made by `jax.vmap`, as far as Python can see it. A `vmap` around the
call is detected, under `jit` or not, but not one around a `jit` that contains the call.
"""

from typing import Any

import jax
import jax.core
from jax.custom_batching import custom_vmap


def is_batch_first(tree: Any) -> bool:
    """Whether `jax.vmap` is the innermost transformation around a call with these arguments; a
    derivative of it is then the derivative of the batch.

    >>> import jax.numpy as jnp
    >>> seen = []
    >>> f = lambda x: seen.append(is_batch_first(x)) or x
    >>> _ = jax.grad(lambda x: jax.vmap(f)(x).sum())(jnp.zeros(3))
    >>> _ = jax.vmap(jax.grad(f))(jnp.zeros(3))
    >>> seen
    [True, False]
    """
    # Tested by name, since the class is not public.
    return any(type(leaf).__name__ == "BatchTracer" for leaf in jax.tree.leaves(tree))


def lanes_of(tree: Any) -> int:
    """The number of lanes in the batch of the arrays of `tree`; 1 outside `vmap`.

    >>> import jax.numpy as jnp
    >>> seen = []
    >>> _ = jax.vmap(lambda x: seen.append(lanes_of(x)) or x)(jnp.zeros(3))
    >>> seen, lanes_of(jnp.zeros(3))
    ([3], 1)
    """
    lanes = 1

    @custom_vmap
    def same(v: Any) -> Any:
        return v

    @same.def_vmap
    def count(axis_size: int, batched: list, v: Any) -> tuple:
        nonlocal lanes
        inner = same(v)  # counts the batches around this one
        if batched[0]:
            lanes *= axis_size
        return inner, batched[0]

    for leaf in jax.tree.leaves(tree):
        if isinstance(leaf, jax.core.Tracer):
            before, lanes = lanes, 1
            same(jax.lax.stop_gradient(leaf))
            lanes = max(before, lanes)
    return lanes
