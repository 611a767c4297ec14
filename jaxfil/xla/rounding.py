"""Bounds of the rounding inside a function, computed from its operations.

The program of a function is evaluated with a bound beside each value. An operation propagates the
bounds of its operands by its derivatives, and adds the rounding of its own result, eps times its
size. Arguments are taken as exact, since the effect of their rounding is given by the derivatives
of the function. The last operation of a result is not counted, so that x − a, for two arguments, is
exact; near zero, where the bound matters, the subtraction is indeed exact.

The first-order analysis of Wilkinson, Rounding Errors in Algebraic Processes (1963).
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.xla import elements
from jaxfil.xla.program import closed, evaluate_one, interpreted

# Operations that only move numbers, possibly selected by integers or flags.
_CHOICES = ("select_n", "gather", "dynamic_slice", "copy", "stop_gradient")
# Sums of many terms.
_SUMS = ("reduce_sum", "cumsum", "dot_general")
# Operations whose terms are products of several numbers.
_PRODUCTS = ("dot_general", "reduce_prod", "cumprod")
# Operations whose results are exact.
_NAMES = """
abs argmax argmin ceil clamp convert_element_type eq floor ge gt is_finite le lt max min ne neg
reduce_max reduce_min round sign
"""
_EXACT = frozenset(_NAMES.split())


class _Rounded(NamedTuple):
    """A value with bounds of its rounding error, in eps; None for zero."""

    value: Any
    passed_on: Array | None = None
    """The bound inherited from the operands."""
    own: Array | None = None
    """The bound of its own operation."""

    @property
    def bound(self) -> Array | None:
        """The sum of both bounds."""
        return _sum([v for v in (self.passed_on, self.own) if v is not None])


def rounding_of(function: Callable, *example: Any) -> Callable | None:
    """A function of the same arguments that returns, for each float result of `function`, a bound
    of the rounding inside `function`, in eps; None if only the last operation of each result is
    rounded.

    >>> bound = rounding_of(lambda x, shift: (x + shift) - shift, 1.0, 1e6)
    >>> float(bound(1.0, 1e6)), rounding_of(lambda x, shift: x - shift, 1.0, 1e6)
    (1000001.0, None)
    """
    program, shape = jax.make_jaxpr(function, return_shape=True)(*example)
    tree = jax.tree.structure(shape)

    def run(leaves: Sequence[Any]) -> list[_Rounded]:
        return interpreted(program, [_Rounded(v) for v in leaves], _Rounded, _rounded)

    def bounds(*args: Any) -> Any:
        values = [_or_zero(v.passed_on, v.value) for v in run(jax.tree.leaves(args))]
        return jax.tree.unflatten(tree, values)

    leaves = jax.tree.leaves(example)
    # Whether a bound is zero depends on the operations alone, so no value is needed.
    found = jax.eval_shape(lambda *leaves: [v.passed_on for v in run(leaves)], *leaves)
    return None if all(v is None for v in found) else bounds


def _rounded(jaxpr: Any, eqn: Any, inputs: Sequence[_Rounded]) -> list[_Rounded]:
    """The results of one operation with their bounds."""
    name = eqn.primitive.name
    if name in _WITH_PROGRAMS:
        return _WITH_PROGRAMS[name](eqn, inputs)
    run = ft.partial(evaluate_one, jaxpr, eqn)
    outputs = run([v.value for v in inputs])
    if not any(map(_is_float, outputs)):
        return [_Rounded(v) for v in outputs]
    if name in elements.MOVES or name in _CHOICES:
        return [_moved(eqn, inputs, outputs[0])]
    if name == "custom_linear_solve":
        inputs = _without_factors(eqn, inputs)
    passed_on = _passed_on(name, run, inputs, len(outputs))
    if name in _EXACT:
        return [_Rounded(v, p) for v, p in zip(outputs, passed_on, strict=True)]
    if name not in _SUMS:
        own = [abs(v) if _is_float(v) else None for v in outputs]
        return [_Rounded(*each) for each in zip(outputs, passed_on, own, strict=True)]
    # Terms of a sum may cancel, so its rounding is proportional to their sizes, even at zero.
    (size,) = run([abs(jnp.asarray(v.value)) for v in inputs])
    if passed_on[0] is None:
        return [_Rounded(outputs[0], None, size)]
    return [_Rounded(outputs[0], passed_on[0] + size)]


def _without_factors(eqn: Any, inputs: Sequence[_Rounded]) -> list[_Rounded]:
    """The operands of a linear solve, of which factors of the matrix are exact. The derivative is
    that by the matrix and the right-hand side."""
    lengths = eqn.params["const_lengths"]
    factors = range(lengths.matvec, sum(lengths))
    return [_Rounded(v.value) if i in factors else v for i, v in enumerate(inputs)]


def _called(program: Any, inputs: Sequence[_Rounded]) -> list[_Rounded]:
    """The results of a program."""
    return interpreted(closed(program), inputs, _Rounded, _rounded)


def _branched(eqn: Any, inputs: Sequence[_Rounded]) -> list[_Rounded]:
    """The results of the selected branch of a conditional."""
    which, *args = inputs
    cases = [_called(branch, args) for branch in eqn.params["branches"]]

    def selected(parts: Sequence[Any], values: Sequence[Any]) -> Array | None:
        if all(v is None for v in parts):
            return None
        pairs = zip(parts, values, strict=True)
        # A branch may return a number of the program, which is no array.
        filled = [jnp.asarray(_or_zero(v, of)) for v, of in pairs]
        return jax.lax.select_n(jnp.clip(which.value, 0, len(cases) - 1), *filled)

    return [
        _Rounded(*(selected(part, values) for part in (values, *bounds)))
        for values, *bounds in (zip(*each, strict=True) for each in zip(*cases, strict=True))
    ]


def _repeated(eqn: Any, inputs: Sequence[_Rounded]) -> list[_Rounded]:
    """The results of a `while` loop, whose state carries its bounds."""
    split = eqn.params["cond_nconsts"], eqn.params["body_nconsts"]
    test_known, known = inputs[: split[0]], inputs[split[0] : sum(split)]

    def test(state: Sequence[_Whole]) -> Array:
        (again,) = _called(eqn.params["cond_jaxpr"], [*test_known, *map(_rounded_of, state)])
        return again.value

    def body(state: Sequence[_Whole]) -> list[_Whole]:
        return _wholes(_called(eqn.params["body_jaxpr"], [*known, *map(_rounded_of, state)]))

    return [*map(_rounded_of, jax.lax.while_loop(test, body, _wholes(inputs[sum(split) :])))]


def _scanned(eqn: Any, inputs: Sequence[_Rounded]) -> list[_Rounded]:
    """The results of a scan, whose state and rows carry their bounds."""
    split = eqn.params["num_consts"], eqn.params["num_carry"]
    known, state = inputs[: split[0]], inputs[split[0] : sum(split)]

    def body(state: Sequence[_Whole], rows: Sequence[_Whole]) -> tuple[list, list]:
        given = [*known, *map(_rounded_of, (*state, *rows))]
        out = _wholes(_called(eqn.params["jaxpr"], given))
        return out[: split[1]], out[split[1] :]

    length, back = eqn.params["length"], eqn.params["reverse"]
    start, rows = _wholes(state), _wholes(inputs[sum(split) :])
    last, made = jax.lax.scan(body, start, rows, length=length, reverse=back)
    return [*map(_rounded_of, (*last, *made))]


# A value in the state of a loop, with a bound even if that is zero; None for an integer.
_Whole = tuple[Array, Array | None]


def _wholes(values: Sequence[_Rounded]) -> list[_Whole]:
    arrays = [jnp.asarray(v.value) for v in values]
    pairs = zip(arrays, values, strict=True)
    return [(v, _or_zero(of.bound, v) if _is_float(v) else None) for v, of in pairs]


def _rounded_of(whole: _Whole) -> _Rounded:
    return _Rounded(*whole)


# Operations that are made of programs, through which bounds are propagated.
_WITH_PROGRAMS: dict[str, Callable] = {
    "checkpoint": lambda eqn, inputs: _called(eqn.params["jaxpr"], inputs),
    "cond": _branched,
    "custom_jvp_call": lambda eqn, inputs: _called(eqn.params["call_jaxpr"], inputs),
    "remat2": lambda eqn, inputs: _called(eqn.params["jaxpr"], inputs),
    "scan": _scanned,
    "while": _repeated,
}


def _is_float(v: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(v), jnp.floating)


def _sum(terms: Sequence[Array]) -> Array | None:
    return ft.reduce(jnp.add, terms) if terms else None


def _moved(eqn: Any, inputs: Sequence[_Rounded], value: Array) -> _Rounded:
    """The result of an operation that moves numbers, with its bounds moved in the same way."""

    def along(parts: Sequence[Array | None]) -> Array | None:
        if all(v is None for v in parts):
            return None
        filled = []
        for part, of in zip(parts, inputs, strict=True):
            moved = _or_zero(part, of.value) if _is_float(of.value) else of.value
            filled.append(jnp.asarray(moved, eqn.invars[len(filled)].aval.dtype))
        return eqn.primitive.bind(*filled, **eqn.params)

    return _Rounded(value, along([v.passed_on for v in inputs]), along([v.own for v in inputs]))


def _or_zero(bound: Array | None, value: Any) -> Array:
    return jnp.zeros_like(value) if bound is None else bound


def _passed_on(
    name: str, run: Callable, inputs: Sequence[_Rounded], count: int
) -> list[Array | None]:
    """Σ |∂f/∂v| e over the operands v with bounds e."""
    values, terms = [v.value for v in inputs], []
    if name in _PRODUCTS:
        # The terms of a result are products, whose derivatives may differ in sign.
        values = [abs(jnp.asarray(v)) for v in values]
    for i, of in enumerate(inputs):
        if of.bound is None:
            continue

        # One operand at a time, so that the effects of two operands do not cancel.
        def one(v: Array, i: int = i) -> list[Any]:
            return run([*values[:i], v, *values[i + 1 :]])

        terms.append(jax.jvp(one, (jnp.asarray(values[i]),), (of.bound,))[1])
    if not terms:
        return [None] * count
    columns = zip(*terms, strict=True)
    return [_sum([abs(v) for v in each if _is_float(v)]) for each in columns]
