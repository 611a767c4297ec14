"""Rows: a matrix with a row for each surface.

It represents gradients of H, and the directions in which resets act. Products with vectors of the
state give one number for each surface, and combinations of rows give vectors of the state.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.system.components import Components, dot, where
from jaxfil.xla.moves import taken
from jaxfil.xla.select import select

Members = tuple[tuple[int, ...], ...]
"""For each surface the numbers of the state that its H depends on."""


@jax.tree_util.register_pytree_node_class
class Rows:
    """A matrix with a row for each of m surfaces: the gradients of H, or the directions of resets.

    For surfaces in one array (`ComponentSystem.packed`) the rows are one array too. If no two
    surfaces share a number of the state, all rows are stored in one vector, and `members` lists the
    numbers of each surface.
    """

    __slots__ = ("is_array", "members", "rows")

    rows: tuple[Components, ...]
    members: Members | None
    is_array: bool

    def __init__(
        self,
        rows: Iterable[Components],
        members: Members | None = None,
        is_array: bool = False,
    ):
        self.rows, self.members, self.is_array = tuple(rows), members, is_array

    @classmethod
    def array(cls, rows: Array) -> "Rows":
        """The rows of an array."""
        return cls([Components([rows])], is_array=True)

    def tree_flatten(self) -> tuple[tuple, Any]:
        return self.rows, (self.members, self.is_array)

    @classmethod
    def tree_unflatten(cls, kind: Any, rows: Iterable[Any]) -> "Rows":
        return cls(rows, *kind)

    @property
    def _array(self) -> Array:
        return self.rows[0].parts[0]

    def entries(self) -> Array | list[list[Array]]:
        """The entries, as an array or as lists."""
        return self._array if self.is_array else [list(row.parts) for row in self.rows]

    def __abs__(self) -> "Rows":
        return Rows(map(abs, self.rows), self.members, self.is_array)

    def plus(self, other: "Rows") -> "Rows":
        """The sum with another matrix; neither may have `members`."""
        rows = (a + b for a, b in zip(self.rows, other.rows, strict=True))
        return Rows(rows, None, self.is_array)

    def where(self, chosen: Sequence[bool], other: "Rows") -> "Rows":
        """The chosen rows, with rows of another matrix in place of the others."""
        if self.is_array:
            mask = np.array(chosen)[:, None]
            return Rows.array(select(mask, self._array, other._array))
        each = zip(chosen, self.rows, other.rows, strict=True)
        return Rows(own if flag else others for flag, own, others in each)

    def where_each(self, chosen: Components, other: "Rows") -> "Rows":
        """`where` for the flags of a lane; neither may have `members`."""
        if self.is_array:
            return Rows.array(select(chosen.parts[0][:, None], self._array, other._array))
        each = zip(chosen.parts, self.rows, other.rows, strict=True)
        return Rows(where(flag, own, others) for flag, own, others in each)

    def __matmul__(self, v: Components) -> Components:
        """The product of each row with a vector."""
        if self.is_array:
            return Components([self._array @ v.parts[0]])
        if self.members is None:
            return Components(dot(row, v) for row in self.rows)
        # All rows are in one vector, so one product serves all surfaces.
        return Components([_sum_of_members(self.members, self.rows[0] * v)])

    def squares(self) -> Components:
        """The squared length of each row."""
        if self.is_array:
            return Components([jnp.sum(self._array * self._array, axis=1)])
        if self.members is None:
            return Components(dot(row, row) for row in self.rows)
        return self @ self.rows[0]

    def products(self, other: "Rows") -> "Rows":
        """The products of each row with each row of another matrix, which has no `members`."""
        if self.is_array:
            return Rows.array(self._array @ other._array.T)
        # Each product gives a column, and the columns are transposed to rows.
        columns = [list((self @ row).parts) for row in other.rows]
        zero = jnp.zeros_like(self.rows[0].number(0))
        return Rows(Components(zero + v for v in row) for row in zip(*columns, strict=True))

    def diagonal(self) -> Components:
        """The diagonal of a square matrix."""
        if self.is_array:
            return Components([jnp.diagonal(self._array)])
        return Components(row.parts[j] for j, row in enumerate(self.rows))

    def added(self, x: Components, shares: Components) -> Components:
        """x + Σ_j s_j row_j."""
        if self.is_array:
            return x + Components([shares.parts[0] @ self._array])
        if self.members is not None:
            (row,) = self.rows
            # Each number of the state belongs to at most one surface.
            return x + Components([_share_of_owner(self.members, row, shares)]) * row
        for row, share in zip(self.rows, shares.parts, strict=True):
            x = x + share * row
        return x


def _sum_of_members(members: Members, terms: Components) -> Array:
    """The sum of the terms of each surface, (m,), given a term for each number of the state."""
    # Shorter rows are padded with index 0, which `real` masks. H may depend on the time alone, with
    # no number in any row.
    most = max(1, max(map(len, members)))
    table = np.zeros((len(members), most), np.int32)
    real = np.arange(most) < np.array([[len(row)] for row in members])
    table[real] = np.concatenate(members)
    return jnp.sum(select(real, taken(terms.parts[0], table), 0.0), axis=1)


def _share_of_owner(members: Members, row: Components, shares: Components) -> Array:
    """For each number of the state the share of its surface, (n,); 0 for numbers of no surface."""
    n, m = len(row.parts[0]), len(members)
    owner = np.full(n, -1, np.int32)
    for j, numbers in enumerate(members):
        owner[list(numbers)] = j
    # Numbers of no surface read an arbitrary share, masked below, chosen so that neighbours
    # in the state still read a contiguous slice.
    of = np.where(owner < 0, np.arange(n) % m, owner)
    return select(owner >= 0, taken(shares.parts[0], of), 0.0)
