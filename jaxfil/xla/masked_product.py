"""Derivatives that are zero where the cotangent is zero.

With `jnp.where`, reverse mode multiplies the derivative of a branch that is not taken by a zero
cotangent, which is NaN if that derivative is infinite or NaN. Forward mode has no such problem:

    where(x > 0, sqrt(x), -x) at x = −1:    forward    select(NaN·dx, −dx) = −dx
                                            reverse    NaN·0 + (−1)·1 = NaN

Here the tangent of each operation is a sum of products a·dx whose transpose is zero where the
cotangent is, for any a.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.extend.core as jexc
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from jaxfil.xla.program import evaluate_one, interpreted
from jaxfil.xla.select import select

# Elementwise operations whose value or derivative may be infinite or NaN for finite arguments, and
# others, which pass this on to their derivatives.
_SINGULAR = """
acos acosh asin atan2 atanh cbrt cosh digamma div erf_inv exp exp2 expm1 integer_pow lgamma log
log1p log2 pow rem rsqrt sinh sqrt tan
"""
_REGULAR = """
abs asinh atan clamp cos erf erfc logistic max min mul one_minus_square sin square tanh
"""
SINGULAR = frozenset(_SINGULAR.split())
ELEMENTWISE = SINGULAR.union(_REGULAR.split())


# The NaN is described in issue 1052 of jax-ml/jax. Its usual remedy, a second `where` around the
# argument of the branch, would have to be in the user's own function.
masked_product_p = jexc.Primitive("masked_product")
"""a b, and 0 where a = 0 or b = 0, for arrays of one shape."""


def _product(a: Any, b: Any) -> Array:
    return select((a == 0) | (b == 0), jnp.zeros_like(b), a * b)


def masked_product(a: Any, b: Any) -> Array:
    """a b, or 0 where one of them is 0, for any value of the other; the same for derivatives and
    their transposes."""
    return masked_product_p.bind(a, b)


def masked_row_product(row: Array, matrix: Array) -> Array:
    """The row times the matrix, shapes (k,) and (k, …). A number of either that is 0 takes no part,
    for any value of the other; the same for derivatives and their transposes.

    In reverse mode a result that is left out, which has a cotangent of zero, then leaves the other
    cotangents alone, although its own derivatives may be infinite or NaN: those of a lane that has
    failed, or of the time of a graze.
    """
    column = row.reshape(-1, *(1,) * (matrix.ndim - 1))
    return jnp.sum(masked_product(matrix, jnp.broadcast_to(column, matrix.shape)), axis=0)


def _jvp(primals: Sequence[Any], tangents: Sequence[Any]) -> tuple:
    (a, b), (da, db) = primals, tangents
    rate = ad.Zero(jax.core.ShapedArray(b.shape, b.dtype))
    if type(db) is not ad.Zero:
        rate = ad.add_tangents(rate, masked_product(a, db))
    if type(da) is not ad.Zero:
        rate = ad.add_tangents(rate, masked_product(b, da))
    return masked_product(a, b), rate


def _transpose(cotangent: Any, a: Any, b: Any) -> list:
    if type(cotangent) is ad.Zero:
        return [None, None]
    # The product with the cotangent is masked too, which is the purpose of this primitive.
    if ad.is_undefined_primal(a):
        return [masked_product(b, cotangent), None]
    return [None, masked_product(a, cotangent)]


def _batch(values: Sequence[Any], axes: Sequence[Any]) -> tuple:
    rows = [v if d is None else jnp.moveaxis(v, d, 0) for v, d in zip(values, axes, strict=True)]
    shape = jnp.broadcast_shapes(*(jnp.shape(v) for v in rows))
    return masked_product(*(jnp.broadcast_to(v, shape) for v in rows)), 0


masked_product_p.def_impl(_product)
masked_product_p.def_abstract_eval(lambda a, b: jax.core.ShapedArray(b.shape, b.dtype))
ad.primitive_jvps[masked_product_p] = _jvp
ad.primitive_transposes[masked_product_p] = _transpose
batching.primitive_batchers[masked_product_p] = _batch
mlir.register_lowering(masked_product_p, mlir.lower_fun(_product, multiple_results=False))


def masked(function: Callable) -> Callable:
    """`function`, which acts elementwise on numbers or arrays of one shape, with derivatives of
    every order made of masked products."""

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
                rate = rate + masked_product(_slope(function, args, k), move)
        return out, rate

    def broadcast(*args: Any) -> Array:
        shape = jnp.broadcast_shapes(*map(jnp.shape, args))
        return call(*(v if jnp.shape(v) == shape else jnp.broadcast_to(v, shape) for v in args))

    return broadcast


def _slope(function: Callable, args: tuple, k: int) -> Any:
    """The derivative by argument number k, elementwise."""

    def slope(*args: Any) -> Array:
        def by_one(v: Any) -> Array:
            return function(*args[:k], v, *args[k + 1 :])

        # The function is elementwise, so that its derivative along ones is its derivative at each
        # number.
        return jax.jvp(by_one, (args[k],), (jnp.ones_like(args[k]),))[1]

    return interpreted(jax.make_jaxpr(slope)(*args), args, lambda v: v, _masked)[0]


def _masked(jaxpr: Any, eqn: Any, inputs: Sequence[Any]) -> list:
    """The results of one equation, with derivatives made of masked products too."""
    run = ft.partial(evaluate_one, jaxpr, eqn)
    # The `custom_jvp_call`s in the derivative of an elementwise function are elementwise too, such
    # as a cosine.
    single = eqn.primitive.name in (*ELEMENTWISE, "custom_jvp_call")
    return [masked(lambda *v: run(v)[0])(*inputs)] if single else run(inputs)
