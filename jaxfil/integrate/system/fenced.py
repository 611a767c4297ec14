"""Values that the compiler computes once.

XLA's CPU backend fuses operations into loops and recomputes a value in the loop of each of its
users. Without a fence, a cosine that two stages share would be computed twice, and a stage once for
each later stage. XLA sees through `optimization_barrier`, but not through a conditional on a value
unknown to it (`once`), nor past a division by a value of each lane, which it considers expensive
(`Traced`). Other backends have no fence. Check: count sines in the optimised HLO.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array


class Fenced(eqx.Module):
    """What has a fence."""

    _opaque_one: Array | None
    """The number 1, opaque to the compiler; None on backends without a fence."""

    def once(self, function: Callable, *args: Any) -> Any:
        """`function(*args)`, each argument and each result computed once.

        A conditional that always takes its first branch, on a condition opaque to the compiler.
        """
        if self._opaque_one is None:
            return function(*args)

        def never(*args: Any) -> Any:
            shapes = jax.eval_shape(function, *args)
            return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

        return jax.lax.cond(self._opaque_one > 0, function, never, *args)

    def where_any(self, flag: Array, function: Callable, otherwise: Callable, *args: Any) -> Any:
        """`function(*args)` if the flag of any lane is set, else `otherwise(*args)`. The two must
        agree where the flag is unset. On a CPU the other branch is not computed."""
        if self._opaque_one is None:
            return function(*args)
        return jax.lax.cond(eqxi.unvmap_any(flag), function, otherwise, *args)

    def hold(self, values: Any) -> Any:
        """The same values, each computed once."""
        return self.once(lambda held: held, values)
