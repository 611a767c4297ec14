"""The second and third derivatives of H, by which a motion leaves a surface where the first vanish.

After a time s a motion on a surface has H = s ψ + s² a/2 + s³ b/6 + …, with ψ = dH/dt, a = dψ/dt
and b = da/dt along the field of its side. The first of them that is not zero decides.
"""

import functools as ft

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.surfaces.corners import Corners, corner_sides, every_side, on_corners
from jaxfil.integrate.surfaces.unilateral import accelerations
from jaxfil.integrate.system.components import Components, sign, where
from jaxfil.integrate.system.lowered import ComponentSystem


def second_derivatives(system: ComponentSystem, t: Array, x: Components) -> Corners:
    """a along the field on the combinations of sides that determine it."""

    def second(sides: Components) -> Components:
        return accelerations(system, t, x, sides, system.field(t, x, sides))

    return on_corners(second, system, corner_sides(system))


def three_derivatives(
    system: ComponentSystem, t: Array, x: Components, sides: Components
) -> tuple[Components, Components, Components, Components]:
    """The field of some sides, and ψ, a and b along it."""

    def along(t: Array, x: Components) -> tuple[Array, Components]:
        return jnp.ones_like(t), system.field(t, x, sides)

    def first(t: Array, x: Components) -> Components:
        return system.rate(t, x, along(t, x)[1])

    def two(t: Array, x: Components) -> tuple[Components, Components]:
        return jax.jvp(first, (t, x), along(t, x))

    (rate, second), (_, third) = jax.jvp(two, (t, x), along(t, x))
    return along(t, x)[1], rate, second, third


def on_every_side(system: ComponentSystem, t: Array, x: Components) -> tuple[Corners, ...]:
    """`three_derivatives` on every combination of sides, since the higher ones are not affine in
    the sides even if the field is."""
    # One program for all combinations, since it contains third derivatives of the field.
    found = ft.partial(three_derivatives, system, t, x)
    if system.structure.separate:
        return on_corners(found, system, corner_sides(system))
    sides = every_side(system.m)
    tables = [Corners.table(v) for v in jax.vmap(found)(Components(sides.T.astype(system.dtype)))]
    if system.m > 2:
        return (*tables,)
    return tuple(Corners(table[k] for k in range(len(sides))) for table in tables)


def next_of(second: Components, third: Components, direction: Array) -> Components:
    """a, or where it vanishes a number with the sign that it has just after."""
    # s² is positive and s³ has the sign of the direction of time.
    return where(second != 0, second, direction * sign(third))
