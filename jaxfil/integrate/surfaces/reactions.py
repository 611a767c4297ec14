"""The effect of reactions on each combination of sides.

A field that feels its reactions, such as dry friction, has another response to them on each side.
Reactions are therefore computed on each combination of sides separately. Rates and fields with
these reactions are blended as those without (see `unilateral`).
"""

import dataclasses
import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.surfaces.corners import Corners, for_each_corner
from jaxfil.integrate.surfaces.unilateral import (
    Constraints,
    Response,
    accelerations,
    constraints,
    felt_response,
    multipliers,
    multipliers_of_each,
    sides_of,
)
from jaxfil.integrate.system.components import Components, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.rows import Rows

# Residual of terms that cancel, in eps of their sizes.
_CANCELLED = 64


class Forces(eqx.Module):
    """The effect of reactions on the rates of all surfaces, at one state."""

    response: Response
    """The response on the sides of the mode."""
    of_corners: tuple[Response, ...] | None
    """The response on each combination of sides, one by one or as the rows of arrays; None if it is
    the same on all."""
    normals: Rows
    """∇H_i, n numbers each."""
    pushes: Rows
    """∇H_i·d_j of the response, m numbers each."""
    accelerations: Corners
    """dψ/dt, m numbers, along the field on each combination of sides."""

    def each(self, function: Callable[..., Components], *corners: Corners) -> Corners:
        """`function` of the response and of whole vectors, on each combination."""
        first, *others = corners
        if self.of_corners is None:
            return first.each(ft.partial(function, self.response), *others)
        if first.is_table:
            function = jax.vmap(function)
        rows = map(function, self.of_corners, *(c.rows for c in corners))
        return Corners(rows, first.is_table, first.flipped)

    def with_slides(self, a: Corners, walls: Components) -> "Forces":
        """The same with the second derivatives a of other surfaces than `walls`. ψ of a wall is the
        same function on all sides; ψ of a friction is not."""
        made = self.accelerations.map(lambda own, a: where(walls, own, a), a)
        return dataclasses.replace(self, accelerations=made)

    def pushed(self, fields: Corners, force: Corners) -> Corners:
        """Fields with the reactions λ."""
        return self.each(lambda of, f, force: of.directions.added(f, force), fields, force)

    def sizes_of_fields(self, fields: Corners, force: Corners) -> Components:
        """The size of the terms of fields with the reactions λ, over all sides."""

        def made(of: Response, f: Components, force: Components) -> Components:
            return abs(of.directions).added(abs(f), abs(force))

        return self.each(made, fields, force).sizes()

    def sizes(self, force: Components) -> Components:
        """The size of the reactions' contributions to accelerations, over all sides."""
        if self.of_corners is None:
            return abs(self.response.gains) @ force
        each = self.accelerations.all_of(force)
        return self.each(lambda of, force: abs(of.gains) @ force, each).sizes()


def forces(
    system: ComponentSystem, t: Array, x: Components, mode: Components, fields: Corners
) -> Forces:
    """The effect of reactions for the given fields on all sides."""
    sides = sides_of(mode)
    c, first = constraints(system, t, x, sides), fields[0]
    # ψ is the same function on all sides; only the field along which it changes differs.
    by_time = accelerations(system, t, x, sides, first) - c.gradients @ first
    _, _, normals = system.gradients(t, x)
    return forces_of(system, t, x, sides, c, by_time, normals, fields)


def forces_of(
    system: ComponentSystem,
    t: Array,
    x: Components,
    walls: Components,
    c: Constraints,
    by_time: Components,
    normals: Rows,
    fields: Corners,
) -> Forces:
    """The effect of reactions on surfaces with known constraints, for walls on their sides;
    `by_time` is ∂ψ/∂t."""
    of_corners = None
    if system.feels_reactions:

        def of(sides: Components) -> Response:
            return felt_response(system, (t, x), walls, sides, c.gradients, c.impulse)

        of_corners = tuple(for_each_corner(of, system))
    a = fields.each(lambda f: by_time + c.gradients @ f)
    pushes = normals.products(c.reaction.directions)
    return Forces(c.reaction, of_corners, normals, pushes, a)


def held(known: Forces, rates: Corners, rests: Components) -> tuple[Corners, Corners, Corners]:
    """Rates of H, accelerations and reactions λ on each combination of sides, with the reactions of
    the resting surfaces. They are linear in the field, so they blend as it does."""

    def reaction(of: Response, a: Components) -> Components:
        return multipliers(of.gains, a, rests)

    a = known.accelerations
    if known.of_corners is None and not a.is_table:
        rows = multipliers_of_each(known.response.gains, a.rows, rests)
        force = Corners(rows, flipped=a.flipped)
    else:
        force = known.each(reaction, a)
    return (*answered(known, rates, force), force)


def answered(known: Forces, rates: Corners, force: Corners) -> tuple[Corners, Corners]:
    """Rates of H and accelerations on each combination of sides, with the given reactions."""

    def pushed(rows: Rows, rate: Components, force: Components) -> Components:
        # A rate that reactions cancel must be exactly zero; its rounding, of either sign, would
        # otherwise determine weights.
        after, size = rate + rows @ force, abs(rate) + abs(rows) @ abs(force)
        small = abs(after) <= _CANCELLED * float(jnp.finfo(size.parts[0].dtype).eps) * size
        return after - stop_gradient(where(small, after, 0.0))

    def moved(of: Response, rate: Components, force: Components) -> Components:
        same = known.of_corners is None
        pushes = known.pushes if same else known.normals.products(of.directions)
        return pushed(pushes, rate, force)

    def gained(of: Response, a: Components, force: Components) -> Components:
        return pushed(of.gains, a, force)

    return known.each(moved, rates, force), known.each(gained, known.accelerations, force)
