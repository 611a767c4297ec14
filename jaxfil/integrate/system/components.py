"""Components: the numbers of a state, or one number for each surface, as the loop carries them.

A vector is stored number by number, each as a scalar (in a batch, one contiguous array of lanes,
which XLA turns into vector instructions), or as one array of all numbers, whose program does not
grow with their count. `lowered` chooses between the two. Formulas are the same for both, since the
operators and the functions here act elementwise, and a scalar operand is broadcast.
"""

import functools as ft
import operator
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.xla.select import select

Forcing = list[Array]
"""The values of a field's expensive operations on time alone, at one time (see
`ComponentSystem.forcing`)."""


@jax.tree_util.register_pytree_node_class
class Components:
    """A vector of numbers with elementwise operators."""

    __slots__ = ("parts",)
    # `==` compares elementwise, so a vector cannot be a key.
    __hash__ = None  # pyright: ignore[reportAssignmentType]
    __array_ufunc__ = None  # NumPy scalars then defer to the operators of this class

    parts: tuple[Array, ...]
    """The numbers as scalars, or one array of all of them."""

    def __init__(self, parts: Iterable[Any]):
        self.parts = tuple(parts)

    def tree_flatten(self) -> tuple[tuple, None]:
        return self.parts, None

    @classmethod
    def tree_unflatten(cls, _: None, parts: Iterable[Any]) -> "Components":
        return cls(parts)

    def __repr__(self) -> str:
        return f"Components({self.parts!r})"

    @property
    def is_array(self) -> bool:
        """Whether all numbers are one array."""
        # Under `vmap` the axis of lanes is hidden, so that a scalar has no axis in a batch either.
        return len(self.parts) == 1 and self.parts[0].ndim > 0

    @property
    def size(self) -> int:
        """The number of components."""
        return self.parts[0].shape[0] if self.is_array else len(self.parts)

    def number(self, i: int) -> Array:
        """Number i."""
        return self.parts[0][i] if self.is_array else self.parts[i]

    def like(self, value: Array) -> "Components":
        """A vector of the same size with every number equal to this scalar."""
        return on_each(lambda v: value if v.ndim == 0 else jnp.full(v.shape, value), self)

    def astype(self, dtype: Any) -> "Components":
        """The same numbers, converted to another type."""
        return on_each(lambda v: v.astype(dtype), self)

    def __add__(self, other: Any) -> "Components":
        return on_each(operator.add, self, other)

    def __radd__(self, other: Any) -> "Components":
        return on_each(operator.add, other, self)

    def __sub__(self, other: Any) -> "Components":
        return on_each(operator.sub, self, other)

    def __rsub__(self, other: Any) -> "Components":
        return on_each(operator.sub, other, self)

    def __mul__(self, other: Any) -> "Components":
        return on_each(operator.mul, self, other)

    def __rmul__(self, other: Any) -> "Components":
        return on_each(operator.mul, other, self)

    def __truediv__(self, other: Any) -> "Components":
        return on_each(operator.truediv, self, other)

    def __rtruediv__(self, other: Any) -> "Components":
        return on_each(operator.truediv, other, self)

    def __and__(self, other: Any) -> "Components":
        return on_each(operator.and_, self, other)

    def __rand__(self, other: Any) -> "Components":
        return on_each(operator.and_, other, self)

    def __or__(self, other: Any) -> "Components":
        return on_each(operator.or_, self, other)

    def __ror__(self, other: Any) -> "Components":
        return on_each(operator.or_, other, self)

    def __lt__(self, other: Any) -> "Components":
        return on_each(operator.lt, self, other)

    def __le__(self, other: Any) -> "Components":
        return on_each(operator.le, self, other)

    def __gt__(self, other: Any) -> "Components":
        return on_each(operator.gt, self, other)

    def __ge__(self, other: Any) -> "Components":
        return on_each(operator.ge, self, other)

    def __eq__(self, other: Any) -> "Components":  # pyright: ignore[reportIncompatibleMethodOverride]
        return on_each(operator.eq, self, other)

    def __ne__(self, other: Any) -> "Components":  # pyright: ignore[reportIncompatibleMethodOverride]
        return on_each(operator.ne, self, other)

    def __neg__(self) -> "Components":
        return on_each(operator.neg, self)

    def __abs__(self) -> "Components":
        return on_each(abs, self)

    def __invert__(self) -> "Components":
        return on_each(operator.invert, self)


def on_each(function: Callable[..., Any], *values: Any) -> Components:
    """`function` applied elementwise to vectors and scalars; to whole arrays if the vectors are
    arrays."""
    assert any(isinstance(v, Components) for v in values), "at least one vector"
    # Vectors of different lengths fail here.
    (length,) = {len(v.parts) for v in values if isinstance(v, Components)}
    columns = [v.parts if isinstance(v, Components) else (v,) * length for v in values]
    return Components(tuple(map(function, *columns)))


def where(condition: Any, yes: Any, no: Any) -> Components:
    """`yes` where the condition holds, else `no`, elementwise."""
    return on_each(select, condition, yes, no)


def maximum(a: Any, b: Any) -> Components:
    """The elementwise maximum."""
    return on_each(jnp.maximum, a, b)


def minimum(a: Any, b: Any) -> Components:
    """The elementwise minimum."""
    return on_each(jnp.minimum, a, b)


def sign(v: Components) -> Components:
    """The sign of each number, ±1 or 0."""
    return on_each(jnp.sign, v)


def side_of(v: Components) -> Components:
    """−1 where a number is negative, else +1."""
    # A zero counts as side +, since the sign 0 would stand for a slide.
    return on_each(lambda u: select(u < 0, -jnp.ones_like(u), jnp.ones_like(u)), v)


def scalars(x: Any) -> tuple[Any, ...]:
    """The numbers of an (n,) array."""
    return tuple(x[i] for i in range(x.shape[0]))


def pack(components: Components, dtype: Any) -> Array:
    """Components as an (n,) array; an empty array of the given dtype if n = 0."""
    if not components.parts:
        return jnp.zeros((0,), dtype)
    return components.parts[0] if components.is_array else jnp.stack(components.parts)


def _sum(v: Array) -> Array:
    return v if v.ndim == 0 else jnp.sum(v)


def with_last_zeroed(v: Components, k: int, flag: Array) -> Components:
    """The same numbers, with zeros in place of the last k ≥ 1 of them where the flag is set."""
    if v.is_array:
        # A mask, since JAX writes an assignment to a slice as a scatter, which no kernel contains.
        last = np.arange(v.size) >= v.size - k
        return Components([select(flag & last, jnp.zeros_like(v.parts[0]), v.parts[0])])
    return Components((*v.parts[:-k], *(select(flag, 0.0, u) for u in v.parts[-k:])))


def total(v: Components) -> Any:
    """The sum of all numbers; there must be at least one."""
    first, *others = map(_sum, v.parts)
    return sum(others, start=first)


def dot(a: Components, b: Components) -> Any:
    """Σ a·b."""
    return total(a * b)


def least(v: Components) -> Array:
    """The smallest number; there must be at least one."""
    return ft.reduce(jnp.minimum, (p if p.ndim == 0 else jnp.min(p) for p in v.parts))


def largest(v: Components) -> Array:
    """The largest number; there must be at least one."""
    return ft.reduce(jnp.maximum, (p if p.ndim == 0 else jnp.max(p) for p in v.parts))


def first_set(flags: Components) -> Components:
    """The flags, with all but the first set one cleared."""
    if flags.is_array:
        (flag,) = flags.parts
        number = jnp.arange(len(flag), dtype=jnp.int32)
        # The first of equal maxima, or 0 without a set flag, which the flag itself then excludes.
        return Components([flag & (number == jax.lax.argmax(flag, 0, jnp.int32))])
    found, first = jnp.zeros((), bool), []
    for flag in flags.parts:
        first.append(flag & ~found)
        found = found | flag
    return Components(first)


def index_of(flags: Components) -> Array:
    """The index of the first set flag; 0 if all are unset."""
    if flags.is_array:
        return jax.lax.argmax(flags.parts[0], 0, jnp.int32)
    place = jnp.zeros((), jnp.int32)
    # From the last to the first, so that the lowest index overwrites the others.
    for i, flag in reversed(list(enumerate(flags.parts))):
        place = select(flag, jnp.int32(i), place)
    return place


def any_of(flags: Components) -> Array:
    """Whether any flag is set; False for zero flags."""
    found = jnp.zeros((), bool)
    for flag in flags.parts:
        found = found | (flag if flag.ndim == 0 else jnp.any(flag))
    return found


def all_finite(*values: Any) -> Array:
    """Whether all numbers of all vectors and arrays are finite."""
    result: Any = 0.0
    for number in stop_gradient(jax.tree.leaves(values)):
        result = result + _sum(number * 0)  # NaN and inf both give NaN, so one test is enough
    return jnp.asarray(result == 0)
