"""Sine and cosine that vectorise, and the rewrite that puts them into a user's function.

A function of arrays enters; the same function leaves with every `sin` and `cos` on float64 replaced
by a polynomial after range reduction. XLA's own float64 sine and cosine are one scalar library call
a lane on CPU and cost several times as much as all the rest of a typical oscillator's field.

Accuracy: within 1.5 ulp of the exact value for |x| < 1e5; beyond that the error stays below
eps*|x|, which is what rounding of the argument itself does.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core as jexc
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

# pi/2 in three parts of 33, 33 and 53 bits: n * _PIO2[0] and n * _PIO2[1] are exact for |n| < 2^20
# (Cody and Waite 1980; the split and the minimax coefficients below are those of fdlibm).
_PIO2 = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_SIN = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COS = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)


def _horner(coefficients: Sequence[float], z: Array) -> Array:
    value = jnp.full_like(z, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        value = c + z * value
    return value


def _quadrant(x: Array, quarter_turns: int) -> Array:
    """sin(x + quarter_turns * pi/2)."""
    n = jnp.round(x * (2 / np.pi))
    r = ((x - n * _PIO2[0]) - n * _PIO2[1]) - n * _PIO2[2]
    z = r * r
    sine = r + r * z * _horner(_SIN, z)
    cosine = 1 - 0.5 * z + z * z * _horner(_COS, z)
    turn = n + quarter_turns
    half = 0.5 * turn
    odd = half != jnp.floor(half)
    quarter = 0.25 * turn
    negative = quarter - jnp.floor(quarter) >= 0.5
    value = jnp.where(odd, cosine, sine)
    return jnp.where(negative, -value, value)


@jax.custom_jvp
def sin(x: Array) -> Array:
    """Sine of a float64 array, of any shape."""
    return _quadrant(x, 0)


@jax.custom_jvp
def cos(x: Array) -> Array:
    """Cosine of a float64 array, of any shape."""
    return _quadrant(x, 1)


sin.defjvps(lambda dx, _, x: dx * cos(x))
cos.defjvps(lambda dx, _, x: -(dx * sin(x)))

_FAST = {"sin": sin, "cos": cos}


def _evaluate_one(jaxpr: Any, eqn: Any, inputs: Sequence[Any]) -> list[Any]:
    """One equation as it stands."""
    pairs = zip(eqn.invars, inputs, strict=True)
    free = [(v, x) for v, x in pairs if not isinstance(v, jexc.Literal)]
    single = jaxpr.replace(
        constvars=(), invars=[v for v, _ in free], outvars=eqn.outvars, eqns=[eqn]
    )
    return jax.core.eval_jaxpr(single, (), *(x for _, x in free))


def _evaluate(jaxpr: Any, consts: Sequence[Any], args: Sequence[Any]) -> list[Any]:
    """Evaluate a jaxpr equation by equation, with the fast functions in place of XLA's."""
    values: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))

    def read(atom):
        return atom.val if isinstance(atom, jexc.Literal) else values[atom]

    for eqn in jaxpr.eqns:
        inputs = [read(v) for v in eqn.invars]
        name = eqn.primitive.name
        if name in _FAST and eqn.invars[0].aval.dtype == jnp.float64:
            outputs = [_FAST[name](jnp.asarray(inputs[0]))]
        elif name in ("jit", "pjit", "closed_call"):
            inner = eqn.params["jaxpr"]
            outputs = _evaluate(inner.jaxpr, inner.consts, inputs)
        else:
            outputs = _evaluate_one(jaxpr, eqn, inputs)
        values.update(zip(eqn.outvars, outputs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def rewrite(function: Callable, *example: Any) -> Callable:
    """`function` with fast sines and cosines, for arguments shaped like `example`.

    The function is traced once; arguments and results are pytrees of arrays, and calls may be
    transformed (`vmap`, `jvp`, …) as those of the original may.
    """
    closed, out_shape = jax.make_jaxpr(function, return_shape=True)(*example)
    out_tree = jax.tree.structure(out_shape)

    def fast(*args):
        leaves = jax.tree.leaves(args)
        return jax.tree.unflatten(out_tree, _evaluate(closed.jaxpr, closed.consts, leaves))

    return fast
