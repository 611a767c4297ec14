"""Derivatives of roots that are zero where they are infinite.

A slide or a rest stays exactly on its surface, so that a root of H in its field, such as the
outflow √h of a tank that is empty, does not change; but its derivative there would be ∞·0 = NaN.
With a slope of zero in place of the infinite one it is 0, as is right for a motion that stays.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from jaxfil.xla.select import select

ROOTS = frozenset({"acos", "acosh", "asin", "cbrt", "pow", "sqrt"})
"""Elementwise operations that may have a value where they have an infinite slope."""


def bounded(function: Callable) -> Callable:
    """`function`, which acts elementwise on numbers or arrays of one shape, with slopes of zero
    where its own are not finite.

    >>> value, slope = jax.jvp(bounded(jnp.sqrt), (jnp.float32(0.0),), (jnp.float32(1.0),))
    >>> float(value), float(slope)
    (0.0, 0.0)
    """

    @jax.custom_jvp
    def call(*args: Any) -> Array:
        return function(*args)

    # Symbolic, so that no slope is computed for an operand without a tangent.
    @ft.partial(call.defjvp, symbolic_zeros=True)
    def push(args: tuple, moves: tuple) -> tuple:
        out = call(*args)
        rate = jnp.zeros_like(out)
        for k, move in enumerate(moves):
            if not isinstance(move, SymbolicZero):

                def by_one(v: Any, k: int = k) -> Array:
                    return function(*args[:k], v, *args[k + 1 :])

                _, slope = jax.jvp(by_one, (args[k],), (jnp.ones_like(args[k]),))
                rate = rate + select(jnp.isfinite(slope), slope, jnp.zeros_like(slope)) * move
        return out, rate

    return call
