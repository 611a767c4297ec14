"""Power series of all operations: functions, selections, rearrangements and sums.

A selection is decided at the start of a step, or if that is a kink, just after it, and fixed within
it. If it would change within the step, the error estimate shows it.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxfil.xla.select import select
from jaxfil.xla.series import (
    Expansion,
    Series,
    add,
    degree_of,
    first_of,
    kept,
    linear_function,
)
from jaxfil.xla.series_functions import FUNCTIONS

# Order up to which coefficients of equal values are compared, 2 for a start at rest on a kink.
_TIES = 2


class NoSeries(ValueError):
    """The error for an operation, by its name in JAX, without a power series."""

    def __init__(self, name: str):
        super().__init__(
            "`stepper` must not be jaxfil.Taylor() for a system with an operation that has no "
            f"power series, got one with `{name}`. diffrax.Dopri8() takes any."
        )


def selected(expansion: Expansion, which: Series, cases: Sequence[Series]) -> Series:
    """One of several values, selected by an integer or a flag."""

    def make(k: int) -> Any:
        parts = [v[k] for v in cases]
        if all(v is None for v in parts):
            return None
        # `select_n` needs cases of one shape and type, and a structural zero has neither.
        like = next(v for v in parts if v is not None)
        filled = [jnp.zeros_like(like) if v is None else jnp.asarray(v) for v in parts]
        shape = jnp.broadcast_shapes(*(v.shape for v in filled))
        flag = which[0] if which.later is None else which.later[min(k, _TIES)]
        return jax.lax.select_n(flag, *(jnp.broadcast_to(v, shape) for v in filled))

    return expansion.series(make, degree_of(*cases))


def compared(expansion: Expansion, compare: Callable, a: Series, b: Series) -> Series:
    """The flag of a comparison at the start of a step. If both values are equal there, its `later`
    flags compare the first coefficients that differ, as the values do just after the start. A
    motion that starts on a kink of its field thus takes the part of the field ahead of it."""
    out = expansion.series(lambda _: compare(first_of(a), first_of(b)), 0)
    if a.degree == b.degree == 0:
        return out
    later: Series

    def coefficient(v: Series, k: int) -> Any:
        return jnp.zeros_like(first_of(v)) if v[k] is None else v[k]

    # Coefficient k of a selection needs coefficients up to k of the values, which are known by
    # then. If these are all equal, so are the results of both cases up to that order.
    def make(k: int) -> Any:
        if k == 0:
            return out[0]
        ties = [coefficient(a, i) == coefficient(b, i) for i in range(k)]
        now = compare(coefficient(a, k), coefficient(b, k))
        return select(ft.reduce(jnp.logical_and, ties), now, later[k - 1])

    later = out.later = expansion.series(make, _TIES)
    return out


def _of_comparison(compare: Callable) -> Callable:
    return lambda expansion, eqn, a, b: compared(expansion, compare, a, b)


def _select_n(expansion: Expansion, eqn: Any, which: Series, *cases: Series) -> Series:
    return selected(expansion, which, cases)


def _larger(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    return selected(expansion, compared(expansion, jnp.less, a, b), (a, b))


def _smaller(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    return selected(expansion, compared(expansion, jnp.greater, a, b), (a, b))


def _absolute(expansion: Expansion, eqn: Any, a: Series) -> Series:
    negative = linear_function(expansion, lambda v: -v, a)
    return _larger(expansion, eqn, a, negative)


def _clamp(expansion: Expansion, eqn: Any, low: Series, a: Series, high: Series) -> Series:
    return _smaller(expansion, eqn, _larger(expansion, eqn, a, low), high)


def _remainder(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    if b.degree != 0:
        raise NoSeries("rem")
    # Between two jumps the remainder is a minus a constant, a whole multiple of b, so that only
    # coefficient 0 differs. If b varies, the multiple does not remain constant in time.
    return expansion.series(lambda k: jax.lax.rem(a[0], b[0]) if k == 0 else a[k], a.degree)


def _dot(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    # Large products and those with batch axes. Small ones are taken apart in `series_program`.
    bind = ft.partial(eqn.primitive.bind, **eqn.params)
    if a.degree == 0:
        return linear_function(expansion, lambda v: bind(a[0], v), b)
    if b.degree == 0:
        return linear_function(expansion, lambda v: bind(v, b[0]), a)
    kept(a, b)

    def make(k: int) -> Any:
        pairs = [(a[i], b[k - i]) for i in range(k + 1)]
        return add([bind(u, v) for u, v in pairs if u is not None and v is not None])

    return expansion.series(make)


def _concatenate(expansion: Expansion, eqn: Any, *parts: Series) -> Series:
    bind = ft.partial(eqn.primitive.bind, **eqn.params)
    shapes = [v.aval for v in eqn.invars]

    def make(k: int) -> Any:
        own = [v[k] for v in parts]
        if all(v is None for v in own):
            return None
        pairs = zip(own, shapes, strict=True)
        # A structural zero has no array, so its shape is taken from the program.
        return bind(*(jnp.zeros(s.shape, s.dtype) if v is None else v for v, s in pairs))

    return expansion.series(make, degree_of(*parts))


RULES: dict[str, Callable] = FUNCTIONS | {
    "abs": _absolute,
    "clamp": _clamp,
    "concatenate": _concatenate,
    "dot_general": _dot,
    "ge": _of_comparison(jnp.greater_equal),
    "gt": _of_comparison(jnp.greater),
    "le": _of_comparison(jnp.less_equal),
    "lt": _of_comparison(jnp.less),
    "max": _larger,
    "min": _smaller,
    "rem": _remainder,
    "select_n": _select_n,
}
"""The rules of operations, by their names."""
COMPARISONS = frozenset(["ge", "gt", "le", "lt"])
# Operations that are linear in the first operand, given the others.
LINEAR = frozenset(
    [
        "broadcast_in_dim",
        "convert_element_type",
        "copy",
        "cumsum",
        "dynamic_slice",
        "gather",
        "neg",
        "real",
        "reduce_sum",
        "reshape",
        "rev",
        "slice",
        "squeeze",
        "stop_gradient",
        "transpose",
    ]
)
# Operations on real numbers that are constant within a step, away from their jumps.
FROZEN = frozenset(["ceil", "floor", "round", "sign"])
