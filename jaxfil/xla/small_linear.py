"""Small dense linear systems.

They are solved by elimination with partial pivoting, in plain arithmetic on lists of scalars. In a
batch each scalar is an array of lanes, whereas a LAPACK call for each lane would cost microseconds.
Two unknowns are written out; for more, a loop over the columns has a program of constant size.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.xla.select import select
from jaxfil.xla.thresholds import PIVOT

# The largest system that is written out.
_WRITTEN_OUT = 2


def solve_small(
    matrix: Sequence[Sequence[Array]], rights: Sequence[Sequence[Array]]
) -> list[list[Array]]:
    """x of A x = b for each b of `rights`, by one elimination. The unknown of a column without a
    usable pivot is 0, and its equations are left to the other unknowns, so that a consistent
    singular system (one surface listed twice, or one that no unknown moves) has its solution."""
    k = len(matrix)
    if k > _WRITTEN_OUT:
        found = _solved(_array(matrix), _array(rights).T, None)
        return [[found[i, r] for i in range(k)] for r in range(len(rights))]
    rows = _eliminated([_equilibrated(row, k) for row in _beside(matrix, rights)], k)
    # One unknown has no other equation, and `_without` assigns no row to a column without a pivot.
    if k == 2:
        rows = _left_to_the_second(*rows)
    return [_back_substituted(rows, k, r) for r in range(k, k + len(rights))]


def solve(matrix: Array, rights: Array, taken: Array) -> Array:
    """The same for arrays, (k, k) and (k, r), and the unknowns in `taken`; the others are 0. The
    cost grows with the number of unknowns taken."""
    return _solved(_among(matrix, taken), rights, taken)


def inverse(matrix: Array | Sequence[Sequence[Array]], taken: Array | None = None) -> Array:
    """The matrix that gives the solutions of `solve`, or of `solve_small` without `taken`, as
    products with right-hand sides."""
    k = len(matrix)
    if isinstance(matrix, jax.Array):
        assert taken is not None
        return solve(matrix, jnp.eye(k, dtype=matrix.dtype), taken)
    unit = jnp.eye(k, dtype=jnp.result_type(matrix[0][0]))
    return jnp.stack([jnp.stack(column) for column in solve_small(matrix, list(unit))], axis=1)


@jax.custom_jvp
def _solved(matrix: Array, rights: Array, taken: Array | None) -> Array:
    """The unknowns of a system, of those in `taken` if it is given, shape (k, r)."""
    rows = _equilibrated_rows(jnp.concatenate([matrix, rights], axis=1))
    return (_reduced(rows) if taken is None else _reduced_among(rows, taken))[0]


@_solved.defjvp
def _solved_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    # A⁻¹ (ḃ − Ȧ x). Through the elimination, whose loop has matrix and right-hand sides in one
    # array, reverse mode could not tell that the pivots do not depend on tangents.
    (matrix, rights, taken), (turned, moved, _) = primals, tangents
    unit = jnp.eye(len(matrix), dtype=matrix.dtype)
    both = _solved(matrix, jnp.concatenate([rights, unit], axis=1), taken)
    x, inverse = both[:, : rights.shape[1]], both[:, rights.shape[1] :]
    rest = moved - _product(turned, x)
    if taken is not None:
        rest = select(taken[:, None], rest, 0)
    return x, _product(inverse, rest)


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, None] * b, axis=1)


def _array(rows: Sequence[Sequence[Array]]) -> Array:
    return jnp.stack([jnp.stack(row) for row in rows])


def _among(matrix: Array, taken: Array) -> Array:
    """The matrix without the columns that are not in `taken`, which would scale its rows."""
    return select(taken, matrix, 0)


def size_of_determinant(
    matrix: Array | Sequence[Sequence[Array]], taken: Array | None = None
) -> Array:
    """|det A|, or 0 if a pivot is within rounding; for an array, of the rows and columns in
    `taken`."""
    if taken is None:
        return _size_of_small(matrix)
    assert isinstance(matrix, jax.Array)
    matrix = _among(matrix, taken)
    # Pivots are computed from equilibrated rows, since their threshold is for entries of order one.
    # The determinant is their product times the scales. Its sign is lost with the exchanges of
    # rows.
    scales = jnp.sum(abs(matrix), axis=1)
    pivots = abs(_reduced_among(_equilibrated_rows(matrix), taken)[1])
    kept = select(_is_rounding(pivots), 0, pivots)
    return jnp.prod(select(taken, kept * scales, 1.0))


def _reduced_among(rows: Array, taken: Array) -> tuple[Array, Array]:
    """`_reduced` for the rows and columns in `taken`, one after the other."""

    def column(carry: tuple) -> tuple:
        left, state = carry
        # The largest flag, which is the first column not eliminated yet. Columns that are not in
        # `taken` cost no iteration.
        i = jax.lax.argmax(left, 0, jnp.int32)
        return left & (jnp.arange(len(rows), dtype=jnp.int32) != i), _without(i, state)

    start = taken, _unreduced(rows, taken)
    _, state = jax.lax.while_loop(lambda carry: jnp.any(carry[0]), column, start)
    return _solution(state)


def _size_of_small(matrix: Any) -> Array:
    k = len(matrix)
    scales = [_scale(row) for row in matrix]
    if k > _WRITTEN_OUT:
        _, found = _reduced(_equilibrated_rows(_array(matrix)))
        pivots = [found[i] for i in range(k)]
    else:
        rows = _eliminated([_equilibrated(row, k) for row in matrix], k)
        pivots = [row[i] for i, row in enumerate(rows)]
    size: Any = 1.0
    for pivot, scale in zip(map(abs, pivots), scales, strict=True):
        size = size * select(_is_rounding(pivot), 0, pivot) * scale
    return size


def _beside(
    matrix: Sequence[Sequence[Array]], rights: Sequence[Sequence[Array]]
) -> list[list[Array]]:
    """The rows of a matrix, each with its numbers of the right-hand sides behind it."""
    return [[*row, *(b[i] for b in rights)] for i, row in enumerate(matrix)]


def _equilibrated_rows(rows: Array) -> Array:
    """Rows with their right-hand sides in the columns from k on, with entries of order one."""
    # Right-hand sides do not count, since a pivot is usable or not for all of them. A row of zeros
    # is not scaled, and has no pivot.
    scale = jnp.sum(abs(rows[:, : len(rows)]), axis=1, keepdims=True)
    return rows / select(scale == 0, 1, scale)


def _reduced(rows: Array) -> tuple[Array, Array]:
    """The unknowns, shape (k, r), and the pivots of a system with its right-hand sides in the
    columns from k on, by Gauss–Jordan elimination."""
    # Gauss–Jordan elimination needs more operations than back substitution, but is a single loop to
    # compile.
    start = _unreduced(rows, jnp.ones(len(rows), bool))
    return _solution(jax.lax.fori_loop(0, len(rows), _without, start))


_Elimination = tuple[Array, Array, Array, Array]
"""Rows, flags of rows without a pivot yet, flags of each column's pivot row, and the pivots."""


def _unreduced(rows: Array, taken: Array) -> _Elimination:
    return rows, taken, jnp.zeros((len(rows), len(rows)), bool), jnp.zeros_like(rows[:, 0])


def _solution(state: _Elimination) -> tuple[Array, Array]:
    rows, _, places, pivots = state
    rights = rows[:, len(rows) :]
    return jnp.sum(select(places[:, :, None], rights, 0), axis=1), pivots


def _without(i: Array, state: _Elimination) -> _Elimination:
    """The elimination of column i, without row swaps. Rows are selected by sums with ones and
    zeros, not by indexing, so that lanes with different pivots can be vectorised. A column without
    a usable pivot takes no row."""
    rows, free, places, pivots = state
    number, column = (
        jnp.arange(len(rows), dtype=i.dtype),
        jnp.arange(rows.shape[1], dtype=i.dtype) == i,
    )
    entries = jnp.sum(select(column, rows, 0), axis=1)
    # −1 is less than every size, so that a row with a pivot is not chosen twice.
    here = number == jax.lax.argmax(select(free, abs(entries), -1), 0, i.dtype)
    upper = jnp.sum(select(here[:, None], rows, 0), axis=0)
    pivot = jnp.sum(select(column, upper, 0))
    # A row given to such a column would be lost as an equation of another unknown, which would be 0
    # then (`test_a_singular_system_with_a_solution_is_solved`).
    here = here & ~_is_rounding(pivot)
    upper = _quotient(upper, pivot)
    # Without a usable pivot `upper` is 0, and all rows are unchanged.
    rows = select(here[:, None], upper, rows - entries[:, None] * upper)
    places = places | ((number == i)[:, None] & here)
    return rows, free & ~here, places, select(number == i, pivot, pivots)


def _eliminated(rows: list[list[Array]], k: int) -> list[list[Array]]:
    """Rows whose first k columns are upper triangular."""
    for i in range(k):
        for r in range(i + 1, k):  # bring the largest pivot up by pairwise swaps
            swap = abs(rows[r][i]) > abs(rows[i][i])
            upper = [select(swap, q, p) for p, q in zip(rows[i], rows[r], strict=True)]
            lower = [select(swap, p, q) for p, q in zip(rows[i], rows[r], strict=True)]
            rows[i], rows[r] = upper, lower
        for r in range(i + 1, k):
            # A pivot within rounding is the largest of its column. The factor is then 0, and the
            # rows below are unchanged.
            factor = _quotient(rows[r][i], rows[i][i])
            rows[r] = [q - factor * p for p, q in zip(rows[i], rows[r], strict=True)]
    return rows


def _left_to_the_second(first: list[Array], second: list[Array]) -> list[list[Array]]:
    """Two eliminated rows. If the first unknown has no usable pivot, both are equations of the
    second unknown, of which the one with the larger pivot is solved."""
    swap = _is_rounding(first[0]) & (abs(first[1]) > abs(second[1]))
    lower = [select(swap, p, q) for p, q in zip(first[1:], second[1:], strict=True)]
    return [first, [second[0], *lower]]


def _back_substituted(rows: list[list[Array]], k: int, right: int) -> list[Array]:
    """x of an upper triangular system for the right-hand side in the column `right`."""
    x: list[Array] = [rows[0][right]] * k
    for i in reversed(range(k)):
        rest = rows[i][right]
        for j in range(i + 1, k):
            rest = rest - rows[i][j] * x[j]
        x[i] = _quotient(rest, rows[i][i])
    return x


def _equilibrated(row: Sequence[Array], k: int) -> list[Array]:
    """The row scaled to entries of order one in its first k columns, so that one threshold detects
    every singular pivot."""
    scale = _scale(row[:k])
    return [v / select(scale == 0, 1, scale) for v in row]


def _scale(row: Sequence[Array]) -> Array:
    return sum((abs(v) for v in row), start=jnp.zeros_like(row[0]))


def _quotient(a: Array, pivot: Array) -> Array:
    """a/pivot, or 0 if the pivot is within rounding."""
    singular = _is_rounding(pivot)
    return select(singular, 0, a / select(singular, 1, pivot))


def _is_rounding(pivot: Array) -> Array:
    return abs(pivot) <= PIVOT * jnp.finfo(pivot.dtype).eps


class Factors(eqx.Module):
    """U and L⁻¹P of a regular matrix A = P⁻¹LU, as rows of scalars."""

    upper: list[list[Array]]
    lower: list[list[Array]]

    def solve(self, right: Sequence[Array]) -> list[Array]:
        """x of A x = b."""
        k = len(right)
        # L⁻¹P is stored in place of L. Its products with b are independent of each other, unlike
        # the operations of a forward substitution.
        y: list[Any] = [sum(p * b for p, b in zip(row, right, strict=True)) for row in self.lower]
        for i in reversed(range(k)):
            for j in range(i + 1, k):
                y[i] = y[i] - self.upper[i][j] * y[j]
            y[i] = y[i] / self.upper[i][i]
        return y


def factored(matrix: Sequence[Sequence[Array]]) -> Factors:
    """The factors of a regular matrix, for many right-hand sides. A zero pivot gives inf."""
    k = len(matrix)
    zero = jnp.zeros_like(matrix[0][0])
    rows = []
    for i, row in enumerate(matrix):
        scale = 1 / sum((abs(v) for v in row), start=zero)
        # Elimination turns the unit matrix, scaled like the rows, into L⁻¹P.
        rows.append([scale * v for v in row] + [scale if i == j else zero for j in range(k)])
    rows = _eliminated(rows, k)
    return Factors([row[:k] for row in rows], [row[k:] for row in rows])
