"""Power series of all operations: functions, selections, rearrangements and sums.

A selection is decided at the start of a step, and fixed within it. If it would change within the
step, the error estimate shows it.
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


class NoSeries(ValueError):
    """The error for an operation, by its name in JAX, without a power series."""

    def __init__(self, name: str):
        super().__init__(
            "`stepper` must not be jaxfil.Taylor() for a system with an operation that has no "
            f"power series, got one with `{name}`. diffrax.Dopri8() takes any."
        )


def selected(expansion: Expansion, which: Callable, cases: Sequence[Series]) -> Series:
    """One of several values, selected by the integer or flag that `which` returns."""

    def make(k: int) -> Any:
        parts = [v[k] for v in cases]
        if all(v is None for v in parts):
            return None
        like = next(v for v in parts if v is not None)
        filled = [jnp.zeros_like(like) if v is None else jnp.asarray(v) for v in parts]
        shape = jnp.broadcast_shapes(*(v.shape for v in filled))
        return jax.lax.select_n(which(), *(jnp.broadcast_to(v, shape) for v in filled))

    return expansion.series(make, degree_of(*cases))


def _select_n(expansion: Expansion, eqn: Any, which: Series, *cases: Series) -> Series:
    return selected(expansion, lambda: which[0], cases)


def _larger(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    return selected(expansion, lambda: first_of(a) < first_of(b), (a, b))


def _smaller(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    return selected(expansion, lambda: first_of(a) > first_of(b), (a, b))


def _absolute(expansion: Expansion, eqn: Any, a: Series) -> Series:
    negative = expansion.series(lambda _: first_of(a) < 0, 0)
    return linear_function(expansion, lambda v: select(negative[0], -v, v), a)


def _clamp(expansion: Expansion, eqn: Any, low: Series, a: Series, high: Series) -> Series:
    return _smaller(expansion, eqn, _larger(expansion, eqn, a, low), high)


def _remainder(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    if b.degree != 0:
        raise NoSeries("rem")
    return expansion.series(lambda k: jax.lax.rem(a[0], b[0]) if k == 0 else a[k], a.degree)


def _dot(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
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
        return bind(*(jnp.zeros(s.shape, s.dtype) if v is None else v for v, s in pairs))

    return expansion.series(make, degree_of(*parts))


RULES: dict[str, Callable] = FUNCTIONS | {
    "abs": _absolute,
    "clamp": _clamp,
    "concatenate": _concatenate,
    "dot_general": _dot,
    "max": _larger,
    "min": _smaller,
    "rem": _remainder,
    "select_n": _select_n,
}
"""The rules of operations, by their names."""
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
# Operations that are constant within a step, away from their jumps.
FROZEN = frozenset(
    [
        "and",
        "argmax",
        "argmin",
        "ceil",
        "eq",
        "floor",
        "ge",
        "gt",
        "is_finite",
        "le",
        "lt",
        "ne",
        "not",
        "or",
        "round",
        "sign",
        "xor",
    ]
)
