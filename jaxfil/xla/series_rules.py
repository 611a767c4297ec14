"""Power series of all operations: functions, selections, rearrangements and sums.

A selection is decided just after the start of a step, and fixed within it (see `series_jumps`). If
it would change within the step, the error estimate shows it.
"""

import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxfil.xla.program import programs
from jaxfil.xla.series import (
    Expansion,
    Series,
    add,
    degree_of,
    first_of,
    kept,
    linear_function,
    square,
    sum_of,
)
from jaxfil.xla.series_functions import FUNCTIONS
from jaxfil.xla.series_jumps import compared, decided_by, just_after, list_places


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
        return jax.lax.select_n(which[0], *(jnp.broadcast_to(v, shape) for v in filled))

    return expansion.series(make, degree_of(*cases))


def _of_comparison(compare: Callable) -> Callable:
    return lambda expansion, eqn, a, b: compared(expansion, compare, a, b)


def _select_n(expansion: Expansion, eqn: Any, which: Series, *cases: Series) -> Series:
    return selected(expansion, which, cases)


def _larger(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    return selected(expansion, compared(expansion, jnp.less, a, b), (a, b))


def _smaller(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    return selected(expansion, compared(expansion, jnp.greater, a, b), (a, b))


def _absolute(expansion: Expansion, eqn: Any, a: Series) -> Series:
    if jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.complexfloating):
        parts = [linear_function(expansion, part, a) for part in (jnp.real, jnp.imag)]
        size = sum_of(expansion, [square(expansion, v) for v in parts])
        return FUNCTIONS["sqrt"](expansion, eqn, size)
    negative = linear_function(expansion, lambda v: -v, a)
    return _larger(expansion, eqn, a, negative)


def _clamp(expansion: Expansion, eqn: Any, low: Series, a: Series, high: Series) -> Series:
    return _smaller(expansion, eqn, _larger(expansion, eqn, a, low), high)


def _remainder(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    if b.degree != 0:
        raise NoSeries("rem")
    # Between two jumps the remainder is a minus a constant, a whole multiple of b, so that only
    # coefficient 0 differs. If b varies, the multiple does not remain constant in time.
    ahead = decided_by(expansion, a)

    def make(k: int) -> Any:
        if k > 0:
            return a[k]
        after = just_after(ahead, a)
        return jax.lax.rem(after, b[0]) - (after - first_of(a))

    out = expansion.series(make, a.degree)
    list_places(expansion, eqn, (a, b), out)
    return out


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


def _put_together(expansion: Expansion, eqn: Any, *parts: Series) -> Series:
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
    "concatenate": _put_together,
    "dot_general": _dot,
    "eq": _of_comparison(jnp.equal),
    "ge": _of_comparison(jnp.greater_equal),
    "gt": _of_comparison(jnp.greater),
    "le": _of_comparison(jnp.less_equal),
    "le_to": _of_comparison(jnp.less_equal),
    "lt": _of_comparison(jnp.less),
    "lt_to": _of_comparison(jnp.less),
    "max": _larger,
    "min": _smaller,
    "ne": _of_comparison(jnp.not_equal),
    "pad": _put_together,
    "rem": _remainder,
    "select_n": _select_n,
    "stack": _put_together,
}
"""The rules of operations, by their names."""
COMPARISONS = frozenset(["eq", "ge", "gt", "le", "le_to", "lt", "lt_to", "ne"])
# Real numbers that are selected by a comparison of the operands, or jump.
_CHOSEN = frozenset(["abs", "clamp", "max", "min", "rem"])
# Operations that are linear in the first operand, given the others.
LINEAR = frozenset(
    [
        "broadcast_in_dim",
        "convert_element_type",
        "copy",
        "cumsum",
        "dynamic_slice",
        "gather",
        "imag",
        "neg",
        "real",
        "reduce_sum",
        "reshape",
        "rev",
        "slice",
        "squeeze",
        "stop_gradient",
        "tile",
        "transpose",
    ]
)
# Operations on real numbers that are constant within a step, away from their jumps.
FROZEN = frozenset(["ceil", "floor", "round", "sign"])


def jumps(eqn: Any) -> bool:
    """Whether the result of an operation may jump, or have a kink, as its operands move."""
    name = eqn.primitive.name
    own = name in FROZEN or name in _CHOSEN or not all(is_real(v.aval) for v in eqn.outvars)
    return own or any(map(jumps, itertools.chain(*(v.eqns for v in programs(eqn.params)))))


def is_real(aval: Any) -> bool:
    """Whether a value changes within a step, unlike integers and flags."""
    return jnp.issubdtype(aval.dtype, jnp.inexact)
