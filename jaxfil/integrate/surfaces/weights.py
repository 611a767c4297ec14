"""Sliding weights: the weights at which the blend of the fields is tangent to the surfaces.

They solve dH/dt(w) = 0 on the sliding surfaces, given the rates dH/dt along the fields on all sides
(`Corners`) and the mode. During a slide they are in [−1, 1].
"""

import functools as ft
import itertools
import operator
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.surfaces.reactions import Forces, answered, held
from jaxfil.integrate.system.components import Components, largest, on_each, pack, total, where
from jaxfil.xla import small_linear
from jaxfil.xla.select import select

# The largest number of Newton iterations for the weights of an intersection, from one start.
_NEWTON = 20
# Distance from 0 of the starts of Newton's method after the start at 0 has failed.
_START = 0.6
# Weights beyond this belong neither to a slide nor to its continuation beyond the end.
_FAR = 1e3
# Rounding of the directions of rows, in eps.
_PARALLEL = 64


@jax.custom_jvp
def _single_weight(s: Array, above: Array, below: Array) -> Array:
    """The weight of one surface: (below + above)/(below − above) where s = 0, else s. Its
    derivative is defined as zero off the surface, where one side may be NaN, and where both rates
    are equal."""
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

    `rates` are dH_j/dt along the fields of the corners. The solution may lie outside [−1, 1];
    beyond the end of a slide it is the smooth continuation that root finding needs.
    """
    if rates.are_of_one:
        return on_each(_single_weight, mode, rates[0], rates[1])
    return _implicit_weights(mode, rates)


def held_together(
    known: Forces, rates: Corners, mode: Components, rests: Components
) -> tuple[Corners, Corners, Corners]:
    """`reactions.held`, for a mode that slides or is on its sides where it does not rest.

    If the field takes reactions, these differ between combinations of sides. The held fields blend
    to the motion's field, with its reactions. Friction weights, from −1 to 1, are defined by the
    fields that have these same reactions on all sides.
    """
    held_rates, accelerations, force = held(known, rates, rests)
    if known.of_corners is None:
        return held_rates, accelerations, force
    one = force.blend(mode, weights(mode, held_rates))
    force = force.all_of(one)
    return (*answered(known, rates, force), force)


def determinant(mode: Components, rates: Corners, w: Components) -> Array:
    """|det ∂(dH/dt)/∂w| over the sliding surfaces with weights w; 1 without sliding. The weights
    are undetermined where it vanishes, at a two-fold or where two roots merge."""
    if not rates.are_of_one:
        slid = (mode == 0).parts[0] if mode.is_array else None
        matrix, _ = _equations(mode, rates, w, mode)
        return small_linear.size_of_determinant(matrix, slid)
    # For separate surfaces ∂(dH_j/dt)/∂w_j = (r₊ − r₋)/2 is the only entry of its row.
    sizes = where(mode == 0, 0.5 * abs(rates[1] - rates[0]), 1)
    return ft.reduce(jnp.multiply, [v if v.ndim == 0 else jnp.prod(v) for v in sizes.parts])


def response(mode: Components, rates: Corners, change: Components) -> Components:
    """The change of the weights of a mode that changes dH/dt by `change` on the sliding surfaces; 0
    where the weights are undetermined."""
    slides = mode == 0
    if rates.are_of_one:
        slope = 0.5 * (rates[0] - rates[1])
        slides = slides & (slope != 0)
        return where(slides, change / where(slides, slope, 1), 0.0)
    w = weights(mode, rates)
    slides = slides & (determinant(mode, rates, w) > 0)
    # Where weights are undetermined the matrix is singular. With a side in place of the slide it
    # has a row of the identity.
    mode = where(slides, mode, 1.0)
    return where(slides, _change(mode, rates, w, change), 0.0)


@jax.custom_jvp
def _implicit_weights(mode: Components, rates: Corners) -> Components:
    """`weights` on several surfaces. Their derivative is the implicit one, a function of the
    weights themselves, so that derivatives of every order are exact."""
    m = mode.size
    if rates.flipped is not None:  # affine: Newton's method takes one step
        return _newton(mode, rates, mode)
    root = _root_of_two(mode, rates) if m == 2 else _root_of_many(mode, rates)
    return _newton(mode, rates, root)


@_implicit_weights.defjvp
def _implicit_weights_jvp(primals: tuple, tangents: tuple) -> tuple[Components, Components]:
    (mode, rates), (_, moved) = primals, tangents
    w = _implicit_weights(mode, rates)
    # The change of dH/dt at constant weights must be cancelled by a change of the weights.
    change = _change(mode, rates, w, moved.blend(mode, w, fixed=True))
    return w, where(mode == 0, -change, 0.0)


def _root_of_two(mode: Components, rates: Corners) -> Components:
    """A point from which one Newton iteration gives the weights of a mode of two surfaces.

    If both slide, dH_j/dt = a_j + b_j w_1 + c_j w_2 + d_j w_1 w_2 = 0 gives a quadratic
    A w_1² + B w_1 + C = 0 with the slope −det ∂(dH/dt)/∂w at its roots. The modes that continue
    from an intersection are the solutions of a variational inequality on [−1, 1]², whose indices
    add up to 1; the index of a slide on both is the sign of the determinant. If no other mode
    continues, one root therefore lies inside, and it is the one with a positive determinant, in
    both directions of time.
    """
    first, second = mode.parts
    eps = jnp.finfo(first.dtype).eps
    terms = []
    # a, b, c, d of each surface from the rates on the four corners, scaled, so that their rounding
    # is a multiple of eps.
    for pp, pm, mp, mm in zip(*(rates[k].parts for k in range(4)), strict=True):
        row = (pp + pm + mp + mm, pp + pm - mp - mm, pp - pm + mp - mm, pp - pm - mp + mm)
        scale = sum(abs(v) for v in row)
        terms.append([v / select(scale == 0, 1, scale) for v in row])
    (a1, b1, c1, d1), (a2, b2, c2, d2) = terms
    a, b, c = b2 * d1 - b1 * d2, a2 * d1 + b2 * c1 - a1 * d2 - b1 * c2, a2 * c1 - a1 * c2
    disc = b * b - 4 * a * c
    # For one surface listed twice the discriminant is only rounding.
    told = abs(disc) > (64 * eps) ** 2
    root = jnp.sqrt(jnp.maximum(disc, 0))
    # The root with the positive determinant is (−b − root)/2a, by the formula that does not cancel.
    w1 = _near(select(b > 0, -b - root, 2 * c), select(b > 0, 2 * a, root - b))
    # The other weight, from the equation in which its coefficient is larger.
    low, high = c1 + d1 * w1, c2 + d2 * w1
    other = abs(high) > abs(low)
    w2 = _near(-select(other, a2 + b2 * w1, a1 + b1 * w1), select(other, high, low))
    both = (first == 0) & (second == 0) & told
    return where(both, Components([w1, w2]), mode)


def _near(a: Array, b: Array) -> Array:
    """a/b, or 0 where it is far outside [−1, 1] and thus belongs to no slide."""
    return select(abs(a) < _FAR * abs(b), a / select(b == 0, 1, b), 0)


def _root_of_many(mode: Components, rates: Corners) -> Components:
    """The weights of a mode of three or more surfaces by Newton's method, from 0 and, until a root
    inside is reached, from a point in each corner; if all are outside, the root reached from 0."""
    m, eps = mode.size, jnp.finfo(mode.parts[0].dtype).eps
    last = 2**m + 1

    def unsettled(state: tuple) -> Array:
        # `k` counts iterations, `_NEWTON` for each attempt. Attempt 0 starts at w = 0, the next 2^m
        # start in the corners, and the last starts at 0 again, to accept a root outside.
        _, unsure, k = state
        return unsure & (k < (last + 1) * _NEWTON)

    def improve(state: tuple) -> tuple:
        w, _, k = state
        better = _newton(mode, rates, w)
        # Convergence is quadratic, so the step after one of √eps is only rounding, whose size in
        # eps is unknown.
        settled = total(abs(better - w)) <= eps**0.5
        inside = largest(abs(better)) <= 1
        attempt = k // _NEWTON
        done = settled & (inside | (attempt == last))
        k = select(settled, (attempt + 1) * _NEWTON, k + 1)
        attempt = k // _NEWTON
        again = (k % _NEWTON == 0) & ~done
        size = select(attempt == last, 0.0, _START)
        corner = [select(attempt % 2 ** (j + 1) < 2**j, size, -size) for j in range(m)]
        corners = Components([jnp.stack(corner)] if mode.is_array else corner)
        start = where(mode == 0, corners, mode)
        return where(again, start, better), ~done, k

    # The mode is the first start, with 0 on slides and the sides ±1 elsewhere.
    start = (mode, jnp.ones((), bool), jnp.zeros((), jnp.int32))
    w, _, _ = jax.lax.while_loop(unsettled, improve, start)
    return w


def _newton(mode: Components, rates: Corners, w: Components) -> Components:
    """One Newton iteration for the weights of the sliding surfaces."""
    return w - _correction(mode, rates, w, rates.blend(mode, w))


def _correction(
    mode: Components, rates: Corners, w: Components, residual: Components
) -> Components:
    """Newton's correction of the weights of the sliding surfaces, given dH/dt."""
    # Other surfaces have the equation Δw = 0, so that all lanes solve systems of one size.
    matrix, right = _equations(mode, rates, w, where(mode == 0, residual, 0.0))
    if isinstance(matrix, jax.Array):
        found = small_linear.solve(matrix, right.parts[0][:, None], (mode == 0).parts[0])
        return Components([found[:, 0]])
    [found] = small_linear.solve_small(matrix, [right.parts])
    return Components(found)


def _change(mode: Components, rates: Corners, w: Components, moved: Components) -> Components:
    """`_correction` for a tangent of dH/dt, in which it is linear for reverse mode too."""
    if w.size <= 2 and not mode.is_array:  # written out, without a loop
        return _correction(mode, rates, w, moved)
    matrix, right = _equations(mode, rates, w, where(mode == 0, moved, 0.0))
    slid = (mode == 0).parts[0] if mode.is_array else None
    found = small_linear.inverse(matrix, slid) @ pack(right, float)
    return Components([found] if mode.is_array else list(found))


def is_governed(mode: Components, rates: Corners, w: Components, noise: Components) -> Components:
    """Whether a weight, of a sliding surface or its own, can change dH_j/dt beyond rounding."""
    slopes = _slopes(mode, rates, w)
    if isinstance(slopes, jax.Array):
        counted = (mode == 0).parts[0][None, :] | jnp.eye(w.size, dtype=bool)
        known = jnp.sum(select(counted, abs(slopes), 0.0), axis=1)
        return Components([known > noise.parts[0]])
    found = []
    for j, row in enumerate(slopes):
        each = enumerate(zip(mode.parts, row, strict=True))
        known = sum(abs(v) if i == j else select(s == 0, abs(v), 0.0) for i, (s, v) in each)
        found.append(known > noise.parts[j])
    return Components(found)


def governs(
    mode: Components, rates: Corners, w: Components, noise: Components, others: Components
) -> Components:
    """Whether the weight of surface j changes the rate of another one among `others`."""
    slopes = _slopes(mode, rates, w)
    if isinstance(slopes, jax.Array):
        changed = (abs(slopes) > noise.parts[0][:, None]) & others.parts[0][:, None]
        return Components([jnp.any(changed & ~jnp.eye(w.size, dtype=bool), axis=0)])
    found = []
    for j in range(w.size):
        rows = enumerate(zip(slopes, noise.parts, others.parts, strict=True))
        each = [on & (abs(row[j]) > least) for i, (row, least, on) in rows if i != j]
        found.append(ft.reduce(operator.or_, each))
    return Components(found)


def _slopes(mode: Components, rates: Corners, w: Components) -> Array | list[tuple[Array, ...]]:
    """∂(dH_j/dt)/∂w_i in row j, as an array for surfaces that are one."""
    m = w.size
    if mode.is_array and rates.flipped is not None:
        return rates.slopes()
    each = [rates.slope(mode, w, i).parts for i in range(m)]
    if mode.is_array:
        return jnp.stack([column for (column,) in each], axis=1)
    return list(zip(*each, strict=True))


def _equations(
    mode: Components, rates: Corners, w: Components, right: Components
) -> tuple[Array | list[list[Array]], Components]:
    """The equations for changes of the weights of the sliding surfaces: ∂(dH_j/dt)/∂w_i, and right
    sides, of which those of ties are zero. Other surfaces have rows of the identity.

    Where equations are missing, all solutions give the same field. Weights are tied then, such that
    a slide ends when no solution is left.

    - No side moves the state off a surface, as of x in x″ = f − g sgn x − h sgn x′ at rest (or at
      the point to which a twisting controller converges, a sliding mode of the second order). Its
      row is zero. Its weight is then twice those of the surfaces which it moves, here x′, so that
      it ends first and these hold to the end.
    - Rows of two surfaces are parallel, as of two brakes on one disc. They share the load such that
      both reach their limits at the same time.
    """
    if mode.is_array:
        matrix, ties = _tied_array(mode, rates, w)
        return matrix, where(ties, 0.0, right)
    slopes, m = _slopes(mode, rates, w), w.size
    flags, eps = [s == 0 for s in mode.parts], float(jnp.finfo(mode.parts[0].dtype).eps)
    known = []
    for row in slopes:
        # What is left of a slope that a reaction cancels is rounding, and ties no weight.
        least = _PARALLEL * eps * ft.reduce(jnp.maximum, map(abs, row))
        each = zip(flags, row, strict=True)
        known.append([select(flag & (abs(v) > least), v, 0.0) for flag, v in each])
    rows, ties = [], []
    for j, (slid, row) in enumerate(zip(flags, slopes, strict=True)):
        free = ~ft.reduce(operator.or_, (v != 0 for v in known[j]))
        moved = [select(flags[i], jnp.sign(slopes[i][i]) * known[i][j], 0.0) for i in range(m)]
        moved[j] = -0.5 * ft.reduce(jnp.add, (abs(v) for i, v in enumerate(moved) if i != j))
        made, tied = [select(free, v, u) for v, u in zip(moved, row, strict=True)], free
        # With the first of several surfaces whose rows are parallel.
        for i in reversed(range(j)):
            same = flags[i] & ~free & _are_parallel(known[i], known[j])
            share = dict(zip((i, j), _share(known[i][i], known[i][j]), strict=True))
            made = [select(same, share.get(k, 0.0), v) for k, v in enumerate(made)]
            tied = tied | same
        rows.append([select(slid, v, float(i == j)) for i, v in enumerate(made)])
        ties.append(slid & tied)
    return rows, where(Components(ties), 0.0, right)


def _are_parallel(a: Sequence[Array], b: Sequence[Array]) -> Array:
    """Whether two rows differ by a factor, to rounding; not if the first is zero."""
    eps, same = float(jnp.finfo(a[0].dtype).eps), ft.reduce(operator.or_, (v != 0 for v in a))
    for k, q in itertools.combinations(range(len(a)), 2):
        up, down = a[k] * b[q], a[q] * b[k]
        same = same & (abs(up - down) <= _PARALLEL * eps * (abs(up) + abs(down)))
    return same


def _share(first: Array, own: Array) -> tuple[Array, Array]:
    """The tie of two weights, given their slopes in an equation that both are in: equal shares of
    their limits. A weight that is not in it is zero."""
    alone = (first == 0) | (own == 0)
    by_first = select(alone, select(own == 0, 0.0, 1.0), jnp.sign(first))
    return by_first, select(alone, select(own == 0, 1.0, 0.0), -jnp.sign(own))


def _parallel_rows(rows: Array, there: Array) -> tuple[Array, Array]:
    """Whether each row, among those `there`, differs by a factor from an earlier one, to rounding,
    and the first such one."""
    m, eps = len(rows), float(jnp.finfo(rows.dtype).eps)
    # Parallel rows of one length along a generic vector are equal, and so is their length along
    # another one. This takes m² operations, where comparing all pairs would take m³.
    along = jnp.sum(rows * (1.5 + np.cos(np.arange(m))).astype(rows.dtype), axis=1)
    scaled = rows / select(along == 0, 1.0, along)[:, None]
    place = jnp.sum(scaled * np.sin(1.0 + np.arange(m)).astype(rows.dtype), axis=1)
    sizes = abs(place[:, None]) + abs(place[None, :])
    close = abs(place[:, None] - place[None, :]) <= eps**0.5 * sizes
    same = close & there[:, None] & there[None, :] & np.tri(m, k=-1, dtype=bool)
    first = jnp.argmax(same, axis=1)
    apart = jnp.max(abs(scaled - scaled[first]), axis=1)
    near = apart <= _PARALLEL * eps * jnp.max(abs(scaled), axis=1)
    return jnp.any(same, axis=1) & near, first


def _tied_array(mode: Components, rates: Corners, w: Components) -> tuple[Array, Components]:
    """The matrix of `_equations`, and flags of its ties, for surfaces that are one array."""
    slopes, m = _slopes(mode, rates, w), w.size
    assert isinstance(slopes, jax.Array)
    (slid,) = (mode == 0).parts
    one = jnp.eye(m, dtype=slopes.dtype)
    # What is left of a slope that a reaction cancels is rounding, and ties no weight.
    least = _PARALLEL * float(jnp.finfo(one.dtype).eps) * jnp.max(abs(slopes), axis=1)
    known = select(slid[None, :] & (abs(slopes) > least[:, None]), slopes, 0.0)
    free = jnp.max(abs(known), axis=1) == 0
    # In row j, ∂(dH_i/dt)/∂w_j of the other surfaces, with the sign that each has of its own.
    signed = jnp.sign(jnp.diag(slopes))[:, None] * known
    tie = select(slid[:, None] & (one == 0), signed, 0.0).T
    tie = tie - 0.5 * jnp.sum(abs(tie), axis=1)[:, None] * one
    matrix = select(free[:, None], tie, slopes)
    shared, first = _parallel_rows(known, slid & ~free)
    row = known[first]
    at_first, at_own = _share(row[jnp.arange(m), first], jnp.diag(row))
    share = at_first[:, None] * one[first] + at_own[:, None] * one
    matrix = select(shared[:, None], share, matrix)
    return select(slid[:, None], matrix, one), Components([slid & (free | shared)])
