"""Corners: vectors (fields, or rates dH/dt along them) on combinations of the sides of m surfaces.

The number of combinations depends on the surfaces:

- Two, all sides + and all sides −, for separate surfaces (`Structure.separate`).
- One with all sides +, and one for each side that switches the field with that side −, where the
  field is affine in the sides, or reactions couple separate surfaces:
  F = F_0 − Σ_j (1 − s_j)/2 (F_0 − F_j).
- All 2^m for other surfaces, the first surface varying slowest.
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

from jaxfil.integrate.system.components import Components, on_each, pack, scalars, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select

# The largest number of combinations stored one by one. More are rows of arrays, so that the program
# does not grow with their number; a program with rows of five or fewer takes longer to compile.
_WRITTEN_OUT = 5


def _taken(share: Array, gap: Array) -> Array:
    """A difference of two rows, without one that is not defined and has no share."""
    # A finite one stays even without a share, since the blend has a derivative by its weight.
    return select((share == 0) & ~jnp.isfinite(gap), 0.0, gap)


def _of_share(share: Array, gap: Array) -> Array:
    """The same for a blend whose weights are constant; linear in the difference."""
    return select(share == 0, 0.0, gap)


def _size(v: Array) -> Array:
    return select(jnp.isnan(v), 0.0, abs(v))


def every_side(m: int) -> np.ndarray:
    """All combinations of the sides of m surfaces, shape (2^m, m), the first surface varying
    slowest, + before −."""
    return np.array(list(itertools.product((1.0, -1.0), repeat=m)))


def corner_sides(system: ComponentSystem) -> np.ndarray:
    """The combinations of sides that determine a field on all of them, shape (k, m)."""
    m, flipped = system.m, flipped_sides(system)
    if flipped is not None:
        return np.concatenate([np.ones((1, m)), 1 - 2 * np.eye(m)[list(flipped)]])
    if system.structure.separate:
        return np.array([[1.0] * m, [-1.0] * m])
    return every_side(m)


def are_coupled(system: ComponentSystem) -> bool:
    """Whether the mode on one surface may depend on another's, through their sides or through
    reactions, which act on each other's surfaces."""
    return system.m > 1 and (system.resets or not system.structure.separate)


def flipped_sides(system: ComponentSystem) -> tuple[int, ...] | None:
    """The surfaces whose sides are switched one by one, if the field is affine in them and they are
    coupled; otherwise None."""
    found = system.structure
    # A number that depends on only one side is affine in it.
    if not are_coupled(system) or not (found.affine or found.separate):
        return None
    # A side that switches no number of the field has no row, which would be a copy of the first.
    return tuple(sorted(set().union(*found.switched)))


def steered(system: ComponentSystem) -> Components:
    """`Structure.steered` as flags."""
    return system.of_surfaces(jnp.asarray(system.structure.steered))


def on_corners(
    function: Callable[[Components], Any], system: ComponentSystem, sides: np.ndarray
) -> Any:
    """A vector, or several, on combinations of sides, as `Corners`."""
    # One tree for each combination becomes one tree of `Corners`. In a table `made` has one entry.
    made, is_table = _of_each(function, system, sides), _is_table(sides)
    flipped = flipped_sides(system)
    return jax.tree.map(lambda *each: Corners(each, is_table, flipped), *made, is_leaf=_is_vector)


def for_each_corner(function: Callable[[Components], Any], system: ComponentSystem) -> list[Any]:
    """The values of a function on the combinations of sides that determine a field on all of them,
    as a list, or as one value with the combinations as a leading axis where they are a table."""
    return _of_each(function, system, corner_sides(system))


def _is_table(sides: np.ndarray) -> bool:
    return len(sides) > _WRITTEN_OUT


def _of_each(
    function: Callable[[Components], Any], system: ComponentSystem, sides: np.ndarray
) -> list[Any]:
    if _is_table(sides):
        rows = sides.astype(system.dtype)
        # Shape (k, m), or m columns of k numbers. `vmap` takes one combination of each.
        columns = Components([rows]) if system.packed else Components(scalars(rows.T))
        return [jax.vmap(function)(columns)]
    # Built from scalars and not from an array, since a constant array would become an argument of
    # the kernel, and XLA could not simplify the products with its ones.
    rows = [jnp.stack([jnp.asarray(float(v), system.dtype) for v in row]) for row in sides]
    return [function(system.of_surfaces(row)) for row in rows]


def _is_vector(v: Any) -> bool:
    return isinstance(v, Components)


def mix(s: Any, w: Any, above: Any, below: Any) -> Components:
    """The vector on side s of one surface, or where s = 0 the blend of both with weight w. The
    value on a side is selected, so a NaN on the other side does not reach it."""
    share = 0.5 * (1 + w)
    return where(s > 0, above, where(s < 0, below, below + share * (above - below)))


@jax.tree_util.register_pytree_node_class
class Corners:
    """One vector for each of k combinations of sides, as k vectors, or as a `table`, one vector
    with the combinations as a leading axis."""

    __slots__ = ("flipped", "is_table", "rows")

    rows: tuple[Components, ...]
    is_table: bool
    flipped: tuple[int, ...] | None
    """The surfaces with a row for their side −, if the vectors are affine in the sides."""

    def __init__(
        self,
        rows: Iterable[Components],
        is_table: bool = False,
        flipped: tuple[int, ...] | None = None,
    ):
        self.rows, self.is_table, self.flipped = tuple(rows), is_table, flipped

    @classmethod
    def table(cls, vectors: Components) -> "Corners":
        """Corners from numbers that have the combinations as a leading axis."""
        return cls([vectors], is_table=True)

    def tree_flatten(self) -> tuple[tuple, Any]:
        # The layout is static, since functions choose between formulas by it.
        return self.rows, (self.is_table, self.flipped)

    @classmethod
    def tree_unflatten(cls, kind: Any, rows: Iterable[Any]) -> "Corners":
        return cls(rows, *kind)

    def __len__(self) -> int:
        return self.rows[0].parts[0].shape[0] if self.is_table else len(self.rows)

    def __getitem__(self, i: int) -> Components:
        """The vector of combination number i."""
        return on_each(lambda v: v[i], self.rows[0]) if self.is_table else self.rows[i]

    @property
    def are_of_one(self) -> bool:
        """Whether surfaces are separate, so that each has only its own two sides."""
        # A single flipped side has two rows too. Otherwise coupled surfaces have 2^m ≥ 4 rows.
        return self.flipped is None and len(self) == 2

    def map(self, function: Callable[..., Components], *others: "Corners") -> "Corners":
        """`function`, which acts elementwise, applied to the vectors on each combination."""
        rows = map(function, self.rows, *(c.rows for c in others))
        return Corners(rows, self.is_table, self.flipped)

    def each(self, function: Callable[..., Components], *others: "Corners") -> "Corners":
        """`function`, which acts on whole vectors, applied on each combination."""
        if self.is_table:
            function = jax.vmap(function)
        return self.map(function, *others)

    def all_of(self, vector: Components) -> "Corners":
        """The same vector on each combination."""
        return self.map(lambda v: on_each(lambda a, b: jnp.broadcast_to(b, a.shape), v, vector))

    def halved(self, function: Callable[[Components, Components], Components]) -> "Corners":
        """`function` of the vectors on side + and on side − of the first surface."""
        half, rows = len(self) // 2, self.rows
        if not self.is_table:
            return Corners(map(function, rows[:half], rows[half:]))
        above, below = on_each(lambda v: v[:half], rows[0]), on_each(lambda v: v[half:], rows[0])
        return Corners.table(function(above, below))

    def sizes(self) -> Components:
        """Σ |v| over the combinations, elementwise. A number that is not defined on one of them,
        where the motion never goes, does not count."""
        sizes = [on_each(_size, row) for row in self.rows]
        if self.is_table:
            return on_each(lambda v: jnp.sum(v, axis=0), sizes[0])
        return ft.reduce(operator.add, sizes)

    def blend(self, mode: Components, weights: Components, fixed: bool = False) -> Components:
        """Σ_s v_s Π_j (1 + s_j w_j)/2 over all combinations s of sides; for separate surfaces an
        elementwise blend, in which each number of the vectors belongs to one surface. With `fixed`
        weights, as of tangents, it is linear in the vectors."""
        if self.are_of_one:
            return mix(mode, weights, self[0], self[1])
        if self.flipped is not None:
            taken = _of_share if fixed else _taken
            return self._affine_blend(self.flipped, mode, weights, taken)
        corners = self
        # The first surface varies slowest, so each pass blends the first one that remains, and the
        # number of rows is halved.
        for i in range(mode.size):
            corners = corners.halved(ft.partial(mix, mode.number(i), weights.number(i)))
        return corners[0]

    def _affine_blend(
        self,
        flipped: tuple[int, ...],
        mode: Components,
        weights: Components,
        taken: Callable[[Array, Array], Array],
    ) -> Components:
        """F_0 − Σ_j p_j (F_0 − F_j), with p_j the share of side −."""
        shares = where(mode > 0, 0.0, where(mode < 0, 1.0, 0.5 * (1 - weights)))
        of_rows = [shares.number(j) for j in flipped]
        if self.is_table:
            table = jnp.stack(of_rows)

            def blended(v: Array) -> Array:
                p = table.reshape(-1, *(1,) * (v.ndim - 1))
                return v[0] - jnp.sum(p * taken(p, v[0] - v[1:]), axis=0)

            return on_each(blended, self.rows[0])
        total, first, *others = self.rows[0], *self.rows
        for share, other in zip(of_rows, others, strict=True):
            total = total - share * on_each(ft.partial(taken, share), first - other)
        return total

    def matrix(self) -> Array:
        """The vectors as the rows of an array, one for each combination."""
        if not self.is_table:
            return jnp.stack([pack(row, float) for row in self.rows])
        columns = self.rows[0].parts
        return columns[0] if columns[0].ndim > 1 else jnp.stack(columns, axis=1)

    def slopes(self) -> Array:
        """∂ blend/∂w_j in column j, shape (m, m), for vectors of one number for each of m surfaces
        that are affine in the sides."""
        assert self.flipped is not None
        rows = self.matrix()
        first, below, m = rows[0], rows[1:], rows.shape[1]
        if not self.flipped:
            return jnp.zeros((m, m), first.dtype)
        # A column for each side that switches the field, put at the index of its surface.
        place = np.zeros((len(self.flipped), m))
        place[np.arange(len(self.flipped)), list(self.flipped)] = 1.0
        # The share of side − is (1 − w)/2, hence the factor.
        return 0.5 * (first - below).T @ jnp.asarray(place, first.dtype)

    def slope(self, mode: Components, weights: Components, j: int) -> Components:
        """∂ blend/∂w_j, for surfaces that are not separate."""
        if self.flipped is not None:
            if j not in self.flipped:
                return 0.0 * self[0]
            return 0.5 * (self[0] - self[1 + self.flipped.index(j)])
        corners = self
        for i in range(mode.size):
            mixed = ft.partial(mix, mode.number(i), weights.number(i))
            # The derivative of `mix` on a slide, where the share of side + is (1 + w)/2.
            corners = corners.halved(_half_difference if i == j else mixed)
        return corners[0]


def _half_difference(above: Components, below: Components) -> Components:
    return 0.5 * (above - below)
