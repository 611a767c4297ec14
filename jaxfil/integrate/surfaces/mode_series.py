"""Power series of the field and the guards of a mode.

The formulas are those in `filippov`: on a side F and ±H, on a slide the blend of the fields of both
sides with the weight w = (r₋ + r₊)/(r₋ − r₊), r± = dH/dt along F±, and 1 − w². The mode of a lane
is constant within a step.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.steppers.taylor import solved
from jaxfil.integrate.surfaces import unilateral
from jaxfil.integrate.system.components import Components, scalars
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.integrate.system.squares import squared_series
from jaxfil.xla.select import select
from jaxfil.xla.series import (
    Expansion,
    Series,
    kept,
    product,
    quotient,
    reduced_difference,
    sum_of,
)
from jaxfil.xla.series_program import array_of, scalars_of

# The largest array state of which each number is a series of its own.
_FEW = 12


def slides_have_series(system: ComponentSystem) -> bool:
    """Whether slides of a system have power series. Each weight must belong to one surface, and
    each number of a state must be a series."""
    by_number = not system.as_array or _is_spelled(system)
    return system.structure.separate and not system.packed and by_number


def _is_spelled(system: ComponentSystem) -> bool:
    """Whether each number of a state that is one array is a series of its own."""
    return system.as_array and system.n <= _FEW


def polynomial(
    system: ComponentSystem,
    order: int,
    blended: bool,
    t: Array,
    x: Components,
    h: Array,
    mode: Components,
    kinks: bool = False,
) -> Polynomial:
    """The polynomial of a step of length h from (t, x) in a mode, which slides only if
    `blended`; perhaps with the `kinks` of the field."""
    system = system.in_mode(mode)
    expansion = system.expansion()
    spelled = _is_spelled(system)

    def functions(time: Series, states: list[Series]) -> tuple[list[Series], list[Series]]:
        fields, guards = terms(time, states)
        return squared_series(system.squares, expansion, fields, system.n), guards

    def terms(time: Series, states: list[Series]) -> tuple[list[Series], list[Series]]:
        if blended:
            return _of_slide(system, expansion, time, states, mode)
        sides = unilateral.sides_of(mode) if system.resets else mode
        fields = _field(system, expansion, time, states, sides)
        before = expansion.num_kept
        guards = _off(system, expansion, time, states, sides)
        if expansion.num_kept > before:  # H itself has operations whose series are stored
            kept(*guards)
        return fields, guards

    once = _plainly if system.compact else system.once
    start = Components(scalars(x.parts[0])) if spelled else x
    made = solved(once, expansion, functions, order, (t, start, h), mode, kinks)
    if not spelled:
        return made
    # The loop carries the state as one array, so each coefficient becomes one again.
    rows = tuple(Components([jnp.stack(c.parts)]) for c in made.x)
    return eqx.tree_at(lambda v: v.x, made, rows)


def _state(system: ComponentSystem, states: list[Series]) -> list[Any]:
    """Series of numbers in the form in which the system's functions take a state."""
    if not _is_spelled(system):
        return states
    whole = np.empty(len(states), object)
    whole[:] = states
    return [whole]


def _numbers(system: ComponentSystem, expansion: Expansion, values: list[Any]) -> list[Series]:
    """Series of the numbers that the system's functions return for a state."""
    if _is_spelled(system):
        return list(scalars_of(expansion, values[0], (system.n,)))
    return [array_of(expansion, v) for v in values]


def _field(
    system: ComponentSystem,
    expansion: Expansion,
    t: Series,
    x: list[Series],
    sides: Components,
) -> list[Series]:
    """Series of F(t, x, sides), number by number."""
    values = system.expanded_field(expansion, t, _state(system, x), sides)
    return _numbers(system, expansion, values)


def _plainly(function: Callable, *args: Any) -> Any:
    """`function(*args)` without a fence. In compact programs XLA's recomputation costs less than
    fences would."""
    return function(*args)


def _off(
    system: ComponentSystem, expansion: Expansion, t: Series, x: list[Series], sides: Components
) -> list[Series]:
    """±H."""
    if system.m == 0:
        return []
    h = [array_of(expansion, v) for v in system.expanded_switching(expansion, t, _state(system, x))]
    return [
        product(expansion, expansion.constant(s), v) for s, v in zip(sides.parts, h, strict=True)
    ]


def _of_slide(
    system: ComponentSystem, expansion: Expansion, t: Series, x: list[Series], mode: Components
) -> tuple[list[Series], list[Series]]:
    """Series of the field and the guards of a mode that may slide."""
    one = jnp.ones_like(t[0])
    # Separate surfaces have two corners, all sides + and all sides −.
    sides = [system.for_each_surface(sign * one) for sign in (1.0, -1.0)]
    above, below = (_field(system, expansion, t, x, s) for s in sides)
    rise, fall = (_rates(system, expansion, t, x, f) for f in (above, below))
    weights = [_weight(expansion, s, a, b) for s, a, b in zip(mode.parts, rise, fall, strict=True)]
    fields = []
    structure = system.structure
    each = zip(structure.switched, structure.alone, above, below, strict=True)
    for owners, alone, up, down in each:
        if not owners:
            # The number is not switched, so both sides agree in it.
            fields.append(up)
            continue
        # Surfaces with series are separate, so a number has one owner (`slides_have_series`).
        s, w = mode.parts[owners[0]], weights[owners[0]]
        fields.append(_blend(expansion, s, w, up, down, still=alone == owners[0]))
    off = _off(system, expansion, t, x, mode)
    guards = [_guard(expansion, s, w, g) for s, w, g in zip(mode.parts, weights, off, strict=True)]
    return fields, guards


def _rates(
    system: ComponentSystem, expansion: Expansion, t: Series, x: list[Series], f: list[Series]
) -> list[Series]:
    """Series of dH/dt along a field."""
    state, along = _state(system, x), _state(system, f)
    return [array_of(expansion, v) for v in system.expanded_rate(expansion, t, state, along)]


def _weight(expansion: Expansion, s: Array, rise: Series, fall: Series) -> Series:
    """The weight of a slide; an arbitrary value without a slide."""
    gap = reduced_difference(expansion, fall, rise)

    def apart(k: int) -> Array | None:
        # If both fields have the same rate across the surface, there is no weight and no slide; a
        # divisor of 1 keeps the unused quotient finite.
        return gap[k] if k > 0 else select((s == 0) & (gap[0] != 0), gap[0], 1)

    below = expansion.series(apart, gap.degree)
    return quotient(expansion, sum_of(expansion, [fall, rise]), below)


def _blend(
    expansion: Expansion, s: Array, w: Series, up: Series, down: Series, still: bool
) -> Series:
    """The blended field of both sides, tangent to the surface, or the field of the current side.
    It is exactly zero for a number that a slide keeps `still`, since a root of zero has no series
    where rounding moves it."""
    half = expansion.constant(0.5)
    share = product(expansion, half, sum_of(expansion, [expansion.constant(1.0), w]))
    apart = product(expansion, share, reduced_difference(expansion, up, down))
    mixed = None if still else sum_of(expansion, [down, apart])

    def make(k: int) -> Array | None:
        parts = [None if v is None else v[k] for v in (mixed, up, down)]
        # A structural zero stays one, and operations on it are omitted.
        if all(v is None for v in parts):
            return None
        both, one, other = (jnp.zeros_like(s) if v is None else v for v in parts)
        return select(s == 0, both, select(s > 0, one, other))

    return expansion.series(make)


def _guard(expansion: Expansion, s: Array, w: Series, off: Series) -> Series:
    """1 − w² for a slide, else ±H."""
    square = product(expansion, w, w)

    def make(k: int) -> Array:
        # 1 − w² cancels near w = ±1 in order 0. This is harmless, since the search takes orders 0
        # and 1 from the guards of the loop (`path.guards_of`).
        squared, beside = (jnp.zeros_like(s) if v[k] is None else v[k] for v in (square, off))
        return select(s == 0, (1.0 - squared) if k == 0 else -squared, beside)

    out = expansion.series(make)
    kept(out)
    return out
