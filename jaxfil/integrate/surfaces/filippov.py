"""Filippov's rules on surfaces: convex combinations, sliding weights, and the choice of a mode.

The mode of a surface is +1 or −1 on that side, or 0 while sliding. From the fields on all sides at
one point and the mode follow the field of the mode, its weights, and after a contact the modes that
continue the solution.

On several surfaces at once the field is the product-weight (Alexander–Seidman) blend of the 2^m
corner fields: with weights w in [−1, 1]^m, F(w) = Σ_s F_s Π_j (1 + s_j w_j)/2, where w_j = ±1 off
the surface and, for sliding surfaces, w solves dH_j/dt(w) = 0. For one surface this is Filippov's
convex combination with λ = (1 + w)/2.

For separate surfaces (`Structure.separate`), each switched by its own side alone, as in two
oscillators that do not affect each other's switches, the weights and modes are separate too. Each
is computed as for one surface, from two corners, all sides + and all −. Where the field is affine
in its sides (`Structure.affine`), m + 1 corners are enough (see `corners`).
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.steppers.explicit import ExplicitTableau, compact_step, tableau_of
from jaxfil.integrate.steppers.taylor import end_alone
from jaxfil.integrate.surfaces import mode_series, reactions, unilateral
from jaxfil.integrate.surfaces.corners import Corners, corner_sides, on_corners
from jaxfil.integrate.surfaces.decision import decide
from jaxfil.integrate.surfaces.question import in_place, question_of
from jaxfil.integrate.surfaces.weights import determinant, held_together, weights
from jaxfil.integrate.system.components import (
    Components,
    Forcing,
    any_of,
    largest,
    least,
    pack,
    sign,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.smooth_field import Polynomial, SmoothField
from jaxfil.xla.moves import taken
from jaxfil.xla.select import select, select_all

# Rounding of rates, in eps of their sizes.
_NOISE = 64
# The method for steps in modes without a power series.
_OTHER = tableau_of(diffrax.Dopri8())
assert isinstance(_OTHER, ExplicitTableau)


def blend_fields(
    system: ComponentSystem, fields: Corners, mode: Components, weights: Components
) -> Components:
    """`Corners.blend` of fields; numbers that no side switches are copied."""
    if fields.are_of_one:
        mode, weights = (_of_owners(system, v, fields[0].is_array) for v in (mode, weights))
    if fields.is_table or fields[0].is_array:
        return fields.blend(mode, weights)
    switched = [i for i, sides in enumerate(system.structure.switched) if sides]
    parts = fields.map(lambda f: Components(f.parts[i] for i in switched)).blend(mode, weights)
    mixed = dict(zip(switched, parts.parts, strict=True))
    return Components(mixed.get(i, v) for i, v in enumerate(fields[0].parts))


def _of_owners(system: ComponentSystem, v: Components, as_array: bool) -> Components:
    """For each number of the field that a side switches, the value of that side's surface, among
    separate surfaces; if `as_array`, in an array with the other numbers."""
    switched = system.structure.switched
    if not as_array:
        return Components(v.parts[sides[0]] for sides in switched if sides)
    if system.m == 1:
        return v
    # Numbers that no side switches read an arbitrary surface, chosen so that neighbours still read
    # a contiguous slice.
    owners = [sides[0] if sides else i % system.m for i, sides in enumerate(switched)]
    return Components([taken(pack(v, system.dtype), np.array(owners))])


def corners(
    system: ComponentSystem,
    t: Array,
    x: Components,
    alone: bool = False,
    forcing: Forcing | None = None,
) -> tuple[Corners, Corners]:
    """The field on the combinations of sides that determine it, and dH/dt along each; `alone` and
    `forcing` as in `ComponentSystem.field`."""

    def field_and_rate(sides: Components) -> tuple[Components, Components]:
        f = system.field(t, x, sides, alone, forcing, term=True)
        return f, system.rate(t, x, f)

    return on_corners(field_and_rate, system, corner_sides(system))


def field(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    forcing: Forcing | None = None,
) -> Components:
    """The field of a mode, blended while sliding and with reactions while resting; `forcing` as in
    `ComponentSystem.field`."""
    system = system.in_mode(mode)
    if holds_together(system):
        f = balance(system, t, x, mode, *corners(system, t, x, True, forcing)).field
        return system.squared(f)
    # Here weights do not depend on reactions, so these are added to the field with the weights.
    f = free_field(system, t, x, mode, forcing)
    return system.squared(unilateral.held_field(system, t, x, mode, f)[0] if system.resets else f)


def holds_together(system: ComponentSystem) -> bool:
    """Whether weights and reactions may depend on each other, for motions that slide on one surface
    and rest on another."""
    # One surface cannot be slid and rested on at once.
    return system.resets and system.slides and system.m > 1


class Balance(eqx.Module):
    """Weights and reactions of a mode that may slide on some surfaces and rest on others."""

    fields: Corners
    """The fields on all sides, with the reactions."""
    rates: Corners
    """dH/dt along these fields."""
    forces: Corners
    """The reactions λ on each combination of sides."""
    mode: Components
    """The same mode with sides in place of rests."""
    weights: Components

    @property
    def field(self) -> Components:
        """The field of the mode."""
        return self.fields.blend(self.mode, self.weights)

    @property
    def force(self) -> Components:
        """The reactions λ, m components."""
        return self.forces.blend(self.mode, self.weights)

    @property
    def determinant(self) -> Array:
        """The determinant of the equations of its weights (see `weights.determinant`)."""
        # Only the search for singular points uses it, which has no derivatives.
        return determinant(*stop_gradient((self.mode, self.rates, self.weights)))


def balance(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    fields: Corners,
    rates: Corners,
) -> Balance:
    """Weights and reactions of a mode, given the fields on all sides and the rates along them. In a
    mode without rests fields and rates are returned unchanged, and reactions are zero."""

    def reacted(
        t: Array, x: Components, mode: Components, fields: Corners, rates: Corners
    ) -> tuple:
        known = reactions.forces(system, t, x, mode, fields)
        rests, sides = unilateral.rests_of(mode), unilateral.beside(mode)
        pushed, _, force = held_together(known, rates, sides, rests)
        return known.pushed(fields, force), pushed, force

    def free(t: Array, x: Components, mode: Components, fields: Corners, rates: Corners) -> tuple:
        return fields, rates, rates.map(lambda rate: 0.0 * rate)

    # Without rests both branches agree, since all reactions are zero.
    resting = any_of(unilateral.rests_of(mode))
    held = system.where_any(resting, reacted, free, t, x, mode, fields, rates)
    fields, rates, forces = held
    beside = unilateral.beside(mode)
    return Balance(fields, rates, forces, beside, weights(beside, rates))


def free_field(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    forcing: Forcing | None = None,
) -> Components:
    """`field` without the reactions of resting surfaces, before it is squared."""
    system = system.in_mode(mode)
    if not system.slides:
        sides = unilateral.sides_of(mode) if system.resets else mode  # a rest has the mode ±2
        return system.field(t, x, sides, True, forcing, term=True)
    fields, rates = corners(system, t, x, True, forcing)
    return blend_fields(system, fields, mode, weights(mode, rates))


def field_terms(
    system: ComponentSystem, t: Array, x: Components, mode: Components, f: Components
) -> Components:
    """The size of the terms in the field f of a mode. It includes all sides if f may be their
    blend, which cancel where a mass sticks, and the part cancelled by a reaction."""
    if system.slides:
        fields, _ = corners(system, t, x)
        return abs(f) + fields.sizes()
    return abs(f) + abs(free_field(system, t, x, mode)) if system.resets else abs(f)


class ModeField(SmoothField):
    """The field of a mode as a smooth vector field of time and state. `blended` allows sliding,
    `held` allows rests; without them the fields of other sides, or the reactions, are not
    computed."""

    system: ComponentSystem
    mode: Components
    blended: bool = eqx.field(static=True, default=True)
    held: bool = eqx.field(static=True, default=True)

    def __call__(self, t: Array, x: Components, forcing: Forcing | None = None) -> Components:
        if not self.blended:
            # Such a mode consists of sides.
            return self.system.field(t, x, self.mode, True, forcing)
        if self.held:
            return field(self.system, t, x, self.mode, forcing)
        return self.system.squared(free_field(self.system, t, x, self.mode, forcing))

    def once(self, function: Callable, *args: Any) -> Any:
        """The same as `ComponentSystem.once`."""
        return self.system.once(function, *args)

    def polynomial(
        self, order: int, t: Array, x: Components, h: Array, kinks: bool = False
    ) -> Polynomial:
        """The power series of the motion in a step of the mode. For a rest, or a slide on surfaces
        whose weights depend on each other, it is right only at the end of the step, by Dopri8."""
        system, mode = self.system, self.mode
        slides, rests = self.blended and system.slides, self.held and system.resets
        series = ft.partial(mode_series.polynomial, system, order, slides, kinks=kinks)
        unserved = slides and not mode_series.slides_have_series(system)
        if not rests and not unserved:
            return series(t, x, h, mode)
        unknown = any_of(unilateral.rests_of(mode)) if rests else jnp.zeros((), bool)
        if unserved:
            unknown = unknown | any_of(mode == 0)
            # A series for the sides of the mode. A slide has the side 0 in it, without a meaning,
            # and takes the step of the other method below.
            series = ft.partial(mode_series.polynomial, system, order, False, kinks=kinks)

        def other(t: Array, x: Components, h: Array, mode: Components) -> Polynomial:
            whole = ModeField(system, mode, self.blended, self.held)
            forcing = system.forcing(t, h, _OTHER.times)
            # A compact program, since few lanes take this step.
            trial = compact_step(_OTHER, whole, t, x, whole(t, x), h, forcing)
            f1, error = whole(t + h, trial.x), trial.error
            assert error is not None
            # This end rate makes the defect in `error_at` equal to Dopri8's own error estimate.
            f = f1 - (order + 1.0) * (error + _OTHER.d[-1] * f1)
            return end_alone(order, h, x, trial.x, f, mode)

        # Without a slide or a rest in any lane this is not executed.
        def mixed(t: Array, x: Components, h: Array, mode: Components) -> Polynomial:
            known, last = series(t, x, h, mode), other(t, x, h, mode)
            last = eqx.tree_at(lambda v: v.kinks, last, known.kinks, is_leaf=lambda v: v is None)
            return select_all(unknown, last, known)

        return system.where_any(unknown, mixed, series, t, x, h, mode)


def guard(system: ComponentSystem, t: Array, x: Components, mode: Components) -> Components:
    """The guard of each surface, positive within the mode: ±H_j on a side, 1 − w_j² while sliding,
    the reaction λ_j at rest."""
    if holds_together(system):
        return guard_together(system, t, x, mode)
    # Of a resting surface, with the mode ±2, this is not selected below.
    off = free_guard(system, t, x, mode)
    if not system.resets:
        return off
    return where(unilateral.rests_of(mode), reaction(system, t, x, mode), off)


def reaction(system: ComponentSystem, t: Array, x: Components, mode: Components) -> Components:
    """λ_j of the surfaces that a mode rests on, positive if it pushes away; 0 for others. The mode
    must not slide."""
    free = free_field(system, t, x, mode)
    return unilateral.held_field(system, t, x, mode, free)[1]


def guard_together(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    forcing: Forcing | None = None,
) -> Components:
    """`guard` of a mode that may both slide and rest."""
    held = balance(system, t, x, mode, *corners(system, t, x, forcing=forcing))
    w, off = held.weights, mode * system.switching(t, x)
    pushes = unilateral.sides_of(mode) * held.force
    # 1 − w² as a product, which does not cancel near its zeros w = ±1, where a slide ends.
    return where(unilateral.rests_of(mode), pushes, where(mode == 0, (1 - w) * (1 + w), off))


def free_guard(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    forcing: Forcing | None = None,
) -> Components:
    """`guard` of a mode without rests; `forcing` as in `ComponentSystem.field`."""
    off = mode * system.switching(t, x)
    if not system.slides:
        return off
    _, rates = corners(system, t, x, forcing=forcing)
    w = weights(mode, rates)  # in the same product as in `guard_together`
    return where(mode == 0, (1 - w) * (1 + w), off)


def choose(
    fields: Corners | None,
    rates: Corners,
    following: Corners | None,
    mode: Components,
    on: Components,
    direction: Array,
    steered: Components,
    instant: Array | float = 0.0,
    slides: bool = True,
) -> tuple[Components, Array]:
    """The mode after a contact with the surfaces marked `on`, and the number of admissible ones.

    One admissible mode means that the solution is unique, several (repelling sliding) that it is
    not, and zero is a tangency that these derivatives do not decide. `mode` has the side of each
    surface, on which a motion that stands still stays. `following` is the derivative of H that
    decides where dH/dt vanishes, within the rounding `instant` of the time; None if only the rates
    do. `steered` are surfaces that a weight can hold the motion on; `slides` as in `Question`.
    """
    given = following, mode, on, direction, steered, instant, slides
    if rates.are_of_one:
        return _choose_on_one(rates, *given)
    return decide(question_of(rates, fields, *given))


def is_flat(rate: Components, rates: Corners) -> Components:
    """Whether a rate of separate surfaces is zero to the rounding of those on both sides."""
    return abs(rate) <= _NOISE * float(jnp.finfo(rate.parts[0].dtype).eps) * rates.sizes()


def _choose_on_one(
    rates: Corners,
    following: Corners | None,
    mode: Components,
    on: Components,
    direction: Array,
    steered: Components,
    instant: Array | float,
    slides: bool,
) -> tuple[Components, Array]:
    """`choose` for separate surfaces, which the rates on both sides determine."""
    if following is not None:
        # No weight holds dH/dt at zero if it is one function on both sides.
        rates, _ = in_place(rates, following, direction, instant, steered)
    above, below = rates[0], rates[1]
    # The product of small rates would be zero.
    up, down = direction * sign(above), direction * sign(below)
    level = (above == 0) & (below == 0)
    decided = on
    if following is not None:
        up = where(is_flat(above, rates), sign(following[0]), up)
        down = where(is_flat(below, rates), sign(following[1]), down)
        decided = on & ~(level & (following[0] == 0) & (following[1] == 0))
    plus, minus = up > 0, down < 0
    # Equal rates with this sign are both zero, and have no weight.
    slide = (up * down <= 0) & ~level
    if not slides:
        # Where one field stands still and the other one pushes to the surface, at w = ±1.
        stands, slide = slide & (up * down == 0), slide & (up * down < 0)
        decided = decided & ~(stands & (up == down))
        plus, minus = plus | (stands & (down > 0)), minus | (stands & (up < 0))
    count = plus.astype(jnp.int32) + minus.astype(jnp.int32) + slide.astype(jnp.int32)
    # With several modes the lane ends as not unique, whichever is taken.
    side = where(plus, 1.0, where(minus, -1.0, 0.0)).astype(direction.dtype)
    # A slide without a force to hold it, which stands still, continues on side +, as at a start.
    stays = where(on & ~decided & (mode == 0), jnp.ones_like(direction), mode)
    return where(decided & (count > 0), side, stays), _count_of_all(where(decided, count, 1))


def _count_of_all(counts: Components) -> Array:
    """The number of admissible modes, given the number for each surface. For arrays of surfaces the
    product might overflow, so it is replaced by the largest factor, or 0 if any is zero."""
    if counts.is_array:
        return select(least(counts) > 0, largest(counts), 0)
    return ft.reduce(jnp.multiply, counts.parts)
