"""What happens on a surface: convex combinations, the sliding weight, and the choice of a mode.

Fields on all sides of the surfaces at one point enter, with the mode of motion: per surface +1 or
−1 (on that side) or 0 (sliding). The field of the mode, its weights, and after a contact the modes
that continue the solution leave.

On several surfaces at once the field is the product-weight (Alexander–Seidman) blend of the 2^m
corner fields: with weights w in [−1, 1]^m, F(w) = Σ_s F_s Π_j (1 + s_j w_j)/2, where w_j = ±1 off
the surface and, for the surfaces slid on, w solves dH_j/dt(w) = 0. For one surface this is
Filippov's convex combination with λ = (1 + w)/2.

Where surfaces are separate (`Structure.separate`: each is switched by its own side alone, as
those of two oscillators that do not touch each other's switches), so are their weights and modes:
each is that of one surface, and two corners, all sides + and all −, say everything. Where the field
is affine in its sides (`Structure.affine`) m + 1 do: see `sliding_weights.Corners`.
"""

import functools as ft
import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.surfaces import unilateral
from jaxfil.integrate.surfaces.weights import (
    Corners,
    CornerTable,
    blend,
    every_side,
    mix,
    size_of,
    weights,
)
from jaxfil.integrate.system.components import (
    Components,
    Forcing,
    SmoothField,
    any_of,
    is_array,
    pack,
    scalars,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.moves import taken
from jaxfil.xla.select import select

# Combinations of sides at most that are written out; more are a table. One of five or fewer would
# take longer to compile.
_WRITTEN_OUT = 5


def blend_fields(
    system: ComponentSystem, fields: Corners, mode: Components, weights: Components
) -> Components:
    """`blend` of the corner fields; components that no side enters are taken as they are."""
    if isinstance(fields, CornerTable):
        return blend(fields, mode, weights)
    if system.structure.separate:
        above, below = fields
        if is_array(above):
            return _blend_arrays(system, above[0], below[0], mode, weights)
        return tuple(
            mix(mode[seen[0]], weights[seen[0]], (a,), (b,))[0] if seen else a
            for seen, a, b in zip(system.structure.switched, above, below, strict=True)
        )
    if is_array(fields[0]):
        return blend(fields, mode, weights)
    switched = [i for i, seen in enumerate(system.structure.switched) if seen]
    parts = blend([tuple(f[i] for i in switched) for f in fields], mode, weights)
    mixed = dict(zip(switched, parts, strict=True))
    return tuple(mixed.get(i, component) for i, component in enumerate(fields[0]))


def _blend_arrays(
    system: ComponentSystem, above: Array, below: Array, mode: Components, weights: Components
) -> Components:
    """The same of fields that are arrays. A number that no side enters is that of both fields."""
    if system.m == 1:
        return mix(mode[0], weights[0], (above,), (below,))
    # Any surface for a number that no side enters, but in a row with others.
    switched = enumerate(system.structure.switched)
    seen = np.array([surfaces[0] if surfaces else i % system.m for i, surfaces in switched])
    s, w = (taken(pack(v, above.dtype), seen) for v in (mode, weights))
    return mix(s, w, (above,), (below,))


def corners(
    system: ComponentSystem,
    t: Array,
    x: Components,
    alone: bool = False,
    forcing: Forcing | None = None,
) -> tuple[Corners, Corners]:
    """The field on the combinations of sides that say everything of it, and dH/dt along each;
    `alone` and `forcing` as in `ComponentSystem.field`."""

    def fields_on(*sides: Array) -> Components:
        return system.field(t, x, sides, alone, forcing)

    sides = corner_sides(system)
    if len(sides) > _WRITTEN_OUT:
        fields = jax.vmap(fields_on)(*sides.T.astype(system.dtype))
        rates = jax.vmap(lambda *f: system.rate(t, x, f))(*fields)
        return CornerTable(fields), CornerTable(rates)
    # Of numbers, not of an array: one that is known would be an argument of the kernel, and its
    # ones would not be multiplied out.
    rows = [jnp.stack([jnp.asarray(float(v), system.dtype) for v in row]) for row in sides]
    each = [fields_on(*system.of_surfaces(row)) for row in rows]
    return each, [system.rate(t, x, f) for f in each]


def corner_sides(system: ComponentSystem) -> np.ndarray:
    """The combinations of sides of `sliding_weights.Corners`, a row for each."""
    m = system.m
    if system.structure.separate:
        return np.array([[1.0] * m, [-1.0] * m])
    if system.structure.affine:
        return np.concatenate([np.ones((1, m)), 1 - 2 * np.eye(m)])
    return every_side(m)


def field(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    forcing: Forcing | None = None,
) -> Components:
    """The field of a mode, blended while it slides and held while it rests; `forcing` as in
    `ComponentSystem.field`."""
    f = free_field(system, t, x, mode, forcing)
    return unilateral.held_field(system, t, x, mode, f)[0] if system.resets else f


def free_field(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    forcing: Forcing | None = None,
) -> Components:
    """`field` without the reactions of surfaces rested on."""
    if not system.slides:
        sides = unilateral.sides_of(mode) if system.resets else mode
        return system.field(t, x, sides, True, forcing)
    fields, rates = corners(system, t, x, True, forcing)
    return blend_fields(system, fields, mode, weights(mode, rates))


class ModeField(SmoothField):
    """The field of a mode as a smooth vector field of time and state; `blended`: the mode may
    slide, `held`: it may rest. Where it is known not to, the fields of the other sides, or the
    reactions, are not computed."""

    system: ComponentSystem
    mode: Components
    blended: bool = eqx.field(static=True, default=True)
    held: bool = eqx.field(static=True, default=True)

    def __call__(self, t: Array, x: Components, forcing: Forcing | None = None) -> Components:
        if not self.blended:
            return self.system.field(t, x, self.mode, True, forcing)
        choose = field if self.held else free_field
        return choose(self.system, t, x, self.mode, forcing)

    def once(self, function: Callable, *args: Any) -> Any:
        """`ComponentSystem.once`."""
        return self.system.once(function, *args)


def guard(system: ComponentSystem, t: Array, x: Components, mode: Components) -> Components:
    """What must stay positive in a mode: ±H_j on a side, 1 − w_j² while sliding, the reaction λ_j
    at rest."""
    off = free_guard(system, t, x, mode)
    if not system.resets:
        return off
    f = free_field(system, t, x, mode)
    _, force = unilateral.held_field(system, t, x, mode, f)
    rests = unilateral.rests_of(mode)
    return tuple(select(r, v, g) for r, v, g in zip(rests, force, off, strict=True))


def free_guard(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    forcing: Forcing | None = None,
) -> Components:
    """`guard` of a mode that does not rest; `forcing` as in `ComponentSystem.field`."""
    h = system.switching(t, x)
    off = tuple(s * v for s, v in zip(mode, h, strict=True))
    if not system.slides:
        return off
    _, rates = corners(system, t, x, forcing=forcing)
    w = weights(mode, rates)
    return tuple(select(s == 0, (1 - v) * (1 + v), g) for s, v, g in zip(mode, w, off, strict=True))


def _admissible(
    candidate: Components,
    rates: Corners,
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
    # Where no side moves the state off a surface, nothing but a slide on all of them stays there.
    stays = ~any_of(tuple(o & (c != 0) for o, c in zip(on, candidate, strict=True)))
    for j, c in enumerate(candidate):
        scale = size_of(rates, j)
        solved = (abs(rate[j]) <= 64 * eps * scale) & ((scale > 0) | stays)
        slides = (abs(w[j]) <= 1) & solved
        leaves = c * direction * rate[j] > least * scale
        ok = ok & (~on[j] | select(c == 0, slides, leaves))
    return ok


def choose(
    m: int,
    rates: Corners,
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
    if not isinstance(rates, CornerTable) and len(rates) == 2:
        each = [
            _choose_on_one(above, below, s, on_j, direction)
            for above, below, s, on_j in zip(*rates, mode, on, strict=True)
        ]
        return tuple(s for s, _ in each), _count_of_all([count for _, count in each])
    # One after the other: side by side they would be arrays of 3^m numbers in the loop's body.
    candidates = np.array(list(itertools.product((1.0, -1.0, 0.0), repeat=m)), direction.dtype)

    def test(found: tuple[Components, Array], row: Array) -> tuple[tuple[Components, Array], None]:
        chosen, count = found
        candidate = scalars(row)
        ok = _admissible(candidate, rates, mode, on, direction, least)
        chosen = where(ok & (count == 0), candidate, chosen)
        return (chosen, count + ok.astype(jnp.int32)), None

    start = (mode, jnp.zeros((), jnp.int32))
    found, _ = jax.lax.scan(test, start, jnp.asarray(candidates))
    return found


def _count_of_all(counts: list[Array]) -> Array:
    """The number of admissible modes, given that of each surface; of surfaces that are one array no
    more than 1, 0 and more are told apart."""
    if counts[0].ndim:
        return select(jnp.min(counts[0]) > 0, jnp.max(counts[0]), 0)
    return ft.reduce(jnp.multiply, counts, jnp.ones((), jnp.int32))


def _choose_on_one(
    above: Array, below: Array, mode: Array, on: Array, direction: Array
) -> tuple[Array, Array]:
    """`choose` on a single surface, where the rates on its two sides say it all."""
    plus, minus = direction * above > 0, direction * below < 0
    slide = (above * below <= 0) & (above != below)
    count = plus.astype(jnp.int32) + minus.astype(jnp.int32) + slide.astype(jnp.int32)
    side = select(plus, 1.0, select(minus, -1.0, 0.0)).astype(direction.dtype)
    return select(on & (count > 0), side, mode), select(on, count, 1)
