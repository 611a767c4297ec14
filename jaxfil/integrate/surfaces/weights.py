"""Sliding weights: where on a surface, or on several, the blend of the fields is tangent to it.

The rates dH/dt along the fields of all sides enter, with the mode of motion; the weights
w in [−1, 1] of the surfaces slid on leave, at which the rate of the blend vanishes. In which form
the fields of all sides are, `Corners` says.
"""

import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.system.components import Components, where
from jaxfil.xla import small_linear
from jaxfil.xla.select import select


class CornerTable(eqx.Module):
    """Vectors on combinations of sides, as arrays: a program that does not grow with their
    number."""

    vectors: Components
    """Each component with a leading axis of the combinations."""

    @property
    def rows(self) -> int:
        """How many combinations."""
        return self.vectors[0].shape[0]


Corners: TypeAlias = Sequence[Components] | CornerTable
"""Vectors (fields, or rates dH/dt along them) on combinations of the sides of m surfaces.

- Two, on all sides + and on all sides −, where surfaces are separate.
- m + 1, on all sides + and on those with the side of one surface after the other −, where the field
  is affine in the sides, F = F_0 − Σ_j (1 − s_j)/2 (F_0 − F_j): all others follow.
- All 2^m of others, in the order of `every_side`.

Where they are many, a `CornerTable`.
"""


def every_side(m: int) -> np.ndarray:
    """All combinations of the sides of m surfaces, shape (2^m, m), the first surface varying
    slowest, + before −."""
    return np.array(list(itertools.product((1.0, -1.0), repeat=m)))


def first_corner(corners: Corners) -> Components:
    """The vector on all sides +."""
    if isinstance(corners, CornerTable):
        return tuple(v[0] for v in corners.vectors)
    return corners[0]


def size_of(corners: Corners, j: int) -> Array:
    """Σ |component j| over the combinations."""
    if isinstance(corners, CornerTable):
        return jnp.sum(abs(corners.vectors[j]), axis=0)
    return sum((abs(v[j]) for v in corners), start=jnp.zeros_like(corners[0][j]))


def map_components(function: Callable[..., Array], *corners: Corners) -> Corners:
    """`function(j, *v)` of component number j of each vector, of one or more at the same corner."""
    first = corners[0]
    if isinstance(first, CornerTable):
        columns = zip(*(c.vectors for c in corners if isinstance(c, CornerTable)), strict=True)
        return CornerTable(tuple(function(j, *v) for j, v in enumerate(columns)))
    return [
        tuple(function(j, *v) for j, v in enumerate(zip(*vectors, strict=True)))
        for vectors in zip(*(c for c in corners if not isinstance(c, CornerTable)), strict=True)
    ]


def _are_affine(corners: Corners, m: int) -> bool:
    return (corners.rows if isinstance(corners, CornerTable) else len(corners)) == m + 1


# Newton iterations for the weights of an intersection at most, from one start.
_NEWTON = 20
# The weights from which Newton's method starts if it has not found a root inside from 0.
_START = 0.6
# Weights this large are those of no slide, nor of its continuation beyond its end.
_FAR = 1e3


def mix(s: Array, w: Array, above: Components, below: Components) -> Components:
    """The field on side s of one surface, or where s = 0 the blend of both with weight w. A side is
    taken as it is, untouched by a NaN of the other."""
    share = 0.5 * (1 + w)
    return tuple(
        select(s > 0, a, select(s < 0, b, b + share * (a - b)))
        for a, b in zip(above, below, strict=True)
    )


def blend(corners: Corners, mode: Components, weights: Components) -> Components:
    """Σ_s corners[s] Π_j (1 + s_j w_j)/2 over all combinations s of sides; not of separate
    surfaces."""
    if isinstance(corners, CornerTable):
        return _weighted(corners, _shares(corners, mode, weights))
    if _are_affine(corners, len(mode)):
        total = corners[0]
        for part, other in zip(map(_below, mode, weights), corners[1:], strict=True):
            each = zip(total, corners[0], other, strict=True)
            total = tuple(t - part * (a - b) for t, a, b in each)
        return total
    for s, w in zip(mode, weights, strict=True):
        half = len(corners) // 2
        corners = [mix(s, w, corners[i], corners[half + i]) for i in range(half)]
    return corners[0]


def _below(s: Array, w: Array) -> Array:
    """The share of side − in the mode s of a surface with weight w."""
    return select(s > 0, 0.0, select(s < 0, 1.0, 0.5 * (1 - w)))


def _shares(
    table: CornerTable, mode: Components, weights: Components, derivative: int | None = None
) -> Array:
    """The share of each row of a table in a mode with weights, or its derivative by one weight."""
    below = jnp.stack(list(map(_below, mode, weights)))
    m, dtype = len(mode), mode[0].dtype
    if _are_affine(table, m):
        if derivative is not None:
            return jnp.asarray(0.5 * (np.eye(m + 1)[0] - np.eye(m + 1)[1 + derivative]), dtype)
        return jnp.concatenate([1 - jnp.sum(below, keepdims=True), below])
    minus = every_side(m) < 0
    factors = select(minus, below, 1 - below)
    if derivative is not None:
        slope = jnp.asarray(0.5 * every_side(m)[:, derivative], dtype)[:, None]
        factors = select(np.arange(m) == derivative, slope, factors)
    return jnp.prod(factors, axis=1)


def _weighted(table: CornerTable, share: Array) -> Components:
    """Σ_s share_s table[s]; what has no share may be no number."""
    shares = [share.reshape(-1, *(1,) * (v.ndim - 1)) for v in table.vectors]
    return tuple(
        jnp.sum(select(p == 0, 0.0, p * v), axis=0)
        for p, v in zip(shares, table.vectors, strict=True)
    )


def _slope(corners: Corners, mode: Components, weights: Components, j: int) -> Components:
    """∂ blend/∂w_j."""
    if isinstance(corners, CornerTable):
        return _weighted(corners, _shares(corners, mode, weights, j))
    if _are_affine(corners, len(mode)):
        return tuple(0.5 * (a - b) for a, b in zip(corners[0], corners[1 + j], strict=True))
    for i, (s, w) in enumerate(zip(mode, weights, strict=True)):
        half = len(corners) // 2
        pairs = [(corners[k], corners[half + k]) for k in range(half)]
        if i == j:
            corners = [tuple(0.5 * (p - q) for p, q in zip(a, b, strict=True)) for a, b in pairs]
        else:
            corners = [mix(s, w, a, b) for a, b in pairs]
    return corners[0]


@jax.custom_jvp
def _single_weight(s: Array, above: Array, below: Array) -> Array:
    """The weight of one surface: (below + above)/(below − above) where s = 0, else s. It has no
    derivative off the surface, where a side may not be a number, and where both are the same."""
    gap = below - above
    zero = gap == 0
    return select(s == 0, select(zero, 0, (below + above) / select(zero, 1, gap)), s)


@_single_weight.defjvp
def _single_weight_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (s, above, below), (_, rise, fall) = primals, tangents
    w, gap = _single_weight(s, above, below), below - above
    slides = (s == 0) & (gap != 0)
    change = (fall + rise - w * (fall - rise)) / select(slides, gap, 1)
    return w, select(slides, change, 0.0)


def weights(mode: Components, rates: Corners) -> Components:
    """The weights of a mode: ±1 off a surface, the solution of dH/dt(w) = 0 on it.

    `rates` are dH_j/dt along the fields of the corners. The solution may lie outside [−1, 1]:
    beyond the end of a slide it is the smooth continuation that root finding needs.
    """
    if _are_of_one(rates):
        return tuple(_single_weight(*each) for each in zip(mode, *rates, strict=True))
    return _implicit_weights(mode, rates)


def determinant(mode: Components, rates: Corners, w: Components) -> Array:
    """|det ∂(dH/dt)/∂w| of the surfaces slid on with weights w, 1 where there is none. Where that
    vanishes the weights are undetermined: at a two-fold, or where two roots meet."""
    if not _are_of_one(rates):
        return small_linear.size_of_determinant(_matrix(mode, rates, w))
    each = zip(mode, *rates, strict=True)
    sizes = [select(s == 0, 0.5 * abs(below - above), 1) for s, above, below in each]
    return ft.reduce(jnp.multiply, [v if v.ndim == 0 else jnp.prod(v) for v in sizes])


def _are_of_one(rates: Corners) -> TypeGuard[Sequence[Components]]:
    """Whether the rates of each surface are of its own two sides."""
    return not isinstance(rates, CornerTable) and len(rates) == 2


@jax.custom_jvp
def _implicit_weights(mode: Components, rates: Corners) -> Components:
    """`weights` on several surfaces. Their derivative is the implicit one, made of the weights
    themselves: derivatives of every order are exact."""
    if _are_affine(rates, len(mode)):
        return _newton(mode, rates, mode)
    root = _root_of_two(mode, rates) if len(mode) == 2 else _root_of_many(mode, rates)
    return _newton(mode, rates, root)


@_implicit_weights.defjvp
def _implicit_weights_jvp(primals: tuple, tangents: tuple) -> tuple[Components, Components]:
    (mode, rates), (_, moved) = primals, tangents
    w = _implicit_weights(mode, rates)
    change = _correction(mode, rates, w, blend(moved, mode, w))
    return w, tuple(select(s == 0, -v, 0.0) for s, v in zip(mode, change, strict=True))


def _root_of_two(mode: Components, rates: Any) -> Components:
    """A point from which one Newton iteration leads to the weights of a mode of two surfaces.

    Where both are slid on, dH_j/dt = a_j + b_j w_1 + c_j w_2 + d_j w_1 w_2 = 0 leave a quadratic
    A w_1² + B w_1 + C = 0 with the slope −det ∂(dH/dt)/∂w at its roots. The modes that go on from
    an intersection are the solutions of a variational inequality on [−1, 1]², whose indices add up
    to 1; that of a slide on both is the sign of the determinant. So where nothing else goes on one
    root lies inside, and it is the one with a positive determinant, in both directions of time.
    """
    eps = jnp.finfo(mode[0].dtype).eps
    terms = []
    for pp, pm, mp, mm in zip(*rates, strict=True):
        row = (pp + pm + mp + mm, pp + pm - mp - mm, pp - pm + mp - mm, pp - pm - mp + mm)
        scale = sum(abs(v) for v in row)
        terms.append([v / select(scale == 0, 1, scale) for v in row])
    (a1, b1, c1, d1), (a2, b2, c2, d2) = terms
    a, b, c = b2 * d1 - b1 * d2, a2 * d1 + b2 * c1 - a1 * d2 - b1 * c2, a2 * c1 - a1 * c2
    disc = b * b - 4 * a * c
    # One and the same surface, listed twice, leaves nothing but rounding.
    told = abs(disc) > (64 * eps) ** 2
    root = jnp.sqrt(jnp.maximum(disc, 0))
    w1 = _near(select(b > 0, -b - root, 2 * c), select(b > 0, 2 * a, root - b))
    low, high = c1 + d1 * w1, c2 + d2 * w1
    other = abs(high) > abs(low)
    w2 = _near(-select(other, a2 + b2 * w1, a1 + b1 * w1), select(other, high, low))
    both = (mode[0] == 0) & (mode[1] == 0) & told
    return select(both, w1, mode[0]), select(both, w2, mode[1])


def _near(a: Array, b: Array) -> Array:
    """a/b, and 0 where that is far outside of [−1, 1]: such weights are those of no slide."""
    return select(abs(a) < _FAR * abs(b), a / select(b == 0, 1, b), 0)


def _root_of_many(mode: Components, rates: Corners) -> Components:
    """The weights of a mode of three surfaces or more by Newton's method, from 0 and, until a root
    inside is found, from a point in each corner; if none is inside, that from 0."""
    m, eps = len(mode), jnp.finfo(mode[0].dtype).eps
    last = 2**m + 1

    def unsettled(state: tuple) -> Array:
        _, unsure, k = state
        return unsure & (k < (last + 1) * _NEWTON)

    def improve(state: tuple) -> tuple:
        w, _, k = state
        better = _newton(mode, rates, w)
        now = sum(abs(a - b) for a, b in zip(better, w, strict=True))
        # The step after one of √eps is rounding, of which there may be any number of eps.
        settled = now <= eps**0.5
        inside = ft.reduce(jnp.maximum, map(abs, better)) <= 1
        attempt = k // _NEWTON
        done = settled & (inside | (attempt == last))
        k = select(settled, (attempt + 1) * _NEWTON, k + 1)
        attempt = k // _NEWTON
        again = (k % _NEWTON == 0) & ~done
        size = select(attempt == last, 0.0, _START)
        corner = [select(attempt % 2 ** (j + 1) < 2**j, size, -size) for j in range(m)]
        start = tuple(select(s == 0, v, s) for s, v in zip(mode, corner, strict=True))
        return where(again, start, better), ~done, k

    start = (mode, jnp.ones((), bool), jnp.zeros((), jnp.int32))
    w, _, _ = jax.lax.while_loop(unsettled, improve, start)
    return w


def _newton(mode: Components, rates: Corners, w: Components) -> Components:
    """One Newton iteration for the weights of the surfaces slid on."""
    update = _correction(mode, rates, w, blend(rates, mode, w))
    return tuple(a - b for a, b in zip(w, update, strict=True))


def _correction(
    mode: Components, rates: Corners, w: Components, residual: Components
) -> list[Array]:
    """What Newton's method takes from the weights of the surfaces slid on, given dH/dt."""
    right = [select(s == 0, v, 0.0) for s, v in zip(mode, residual, strict=True)]
    return small_linear.solve_small(_matrix(mode, rates, w), right)


def _matrix(mode: Components, rates: Corners, w: Components) -> list[list[Array]]:
    """∂(dH_j/dt)/∂w_i of the surfaces slid on, with rows of the identity for the others."""
    slopes = [_slope(rates, mode, w, i) for i in range(len(w))]
    matrix = []
    for j, s in enumerate(mode):
        row = [select(s == 0, slopes[i][j], float(i == j)) for i in range(len(w))]
        matrix.append(row)
    return _least_of_two(mode, matrix) if len(w) == 2 else matrix


def _least_of_two(mode: Components, matrix: list[list[Array]]) -> list[list[Array]]:
    """The matrix of a slide on two surfaces. Where the field of no side moves the state off one of
    them, as in the point that a twisting controller leads to (a sliding mode of the second order),
    its row is zero and all solutions give one and the same field: the smallest is taken."""
    rows = []
    for row, (a, b) in zip(matrix, reversed(matrix), strict=True):
        free = (mode[0] == 0) & (mode[1] == 0) & (row[0] == 0) & (row[1] == 0)
        rows.append(list(where(free, (-b, a), tuple(row))))
    return rows
