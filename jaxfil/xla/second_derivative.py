"""Second derivatives at no cost for programs without them.

`add_second_derivative` returns given numbers, with their second derivatives increased by the second
derivatives of a function whose value and first derivatives are zero. The function is traced only
where a second derivative is taken. It adds no operation to the program of a value, and a zero to
the program of a first derivative.

With b a function whose first derivatives vanish, the derivative of v + b along u is

    dv·u + B u,   B = ∂b/∂y = 0:   a linear map of u, whose own derivative is the Hessian of b.

`B u` is a primitive of its own: a zero with a derivative with respect to y, and a transpose. A
`where` or a product with zero would work only for forward over forward mode, since JAX drops the
derivative of a linear map with respect to its coefficients when it transposes the map
(`custom_jvp`).
"""

import dataclasses
import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.extend.core as jexc
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

THIRD = (
    "Third derivatives through contacts are not available. Derivatives with respect to `x0`, times "
    "and parameters are exact to second order; take central differences of those."
)
"""The error message of a third derivative."""


@ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
def add_second_derivative(function: Callable, values: Any, *args: Any) -> Any:
    """`values`, with the second derivatives of `function(*args)`, a pytree of the same shapes,
    added to theirs. The value and first derivatives of the function must be zero, and it must close
    over nothing.

    >>> import jax
    >>> square = lambda x: add_second_derivative(lambda x: (x - 2) ** 2, x, x)
    >>> [float(d(square)(2.0)) for d in (lambda f: f, jax.grad, lambda f: jax.hessian(f))]
    [2.0, 1.0, 2.0]
    """
    return values


@add_second_derivative.defjvp
def _add_jvp(function: Callable, primals: tuple, tangents: tuple) -> tuple:
    _, *args = primals
    rates, *moves = tangents
    leaves, tree = jax.tree.flatten(args)
    # Integers and flags have no rates, and `jax.jvp` accepts only float0 as their tangents.
    real = tuple(k for k, v in enumerate(leaves) if jnp.issubdtype(jnp.result_type(v), jnp.inexact))
    moving = [jax.tree.leaves(moves)[k] for k in real]
    pushed = _Pushed(function, tree, real, len(leaves))
    out, shape = jax.tree.flatten(rates)
    zeros = _vanishing_map(pushed, leaves, moving, out)
    moved = jax.tree.unflatten(shape, [a + b for a, b in zip(out, zeros, strict=True)])
    # The value has the rule again, for second derivatives of a value that comes with a derivative,
    # as from `jax.value_and_grad`.
    return add_second_derivative(function, *primals), moved


@dataclasses.dataclass(frozen=True)
class _Pushed:
    """(y, u) ↦ ∂b/∂y u, where u has rates of the leaves of y numbered `real`."""

    function: Callable
    tree: Any
    real: tuple[int, ...]
    size: int

    def __call__(self, args: Sequence[Any], moves: Sequence[Any]) -> list[Array]:
        def moved(*some: Array) -> list:
            leaves = list(args)
            for k, v in zip(self.real, some, strict=True):
                leaves[k] = v
            return jax.tree.leaves(self.function(*jax.tree.unflatten(self.tree, leaves)))

        return jax.jvp(moved, [args[k] for k in self.real], list(moves))[1]


@dataclasses.dataclass(frozen=True)
class _Transposed:
    """(y, c) ↦ the transpose of u ↦ B(y) u at c, with u of the shapes `shapes`."""

    linear: Callable
    shapes: tuple

    def __call__(self, args: Sequence[Any], cotangents: Sequence[Any]) -> list[Array]:
        shapes = [jax.ShapeDtypeStruct(*shape) for shape in self.shapes]
        # Shapes are enough, since a linear map does not depend on the value of u.
        back = jax.linear_transpose(lambda *moves: self.linear(args, moves), *shapes)
        return list(back(list(cotangents)))


@dataclasses.dataclass(frozen=True)
class _Batched:
    """(y, u) ↦ B(y) u for a batch of the flagged entries of y and u."""

    linear: Callable
    of_args: tuple[bool, ...]
    of_moves: tuple[bool, ...]

    def __call__(self, args: Sequence[Any], moves: Sequence[Any]) -> list[Array]:
        axes = [[0 if flag else None for flag in flags] for flags in (self.of_args, self.of_moves)]
        return jax.vmap(self.linear, axes)(list(args), list(moves))


_Shapes = tuple[tuple[tuple[int, ...], Any], ...]


def _shapes(values: Sequence[Any]) -> _Shapes:
    return tuple((tuple(v.shape), v.dtype) for v in values)


# A `custom_jvp` in its place would lose its rule in reverse mode. JAX transposes the program of its
# value (`_custom_jvp_call_transpose_fancy` in JAX 0.10.2, pull request 3231 of jax-ml/jax), which
# is zero.
vanishing_map_p = jexc.Primitive("vanishing_map")
"""The operation B u = 0, for `split` arguments y followed by u."""
vanishing_map_p.multiple_results = True


def _vanishing_map(
    linear: Callable, args: Sequence[Any], moves: Sequence[Any], like: Sequence[Any]
) -> list[Array]:
    # The shapes of the results are a parameter, so that `linear` is traced only by the rule for
    # derivatives.
    return vanishing_map_p.bind(*args, *moves, linear=linear, split=len(args), out=_shapes(like))


def _zeros(*_: Any, linear: Callable, split: int, out: _Shapes) -> list[Array]:
    return [jnp.zeros(*shape) for shape in out]


def _avals(*_: Any, linear: Callable, split: int, out: _Shapes) -> list:
    return [jax.core.ShapedArray(*shape) for shape in out]


# Only the second derivatives of the function are the missing ones. Its third derivatives have no
# meaning for the result, and would otherwise be added to it unnoticed.
@jax.custom_jvp
def _last(values: list) -> list:
    """The same values, whose derivative raises an error."""
    return values


@ft.partial(_last.defjvp, symbolic_zeros=True)
def _last_jvp(primals: tuple, tangents: tuple) -> tuple:
    raise NotImplementedError(THIRD)


def _jvp(
    primals: Sequence[Any], tangents: Sequence[Any], linear: Callable, split: int, out: _Shapes
) -> tuple:
    args, moves = primals[:split], primals[split:]
    zeros = _vanishing_map(linear, args, moves, _avals(linear=linear, split=split, out=out))
    # Symbolic zeros, so that tangents of y alone or of u alone cost one term.
    rates = [ad.Zero(jax.core.ShapedArray(*shape)) for shape in out]
    moving = [k for k in range(split) if type(tangents[k]) is not ad.Zero]
    # The Hessian of the function, applied to u and to the tangents of y. This term is not zero.
    if moving:

        def by_args(*some: Array) -> list:
            here = list(args)
            for k, v in zip(moving, some, strict=True):
                here[k] = v
            return linear(here, moves)

        picked = [args[k] for k in moving], [tangents[k] for k in moving]
        rates = _last(jax.jvp(by_args, *picked)[1])
    # B applied to the tangents of u, a zero that can be differentiated in its turn.
    if any(type(v) is not ad.Zero for v in tangents[split:]):
        along = [ad.instantiate_zeros(v) for v in tangents[split:]]
        rates = map(ad.add_tangents, rates, _vanishing_map(linear, args, along, zeros))
    return zeros, list(rates)


def _transpose(
    cotangents: Sequence[Any], *values: Any, linear: Callable, split: int, out: _Shapes
) -> list:
    # The map is transposed for all of u at once. An undefined operand has a shape but no value.
    moves = [v.aval if ad.is_undefined_primal(v) else v for v in values[split:]]
    back = _Transposed(linear, _shapes(moves))
    given = [ad.instantiate_zeros(v) for v in cotangents]
    pulled = _vanishing_map(back, values[:split], given, moves)
    wanted = map(ad.is_undefined_primal, values[split:])
    # B u is linear in u alone, so y has no cotangent.
    return [None] * split + [v if asked else None for v, asked in zip(pulled, wanted, strict=True)]


def _batch(
    values: Sequence[Any], axes: Sequence[Any], linear: Callable, split: int, out: _Shapes
) -> tuple:
    flags = tuple(axis is not None for axis in axes)
    rows = [
        jnp.moveaxis(v, axis, 0) if flag else v
        for v, axis, flag in zip(values, axes, flags, strict=True)
    ]
    (size,) = {v.shape[0] for v in itertools.compress(rows, flags)}
    several = _Batched(linear, flags[:split], flags[split:])
    like = [jax.ShapeDtypeStruct((size, *shape), dtype) for shape, dtype in out]
    zeros = _vanishing_map(several, rows[:split], rows[split:], like)
    return zeros, [0] * len(zeros)


vanishing_map_p.def_impl(_zeros)
vanishing_map_p.def_abstract_eval(_avals)
ad.primitive_jvps[vanishing_map_p] = _jvp
ad.primitive_transposes[vanishing_map_p] = _transpose
batching.primitive_batchers[vanishing_map_p] = _batch
# XLA receives constant zeros, and removes their additions (see
# `test_a_first_derivative_has_nothing_of_it`).
mlir.register_lowering(vanishing_map_p, mlir.lower_fun(_zeros, multiple_results=True))
