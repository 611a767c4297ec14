"""What happens on a surface: convex combinations, the sliding weight, and the choice of a mode.

Fields on all sides of the surfaces at one point enter, with the mode of motion: per surface +1 or
−1 (on that side) or 0 (sliding). The field of the mode, its weights, and after a contact the modes
that continue the solution leave.

On several surfaces at once the field is the product-weight (Alexander–Seidman) blend of the 2^m
corner fields: with weights w in [−1, 1]^m, F(w) = Σ_s F_s Π_j (1 + s_j w_j)/2, where w_j = ±1 off
the surface and, for the surfaces slid on, w solves dH_j/dt(w) = 0. For one surface this is
Filippov's convex combination with λ = (1 + w)/2.

Where surfaces are separate (`ComponentSystem.separate`: each is switched by its own side alone, as
those of two oscillators that do not touch each other's switches), so are their weights and modes:
each is that of one surface, and two corners, all sides + and all −, say everything.
"""

import dataclasses
import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.components import (
    Components,
    ComponentSystem,
    Forcing,
    SmoothField,
    any_of,
    where,
)
from jaxfil.xla import small_linear

# Newton iterations for the weights of an intersection at most, from one start. The system is
# multi-affine: affine (one iteration) when each term of the field sees one side.
_NEWTON = 20
# The weights from which Newton's method starts if it has not found a root inside from 0.
_START = 0.6
# Weights this large are those of no slide, nor of its continuation beyond its end.
_FAR = 1e3


def _mix(s: Array, w: Array, above: Components, below: Components) -> Components:
    """The field on side s of one surface, or where s = 0 the blend of both with weight w. A side is
    taken as it is, untouched by a NaN of the other."""
    share = 0.5 * (1 + w)
    return tuple(
        jnp.where(s > 0, a, jnp.where(s < 0, b, b + share * (a - b)))
        for a, b in zip(above, below, strict=True)
    )


def blend(corners: Sequence[Components], mode: Components, weights: Components) -> Components:
    """Σ_s corners[s] Π_j (1 + s_j w_j)/2, for 2^m corners in the order of
    `ComponentSystem.corner_sides`."""
    for s, w in zip(mode, weights, strict=True):
        half = len(corners) // 2
        corners = [_mix(s, w, corners[i], corners[half + i]) for i in range(half)]
    return corners[0]


def blend_fields(
    system: ComponentSystem, fields: Sequence[Components], mode: Components, weights: Components
) -> Components:
    """`blend` of the corner fields; components that no side enters are taken as they are."""
    if system.separate:
        above, below = fields
        return tuple(
            _mix(mode[seen[0]], weights[seen[0]], (a,), (b,))[0] if seen else a
            for seen, a, b in zip(system.switched, above, below, strict=True)
        )
    switched = [i for i, seen in enumerate(system.switched) if seen]
    parts = blend([tuple(f[i] for i in switched) for f in fields], mode, weights)
    mixed = dict(zip(switched, parts, strict=True))
    return tuple(mixed.get(i, component) for i, component in enumerate(fields[0]))


def _slope(
    corners: Sequence[Components], mode: Components, weights: Components, j: int
) -> Components:
    """∂ blend/∂w_j."""
    for i, (s, w) in enumerate(zip(mode, weights, strict=True)):
        half = len(corners) // 2
        pairs = [(corners[k], corners[half + k]) for k in range(half)]
        if i == j:
            corners = [tuple(0.5 * (p - q) for p, q in zip(a, b, strict=True)) for a, b in pairs]
        else:
            corners = [_mix(s, w, a, b) for a, b in pairs]
    return corners[0]


def _safe_quotient(a: Array, b: Array) -> Array:
    """a/b, and 0 where b = 0, with finite derivatives there."""
    zero = b == 0
    return jnp.where(zero, 0, a / jnp.where(zero, 1, b))


def weights(mode: Components, rates: Sequence[Components]) -> Components:
    """The weights of a mode: ±1 off a surface, the solution of dH/dt(w) = 0 on it.

    `rates[s][j]` is dH_j/dt along the field of corner s. The solution may lie outside [−1, 1]:
    beyond the end of a slide it is the smooth continuation that root finding needs.
    """
    return weights_and_determinant(mode, rates)[0]


def weights_and_determinant(
    mode: Components, rates: Sequence[Components]
) -> tuple[Components, Array]:
    """`weights`, and |det ∂(dH/dt)/∂w| of the surfaces slid on, 1 where there is none. Where that
    vanishes the weights are undetermined: at a two-fold, or where two roots meet."""
    if len(rates) == 2:
        each = list(zip(mode, *rates, strict=True))
        w = tuple(
            jnp.where(s == 0, _safe_quotient(below + above, below - above), s)
            for s, above, below in each
        )
        sizes = [jnp.where(s == 0, 0.5 * abs(below - above), 1) for s, above, below in each]
        return w, ft.reduce(jnp.multiply, sizes)
    # A root of constants, then one differentiable iteration: its derivative is the implicit one.
    held, fixed = jax.tree.map(stop_gradient, (mode, list(rates)))
    root = _root_of_two(held, fixed) if len(mode) == 2 else _root_of_many(held, fixed)
    w, matrix = _newton(mode, rates, root)
    return w, small_linear.size_of_determinant(matrix)


def _root_of_two(mode: Components, rates: Sequence[Components]) -> Components:
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
        terms.append([v / jnp.where(scale == 0, 1, scale) for v in row])
    (a1, b1, c1, d1), (a2, b2, c2, d2) = terms
    a, b, c = b2 * d1 - b1 * d2, a2 * d1 + b2 * c1 - a1 * d2 - b1 * c2, a2 * c1 - a1 * c2
    disc = b * b - 4 * a * c
    # One and the same surface, listed twice, leaves nothing but rounding.
    told = abs(disc) > (64 * eps) ** 2
    root = jnp.sqrt(jnp.maximum(disc, 0))
    w1 = _near(jnp.where(b > 0, -b - root, 2 * c), jnp.where(b > 0, 2 * a, root - b))
    low, high = c1 + d1 * w1, c2 + d2 * w1
    other = abs(high) > abs(low)
    w2 = _near(-jnp.where(other, a2 + b2 * w1, a1 + b1 * w1), jnp.where(other, high, low))
    both = (mode[0] == 0) & (mode[1] == 0) & told
    return jnp.where(both, w1, mode[0]), jnp.where(both, w2, mode[1])


def _near(a: Array, b: Array) -> Array:
    """a/b, and 0 where that is far outside of [−1, 1]: such weights are those of no slide."""
    return jnp.where(abs(a) < _FAR * abs(b), a / jnp.where(b == 0, 1, b), 0)


def _root_of_many(mode: Components, rates: Sequence[Components]) -> Components:
    """The weights of a mode of three surfaces or more by Newton's method, from 0 and, until a root
    inside is found, from a point in each corner; if none is inside, that from 0."""
    m, eps = len(mode), jnp.finfo(mode[0].dtype).eps
    last = 2**m + 1

    def unsettled(state: tuple) -> Array:
        _, unsure, k = state
        return unsure & (k < (last + 1) * _NEWTON)

    def improve(state: tuple) -> tuple:
        w, _, k = state
        better, _ = _newton(mode, rates, w)
        now = sum(abs(a - b) for a, b in zip(better, w, strict=True))
        settled = now <= 4 * eps
        inside = ft.reduce(jnp.maximum, map(abs, better)) <= 1
        attempt = k // _NEWTON
        done = settled & (inside | (attempt == last))
        k = jnp.where(settled, (attempt + 1) * _NEWTON, k + 1)
        attempt = k // _NEWTON
        again = (k % _NEWTON == 0) & ~done
        size = jnp.where(attempt == last, 0.0, _START)
        corner = [jnp.where((attempt >> j) & 1 == 0, size, -size) for j in range(m)]
        start = tuple(jnp.where(s == 0, v, s) for s, v in zip(mode, corner, strict=True))
        return where(again, start, better), ~done, k

    start = (mode, jnp.ones((), bool), jnp.zeros((), jnp.int32))
    w, _, _ = jax.lax.while_loop(unsettled, improve, start)
    return w


def _newton(
    mode: Components, rates: Sequence[Components], w: Components
) -> tuple[Components, list[list[Array]]]:
    """One Newton iteration for the weights of the surfaces slid on, and its matrix
    ∂(dH_j/dt)/∂w_i, with rows of the identity for the other surfaces."""
    residual = blend(rates, mode, w)
    slopes = [_slope(rates, mode, w, i) for i in range(len(w))]
    matrix, right = [], []
    for j, s in enumerate(mode):
        sliding = s == 0
        right.append(jnp.where(sliding, residual[j], 0.0))
        matrix.append([jnp.where(sliding, slopes[i][j], float(i == j)) for i in range(len(w))])
    update = small_linear.solve_small(matrix, right)
    return tuple(a - b for a, b in zip(w, update, strict=True)), matrix


def corners(
    system: ComponentSystem,
    t: Array,
    x: Components,
    alone: bool = False,
    forcing: Forcing | None = None,
) -> tuple[list[Components], list[Components]]:
    """The field on the combinations of sides of `ComponentSystem.corner_sides`, and dH/dt along
    each; `alone` and `forcing` as in `ComponentSystem.field`."""
    fields = [system.field(t, x, sides, alone, forcing) for sides in system.corner_sides()]
    return fields, [system.rate(t, x, f) for f in fields]


def field(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    forcing: Forcing | None = None,
) -> Components:
    """The field of a mode, blended while it slides; `forcing` as in `ComponentSystem.field`."""
    if not system.slides:
        return system.field(t, x, mode, True, forcing)
    fields, rates = corners(system, t, x, True, forcing)
    return blend_fields(system, fields, mode, weights(mode, rates))


class ModeField(SmoothField):
    """The field of a mode as a smooth vector field of time and state; `blended`: the mode may
    slide. Where it is known not to, the fields of the other sides are not computed."""

    system: ComponentSystem
    mode: Components
    blended: bool = eqx.field(static=True, default=True)

    def __call__(self, t: Array, x: Components, forcing: Forcing | None = None) -> Components:
        if self.blended:
            return field(self.system, t, x, self.mode, forcing)
        return self.system.field(t, x, self.mode, True, forcing)

    def once(self, function: Callable, *args: Any) -> Any:
        """`ComponentSystem.once`."""
        return self.system.once(function, *args)


class _SingleField(eqx.Module):
    """The field of a mode, in the place of a system's field, which takes sides."""

    system: ComponentSystem
    mode: Components

    def __call__(
        self, t: Array, x: Components, sides: Components, alone: bool, known: Forcing | None
    ) -> Components:
        return field(self.system, t, x, self.mode, known)

    def ahead(self, t: Array) -> Forcing:
        return self.system.forcing_at(t)


def without_surfaces(system: ComponentSystem, mode: Components) -> ComponentSystem:
    """The smooth system whose field is that of one mode everywhere."""
    return dataclasses.replace(
        system,
        m=0,
        slides=False,
        resets=False,
        switched=((),) * system.n,
        separate=False,
        _field=_SingleField(system, mode),
    )


def guard(system: ComponentSystem, t: Array, x: Components, mode: Components) -> Components:
    """What must stay positive in a mode: ±H_j on a side, 1 − w_j² while sliding."""
    h = system.switching(t, x)
    off = tuple(s * v for s, v in zip(mode, h, strict=True))
    if not system.slides:
        return off
    _, rates = corners(system, t, x)
    w = weights(mode, rates)
    return tuple(
        jnp.where(s == 0, (1 - v) * (1 + v), g) for s, v, g in zip(mode, w, off, strict=True)
    )


def _admissible(
    candidate: Components,
    rates: Sequence[Components],
    mode: Components,
    on: Components,
    direction: Array,
    least: Array | float,
) -> Array:
    """Whether the solution can continue in `candidate` (±1 or 0 per surface): it must leave each
    surface it is not sliding on, to its own side, and slide with weights in [−1, 1]."""
    ok = ~any_of(tuple(~o & (a != b) for o, a, b in zip(on, mode, candidate, strict=True)))
    # The weights of what is no candidate are not looked for.
    w = weights(where(ok, candidate, tuple(map(jnp.ones_like, candidate))), rates)
    rate = blend(rates, candidate, w)
    eps = jnp.finfo(direction.dtype).eps
    for j, c in enumerate(candidate):
        scale = sum(abs(r[j]) for r in rates)
        solved = (abs(rate[j]) <= 64 * eps * scale) & (scale > 0)
        slides = (abs(w[j]) <= 1) & solved
        leaves = c * direction * rate[j] > least * scale
        ok = ok & (~on[j] | jnp.where(c == 0, slides, leaves))
    return ok


def choose(
    m: int,
    rates: Sequence[Components],
    mode: Components,
    on: Components,
    direction: Array,
    least: Array | float = 0.0,
) -> tuple[Components, Array]:
    """The mode after a contact with the surfaces marked `on`, and the number of admissible ones.

    One admissible mode: the solution is unique. Several (repelling sliding): it is not. None: a
    tangency that first derivatives do not decide. An intersection is left at a rate of more than
    `least`, relative to all rates there.
    """
    if len(rates) == 2:
        each = [
            _choose_on_one(above, below, s, on_j, direction)
            for above, below, s, on_j in zip(*rates, mode, on, strict=True)
        ]
        count: Any = jnp.ones((), jnp.int32)
        for _, count_j in each:
            count = count * count_j
        return tuple(s for s, _ in each), count
    candidates = np.array(list(itertools.product((1.0, -1.0, 0.0), repeat=m)))
    columns = tuple(jnp.asarray(column, direction.dtype) for column in candidates.T)
    ok = jax.vmap(lambda *c: _admissible(c, rates, mode, on, direction, least))(*columns)
    first = jnp.argmax(ok)
    any_ok = jnp.any(ok)
    chosen = tuple(jnp.where(any_ok, c[first], s) for c, s in zip(columns, mode, strict=True))
    return chosen, jnp.sum(ok, dtype=jnp.int32)


def _choose_on_one(
    above: Array, below: Array, mode: Array, on: Array, direction: Array
) -> tuple[Array, Array]:
    """`choose` on a single surface, where the rates on its two sides say it all."""
    plus, minus = direction * above > 0, direction * below < 0
    slide = (above * below <= 0) & (above != below)
    count = plus.astype(jnp.int32) + minus.astype(jnp.int32) + slide.astype(jnp.int32)
    side = jnp.where(plus, 1.0, jnp.where(minus, -1.0, 0.0)).astype(direction.dtype)
    return jnp.where(on & (count > 0), side, mode), jnp.where(on, count, 1)
