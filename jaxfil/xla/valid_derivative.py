"""Derivatives of a result only where it is valid.

A number computed from a lane that has failed, or from a step that overflows, may be replaced
afterwards, and its cotangent is then zero. Reverse mode still multiplies it by the derivatives of
all operations behind it, and ∞·0 = NaN reaches whatever the number shares with others:

    x̄ = Jᵀ ȳ,  with ȳ = 0 and J not finite

Masks at single operations (`masked_product`) would be needed at each of them. Here the flag of the
result is applied to x̄ as a whole. It is known by then, although x is an earlier number: with
ẏ = J select(valid, ẋ, 0) in forward mode, x̄ = select(valid, Jᵀ ȳ, 0).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.xla.select import select


def only_if_valid(function: Callable, *args: Any) -> Any:
    """The result y of `function(*args)`, which returns a flag and y, a pytree of arrays. Where the
    flag is not set, derivatives of y by `args` have no meaning, and a cotangent of zero gives zero.

    The function must be defined in a module, and close over no arrays.

    >>> def inverse(x):
    ...     return jnp.isfinite(1 / x), 1 / x
    >>> def sum_of_finite(a):
    ...     y = jax.vmap(lambda x: only_if_valid(inverse, a * x))(jnp.arange(3.0))
    ...     return jnp.where(jnp.isfinite(y), y, 0.0).sum()
    >>> float(jax.grad(sum_of_finite)(1.0))
    -1.5
    """
    return _call(args, function=function)[1]


@eqx.filter_custom_jvp
def _call(args: tuple, *, function: Callable) -> tuple:
    return function(*args)


@_call.def_jvp
def _call_jvp(primals: tuple, tangents: tuple, *, function: Callable) -> tuple[tuple, tuple]:
    (args,), (moves,) = primals, tangents
    # Equinox has None for a tangent that is zero.
    asked = jax.tree.map(lambda _, v: v is not None, args, moves, is_leaf=lambda v: v is None)
    moving, still = eqx.partition(args, asked)
    # A linearisation, since the flag is needed before the tangents.
    out, push = jax.linearize(lambda moving: function(*eqx.combine(moving, still)), moving)
    rates = push(jax.tree.map(lambda v: select(out[0], v, jnp.zeros_like(v)), moves))
    return out, jax.tree.map(lambda v: None if v.dtype == jax.dtypes.float0 else v, rates)


@jax.custom_jvp
def undefined_where(flag: Array, x: Array) -> Array:
    """The number x, whose derivative is NaN where the flag is set and it is not defined.

    >>> jax.grad(lambda x: undefined_where(x > 1, x * x))(jnp.float32(2.0))
    Array(nan, dtype=float32)
    """
    return x


@undefined_where.defjvp
def _undefined_where_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (flag, x), (_, rate) = primals, tangents
    return undefined_where(flag, x), rate * select(flag, jnp.nan, 1.0)
