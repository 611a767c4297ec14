"""Corners: vectors (fields, or rates dH/dt along them) on combinations of the sides of m surfaces.

How many combinations it takes depends on the surfaces:

- Two, all sides + and all sides −, where surfaces are separate (`Structure.separate`).
- m + 1, all sides + and those with one side −, where the field is affine in the sides:
  F = F_0 − Σ_j (1 − s_j)/2 (F_0 − F_j).
- All 2^m of others, the first surface varying slowest.
"""

import functools as ft
import itertools
import operator
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.system.components import Components, on_each, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select

# Combinations of sides at most that are held one by one; more are rows of arrays, so that a program
# does not grow with their number. One of five or fewer would take longer to compile.
_WRITTEN_OUT = 5


def every_side(m: int) -> np.ndarray:
    """All combinations of the sides of m surfaces, shape (2^m, m), the first surface varying
    slowest, + before −."""
    return np.array(list(itertools.product((1.0, -1.0), repeat=m)))


def corner_sides(system: ComponentSystem) -> np.ndarray:
    """The combinations of sides that determine a field on all of them, shape (k, m)."""
    m = system.m
    if system.structure.separate:
        return np.array([[1.0] * m, [-1.0] * m])
    if system.structure.affine:
        return np.concatenate([np.ones((1, m)), 1 - 2 * np.eye(m)])
    return every_side(m)


def on_corners(
    function: Callable[[Components], Any], system: ComponentSystem, sides: np.ndarray
) -> Any:
    """A vector, or several, on combinations of sides: `Corners` for each."""
    if len(sides) > _WRITTEN_OUT:
        columns = system.of_surfaces(sides.T.astype(system.dtype))
        made = jax.vmap(function)(columns)
        return jax.tree.map(Corners.table, made, is_leaf=_is_vector)
    # Of numbers, not of an array: one that is known would be an argument of the kernel, and its
    # ones would not be multiplied out.
    rows = [jnp.stack([jnp.asarray(float(v), system.dtype) for v in row]) for row in sides]
    made = [function(system.of_surfaces(row)) for row in rows]
    return jax.tree.map(lambda *each: Corners(each), *made, is_leaf=_is_vector)


def _is_vector(v: Any) -> bool:
    return isinstance(v, Components)


def mix(s: Any, w: Any, above: Any, below: Any) -> Components:
    """The vector on side s of one surface, or where s = 0 the blend of both with weight w. A side
    is taken as it is, untouched by a NaN of the other."""
    share = 0.5 * (1 + w)
    return where(s > 0, above, where(s < 0, below, below + share * (above - below)))


@jax.tree_util.register_pytree_node_class
class Corners:
    """One vector for each of k combinations of sides: k of them, or as a `table` one whose numbers
    have the combinations as a leading axis."""

    __slots__ = ("is_table", "rows")

    rows: tuple[Components, ...]
    is_table: bool

    def __init__(self, rows: Iterable[Components], is_table: bool = False):
        self.rows, self.is_table = tuple(rows), is_table

    @classmethod
    def table(cls, vectors: Components) -> "Corners":
        """Those whose numbers have the combinations as a leading axis."""
        return cls([vectors], is_table=True)

    def tree_flatten(self) -> tuple[tuple, bool]:
        return self.rows, self.is_table

    @classmethod
    def tree_unflatten(cls, is_table: bool, rows: Iterable[Any]) -> "Corners":
        return cls(rows, is_table)

    def __len__(self) -> int:
        return self.rows[0].parts[0].shape[0] if self.is_table else len(self.rows)

    def __getitem__(self, i: int) -> Components:
        """The vector of combination number i."""
        return on_each(lambda v: v[i], self.rows[0]) if self.is_table else self.rows[i]

    @property
    def are_of_one(self) -> bool:
        """Whether surfaces are separate: each has its own two sides alone."""
        return len(self) == 2

    def map(self, function: Callable[..., Components], *others: "Corners") -> "Corners":
        """`function` of the vectors on each combination."""
        return Corners(map(function, self.rows, *(c.rows for c in others)), self.is_table)

    def halved(self, function: Callable[[Components, Components], Components]) -> "Corners":
        """`function` of the vectors on side + and on side − of the first surface."""
        half, rows = len(self) // 2, self.rows
        if not self.is_table:
            return Corners(map(function, rows[:half], rows[half:]))
        above, below = on_each(lambda v: v[:half], rows[0]), on_each(lambda v: v[half:], rows[0])
        return Corners.table(function(above, below))

    def sizes(self) -> Components:
        """Σ |v| over the combinations, number by number."""
        if self.is_table:
            return on_each(lambda v: jnp.sum(abs(v), axis=0), self.rows[0])
        return ft.reduce(operator.add, map(abs, self.rows))

    def blend(self, mode: Components, weights: Components) -> Components:
        """Σ_s v_s Π_j (1 + s_j w_j)/2 over all combinations s of sides; of separate surfaces, of
        whose vectors each number is of one surface, number by number."""
        if self.are_of_one:
            return mix(mode, weights, self[0], self[1])
        if len(self) == len(mode.parts) + 1:
            return self._affine_blend(mode, weights)
        corners = self
        for s, w in zip(mode.parts, weights.parts, strict=True):
            corners = corners.halved(ft.partial(mix, s, w))
        return corners[0]

    def _affine_blend(self, mode: Components, weights: Components) -> Components:
        """F_0 − Σ_j p_j (F_0 − F_j), with p_j the share of side −."""
        shares = where(mode > 0, 0.0, where(mode < 0, 1.0, 0.5 * (1 - weights)))
        if self.is_table:
            table = jnp.stack(shares.parts)

            def blended(v: Array) -> Array:
                # What has no share may be no number.
                p = table.reshape(-1, *(1,) * (v.ndim - 1))
                return v[0] - jnp.sum(select(p == 0, 0.0, p * (v[0] - v[1:])), axis=0)

            return on_each(blended, self.rows[0])
        total, first, *others = self.rows[0], *self.rows
        for share, other in zip(shares.parts, others, strict=True):
            total = total - share * (first - other)
        return total

    def slope(self, mode: Components, weights: Components, j: int) -> Components:
        """∂ blend/∂w_j, of surfaces that are not separate."""
        if len(self) == len(mode.parts) + 1:
            return 0.5 * (self[0] - self[1 + j])
        corners = self
        for i, (s, w) in enumerate(zip(mode.parts, weights.parts, strict=True)):
            corners = corners.halved(_half_difference if i == j else ft.partial(mix, s, w))
        return corners[0]


def _half_difference(above: Components, below: Components) -> Components:
    return 0.5 * (above - below)
