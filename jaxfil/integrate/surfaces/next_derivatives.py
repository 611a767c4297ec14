"""The second and third derivatives of H, by which a motion leaves a surface where the first vanish.

After a time s a motion on a surface has H = s ψ + s² a/2 + s³ b/6 + …, with ψ = dH/dt, a = dψ/dt
and b = da/dt along the field of its side. The first of them that is not zero decides.

H or the field may have a kink. An example is the switching curve x + v|v|/2 = 0 of a time-optimal
controller, at v = 0. There, and within rounding of it, the motion has another a just after. In such
systems a and b are taken a moment later along the field, on the side of the kink to which the
motion goes, and a from there back to the kink.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.surfaces.corners import (
    Corners,
    are_coupled,
    corner_sides,
    every_side,
    on_corners,
)
from jaxfil.integrate.surfaces.unilateral import accelerations
from jaxfil.integrate.system.components import Components, sign, where
from jaxfil.integrate.system.lowered import ComponentSystem


def second_derivatives(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    on: Components,
    moment: Array,
) -> Corners:
    """a along the field on the combinations of sides that determine it, of the surfaces that the
    state is `on`, with the sides of the others in `mode`; beside kinks a `moment` later."""

    def second(sides: Components) -> Components:
        f = system.field(t, x, sides)
        if not system.structure.kinked:
            return accelerations(system, t, x, sides, f)
        # From two later moments back to this one, so that a has its rounding alone.
        later = (t + moment, x + moment * f), (t + 2 * moment, x + 2 * moment * f)
        one, two = (accelerations(system, *at, sides, system.field(*at, sides)) for at in later)
        return 2 * one - two

    return _on_sides(second, system, mode, on)


def _on_sides(
    function: Callable[[Components], Any], system: ComponentSystem, mode: Components, on: Components
) -> Any:
    """A vector, or several, on the combinations of sides that determine a field."""
    if system.m == 1 or are_coupled(system):
        return on_corners(function, system, corner_sides(system))
    # Rates of separate surfaces do not depend on each other's sides, but their derivatives may.
    above, below = (function(where(on, side, mode)) for side in (1.0, -1.0))
    return jax.tree.map(
        lambda *rows: Corners(rows), above, below, is_leaf=lambda v: isinstance(v, Components)
    )


def three_derivatives(
    system: ComponentSystem, t: Array, x: Components, moment: Array, sides: Components
) -> tuple[Components, Components, Components, Components]:
    """The field of some sides, and ψ, a and b along it; beside kinks a and b a `moment` later."""

    def along(t: Array, x: Components) -> tuple[Array, Components]:
        return jnp.ones_like(t), system.field(t, x, sides)

    def first(t: Array, x: Components) -> Components:
        return system.rate(t, x, along(t, x)[1])

    def two(t: Array, x: Components) -> tuple[Components, Components]:
        return jax.jvp(first, (t, x), along(t, x))

    f = system.field(t, x, sides)
    if not system.structure.kinked:
        (rate, second), (_, third) = jax.jvp(two, (t, x), along(t, x))
        return f, rate, second, third
    later = t + moment, x + moment * f
    (_, second), (_, third) = jax.jvp(two, later, along(*later))
    return f, system.rate(t, x, f), second - moment * third, third


def on_every_side(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    on: Components,
    moment: Array,
) -> tuple[Corners, ...]:
    """`three_derivatives` on every combination of sides, since the higher ones are not affine in
    the sides even if the field is; for separate surfaces as in `second_derivatives`."""
    # One program for all combinations, since it contains third derivatives of the field.
    found = ft.partial(three_derivatives, system, t, x, moment)
    if system.structure.separate:
        return _on_sides(found, system, mode, on)
    sides = every_side(system.m)
    tables = [Corners.table(v) for v in jax.vmap(found)(Components(sides.T.astype(system.dtype)))]
    if system.m > 2:
        return (*tables,)
    return tuple(Corners(table[k] for k in range(len(sides))) for table in tables)


def next_of(second: Components, third: Components, direction: Array) -> Components:
    """a, or where it vanishes a number with the sign that it has just after."""
    # s² is positive and s³ has the sign of the direction of time.
    return where(second != 0, second, direction * sign(third))
