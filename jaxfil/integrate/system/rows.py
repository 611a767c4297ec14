"""Rows: a matrix with a row for each surface.

Gradients of H, and the directions in which resets act, are held so: products with vectors of the
state give one number for each surface, and sums of rows with shares give vectors of the state.
"""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.system.components import Components, dot
from jaxfil.xla.moves import taken
from jaxfil.xla.select import select

Members = tuple[tuple[int, ...], ...]
"""For each surface the numbers of the state that its H is made of."""


@jax.tree_util.register_pytree_node_class
class Rows:
    """A matrix with a row for each of m surfaces: the gradients of H, or what resets act along.

    Where surfaces are held as one array (`ComponentSystem.packed`), no two share a number of the
    state, and all rows are one vector: `members` say which of its numbers are of which surface.
    """

    __slots__ = ("members", "rows")

    rows: tuple[Components, ...]
    members: Members | None

    def __init__(self, rows: Iterable[Components], members: Members | None = None):
        self.rows, self.members = tuple(rows), members

    def tree_flatten(self) -> tuple[tuple, Any]:
        return self.rows, self.members

    @classmethod
    def tree_unflatten(cls, members: Any, rows: Iterable[Any]) -> "Rows":
        return cls(rows, members)

    def __abs__(self) -> "Rows":
        return Rows(map(abs, self.rows), self.members)

    def __matmul__(self, v: Components) -> Components:
        """The product of each row with a vector."""
        if self.members is None:
            return Components(dot(row, v) for row in self.rows)
        return Components([_sum_of_members(self.members, self.rows[0] * v)])

    def squares(self) -> Components:
        """The square of the length of each row."""
        if self.members is None:
            return Components(dot(row, row) for row in self.rows)
        return self @ self.rows[0]

    def diagonal(self) -> Components:
        """Number j of row j, of a square matrix."""
        return Components(row.parts[j] for j, row in enumerate(self.rows))

    def transposed(self) -> "Rows":
        """The columns as rows, of a matrix whose rows are numbers one by one."""
        return Rows(map(Components, zip(*(row.parts for row in self.rows), strict=True)))

    def added(self, x: Components, shares: Components) -> Components:
        """x + Σ_j s_j row_j."""
        if self.members is not None:
            (row,) = self.rows
            return x + Components([_share_of_owner(self.members, row, shares)]) * row
        for row, share in zip(self.rows, shares.parts, strict=True):
            x = x + share * row
        return x


def _sum_of_members(members: Members, terms: Components) -> Array:
    """The sum of the terms of each surface, (m,), of one term for each number of the state."""
    most = max(1, max(map(len, members)))
    table = np.zeros((len(members), most), np.int32)
    real = np.arange(most) < np.array([[len(row)] for row in members])
    table[real] = np.concatenate(members)
    return jnp.sum(select(real, taken(terms.parts[0], table), 0.0), axis=1)


def _share_of_owner(members: Members, row: Components, shares: Components) -> Array:
    """For each number of the state the share of its surface, (n,); 0 where it is of none."""
    n, m = len(row.parts[0]), len(members)
    owner = np.full(n, -1, np.int32)
    for j, numbers in enumerate(members):
        owner[list(numbers)] = j
    # A number of none takes any surface, but one that makes a row with its neighbours.
    of = np.where(owner < 0, np.arange(n) % m, owner)
    return select(owner >= 0, taken(shares.parts[0], of), 0.0)
