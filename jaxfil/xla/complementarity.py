"""Affine variational inequalities on a box, by complementary pivoting.

    find z in [l, u] with   F_i(z) = 0  where l_i < z_i < u_i,
                            F_i(z) ≥ 0  where z_i = l_i,     F = q + M z.
                            F_i(z) ≤ 0  where z_i = u_i,

With z = l + y and a multiplier t ≥ 0 for each upper bound it is a linear complementarity problem of
twice the size,

    s = q + M l + M y + t ≥ 0,   s·y = 0,       r = u − l − y ≥ 0,   r·t = 0,

which Lemke's method solves in about as many pivots as there are unknowns off their lower bound. It
returns a solution if the symmetric part of M is positive semidefinite, as for dry friction and
frictionless contacts; otherwise it returns one or terminates on a ray. (R. W. Cottle, J.-S. Pang
and R. E. Stone, The Linear Complementarity Problem, 1992, section 4.4.)
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfil.xla.select import select
from jaxfil.xla.thresholds import COMPLEMENTARITY, PIVOT

# The largest number of pivots, as a multiple of the unknowns of the linear complementarity problem.
_PIVOTS = 8


def solve_on_box(
    q: Float[Array, " k"],
    matrix: Float[Array, "k k"],
    low: Float[Array, " k"],
    high: Float[Array, " k"],
) -> tuple[Float[Array, " k"], Bool[Array, ""]]:
    """z, and whether a solution was computed. Upper bounds may be infinite; where both bounds are
    equal, z is that bound for any F."""
    k = len(q)
    free = high > low
    size = select(free & jnp.isfinite(high), high - low, 1.0)
    # Fixed unknowns and infinite bounds are decoupled from the rest.
    open_ = select(free[:, None] & free[None, :], matrix, 0.0)
    bounded = (free & jnp.isfinite(high)).astype(q.dtype)
    start = select(free, q + matrix @ low, 1.0)
    # An unknown without an upper bound has any unit. Its own one makes the matrix of order one, and
    # a common factor the solution, without which the pivots would be rounding.
    unit = 1 / jnp.sqrt(select(jnp.diag(open_) == 0, 1.0, abs(jnp.diag(open_))))
    unit = select(bounded > 0, 1.0, unit)
    rows = jnp.sum(abs(open_) * unit, axis=1)
    common = jnp.max(select(free & (rows > 0), abs(start) / select(rows == 0, 1.0, rows), 0.0))
    unit = unit * select((bounded > 0) | (common == 0), 1.0, common)
    open_ = open_ * unit
    # Rows are scaled, since unknowns of very different sizes, weights and reactions, share the
    # covering vector.
    scale = jnp.sum(abs(open_), axis=1) + abs(start)
    scale = select(free, select(scale == 0, 1.0, scale), 1.0)
    open_, start, link = open_ / scale[:, None], start / scale, jnp.diag(bounded / scale)
    upper = jnp.concatenate([open_, link], axis=1)
    lower = jnp.concatenate([-jnp.diag(bounded), jnp.zeros_like(open_)], axis=1)
    y, found = _lemke(jnp.concatenate([upper, lower]), jnp.concatenate([start, size]))
    z = low + unit * y[:k]
    # A part of the box, or without an upper bound of the unknown itself, is rounding.
    typical = select(bounded > 0, size, _balancing(q, matrix, z, high))
    close = COMPLEMENTARITY * jnp.finfo(q.dtype).eps * typical
    z = select(z >= high - close, high, select(z <= low + close, low, z))
    z = select(free, z, low)
    # For a singular M the residual after a pivot may be rounding, so the solution is verified.
    value = q + matrix @ z
    noise = residual_noise(q, matrix, z, high)
    wrong = ((value < -noise) & (z < high)) | ((value > noise) & (z > low))
    return z, found & ~jnp.any(wrong & free)


def _balancing(
    q: Float[Array, " k"],
    matrix: Float[Array, "k k"],
    z: Float[Array, " k"],
    high: Float[Array, " k"],
) -> Float[Array, " k"]:
    """The size of each unknown that balances the largest terms of its own row, in the units of the
    unknown."""
    own = abs(jnp.diag(matrix))
    terms = _terms(q, matrix, z, high)
    # An unknown without an effect on its own row is of the size of the others.
    return select(own == 0, jnp.max(abs(z)), terms / select(own == 0, 1.0, own))


def residual_noise(
    q: Float[Array, " k"],
    matrix: Float[Array, "k k"],
    z: Float[Array, " k"],
    high: Float[Array, " k"],
) -> Float[Array, " k"]:
    """The rounding of F = q + M z at a solution."""
    return COMPLEMENTARITY * jnp.finfo(q.dtype).eps * _terms(q, matrix, z, high)


def _terms(
    q: Float[Array, " k"],
    matrix: Float[Array, "k k"],
    z: Float[Array, " k"],
    high: Float[Array, " k"],
) -> Float[Array, " k"]:
    """The size of the terms of F. An unknown between bounds has the rounding of the bounds even
    where it is zero, as the friction of a mass that nothing pushes."""
    bounded = jnp.isfinite(high)
    return abs(q) + abs(matrix) @ select(bounded, jnp.maximum(abs(z), abs(high)), abs(z))


def _lemke(matrix: Float[Array, "N N"], q: Float[Array, " N"]) -> tuple[Array, Array]:
    """y ≥ 0 with w = q + M y ≥ 0 and w·y = 0, and whether it was computed.

    The tableau represents w − M y − d a = q with the artificial variable a. Its column d is all
    ones up to small differences, so that ties are rare.
    """
    size, eps = len(q), jnp.finfo(q.dtype).eps
    number = jnp.arange(size)
    cover = 1 + 0.125 * jnp.sin(1.0 + number.astype(q.dtype))
    table = jnp.concatenate(
        [jnp.eye(size, dtype=q.dtype), -matrix, -cover[:, None], q[:, None]], axis=1
    )
    last, none = 2 * size, jnp.zeros((), bool)

    def pivoted(table: Array, row: Array, column: Array) -> Array:
        chosen = table[row] / table[row, column]
        rest = table - table[:, column][:, None] * chosen
        return select((number == row)[:, None], chosen, rest)

    first = jnp.argmin(q / cover)
    done = q[first] >= 0
    basis = select(number == first, last, number)
    start = pivoted(table, first, jnp.full((), last)), basis, first + size, done, none, 0

    def goes_on(state: tuple) -> Array:
        *_, done, failed, count = state
        return ~done & ~failed & (count < _PIVOTS * size)

    def step(state: tuple) -> tuple:
        table, basis, entering, _, failed, count = state
        column, right = table[:, entering], table[:, -1]
        # Entries within rounding of zero are not used as pivots; they would magnify the rounding of
        # the whole tableau.
        falls = column > PIVOT * eps * jnp.max(abs(column))
        ratio = select(falls, jnp.maximum(right, 0) / select(falls, column, 1), jnp.inf)
        least = jnp.min(ratio)
        # In a tie the artificial variable is chosen, which completes the search.
        tied = ratio <= least + PIVOT * eps * (abs(least) + eps)
        ends = tied & (basis == last) & falls
        row = select(jnp.any(ends), jnp.argmax(ends), jnp.argmin(ratio))
        failed = ~jnp.any(falls)
        leaves = basis[row]
        after = pivoted(table, row, entering)
        table = select(failed, table, after)
        basis = select(failed | (number != row), basis, entering)
        # Lemke's rule: the next variable is the complement of the one that was removed.
        then = select(leaves < size, leaves + size, leaves - size)
        return table, basis, then, leaves == last, failed, count + 1

    table, basis, _, done_later, _, _ = jax.lax.while_loop(goes_on, step, start)
    right = jnp.maximum(table[:, -1], 0)
    values = jnp.sum(select(basis[None, :] == (number + size)[:, None], right[None, :], 0), axis=1)
    return select(done, jnp.zeros_like(q), values), done | done_later


def is_monotone(matrix: Float[Array, "k k"], taken: Bool[Array, " k"]) -> Bool[Array, ""]:
    """Whether the symmetric part of the rows and columns in `taken` is positive definite, so that
    the inequality has exactly one solution for any q."""
    both = taken[:, None] & taken[None, :]
    part = select(both, 0.5 * (matrix + matrix.T), jnp.eye(len(matrix), dtype=matrix.dtype))
    # Scaled to a unit diagonal, so that a multiple of eps is a threshold for any units.
    scale = jnp.sqrt(jnp.maximum(jnp.diag(part), 0))
    scale = select(scale == 0, 1.0, scale)
    scaled = part / (scale[:, None] * scale[None, :])
    return jnp.min(jnp.linalg.eigvalsh(scaled)) > PIVOT * jnp.finfo(matrix.dtype).eps
