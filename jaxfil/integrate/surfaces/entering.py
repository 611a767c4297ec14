"""The derivative of a state that starts on surfaces, or is put there by a map, and stays on them.

A state with H = 0 need not stay on the surface when a parameter or the state itself changes. Pushed
off a sliding surface by δ, it is back after a time δ/|ψ| along the field f of that side, with ψ the
rate of H, and then slides along f_s. To first order it has moved by (f − f_s) δ/|ψ|. The difference
f − f_s is a multiple of ∂f/∂w, the change of the field with the weight w of the slide, so both
sides give the same derivative,

    S = I − ∂f/∂w (∂ψ/∂w)⁻¹ ∇H,

the saltation matrix of the start of a slide (R. Leine and H. Nijmeijer, Dynamics and Bifurcations
of Non-Smooth Mechanical Systems, 2004). For several surfaces ∂ψ/∂w is a matrix.

At rest, with H = 0 and ψ = 0, impulses along the direction d of the reaction bring the state back
in a time of order √δ. Their sum and their first moment are free, which moves the state by multiples
of d and of (∂F/∂x) d, such that H and ψ vanish again.

A located contact has these derivatives through the derivative of its time. Second derivatives are
exact unless both directions move the state off a surface; the two sides then differ.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.surfaces import filippov, unilateral
from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.surfaces.weights import response, weights
from jaxfil.integrate.system.components import Components, where
from jaxfil.integrate.system.lowered import ComponentSystem


class _Start(NamedTuple):
    """Where a slide or a rest starts. In a derivative its fields are tangents."""

    system: ComponentSystem
    t: Array
    x: Components


_Function: TypeAlias = Callable[[ComponentSystem, Array, Components], Components]
_Change: TypeAlias = Callable[[_Function, Components], Components]
"""The change of a function of system, time and state, given the tangent of the state; those of
system and time are known to it."""


def held_from_here(
    system: ComponentSystem, t: Array, x: Components, mode: Components, surfaces: Components
) -> Components:
    """x, n components, with the derivative of a state at which a slide or a rest on some
    `surfaces`, m flags, starts. The value of x is unchanged, bit for bit, and a program without
    derivatives contains no operations of this function."""
    return _held(_Start(system, t, x), mode, surfaces)


def fields_from_here(
    system: ComponentSystem, t: Array, x: Components, on_sides: tuple[Corners, Corners]
) -> tuple[Corners, Corners]:
    """The fields on all sides and the rates of H along them, with the derivatives that they have at
    x, which may differ from the state at which they were computed by its derivative. Like
    `held_from_here`, without operations in a program without derivatives."""
    return _seen(_Start(system, t, x), on_sides)


@eqx.filter_custom_jvp
def _seen(at: _Start, on_sides: tuple[Corners, Corners]) -> tuple[Corners, Corners]:
    return on_sides


@_seen.def_jvp
def _seen_jvp(primals: tuple, tangents: tuple) -> tuple:
    (at, on_sides), (by_at, _) = primals, tangents
    _, by = eqx.filter_jvp(lambda at: filippov.corners(*at), (at,), (by_at,))
    return _seen(at, on_sides), eqx.combine(by, jax.tree.map(jnp.zeros_like, on_sides))


@eqx.filter_custom_jvp
def _held(at: _Start, mode: Components, surfaces: Components) -> Components:
    return at.x


@_held.def_jvp
def _held_jvp(primals: tuple, tangents: tuple) -> tuple[Components, Components]:
    # The mode and the surfaces are discrete, and their tangents have no meaning.
    (at, mode, surfaces), (by_at, _, _) = primals, tangents
    system = at.system
    # Equinox omits tangents that are zero.
    rate = eqx.combine(by_at.x, jax.tree.map(jnp.zeros_like, at.x))

    def change(function: _Function, rate: Components) -> Components:
        # System and time move as at the start, and the state by `rate`.
        value, by = eqx.filter_jvp(lambda at: function(*at), (at,), (by_at._replace(x=rate),))
        return eqx.combine(by, jax.tree.map(jnp.zeros_like, value))

    # Rests come first, so that the distance from a sliding surface is taken at the state at rest.
    if system.resets:
        rate = _to_rest(at, mode, surfaces & unilateral.rests_of(mode), change, rate)
    if system.slides:
        # The distance is from the moved surface, since H changes with time and parameters too.
        off = where(surfaces & (mode == 0), change(ComponentSystem.switching, rate), 0.0)
        rate = rate - _by_weights(at, mode, off)
    # The value is computed by the function itself, so that second derivatives use this rule again.
    return _held(at, mode, surfaces), rate


def _to_rest(
    at: _Start,
    mode: Components,
    rests: Components,
    change: _Change,
    rate: Components,
) -> Components:
    """The tangent of a state that is brought to rest on surfaces."""
    (system, t, x), sides = at, unilateral.sides_of(mode)
    impulse = unilateral.constraints(system, t, x, sides).impulse

    def psi(system: ComponentSystem, t: Array, x: Components) -> Components:
        return unilateral.contact_rates(system, t, x, sides)

    def bring(changed: Components, x: Components) -> Components:
        impulses = unilateral.change_of_multipliers(impulse.gains, changed, rests)
        return impulse.directions.added(x, impulses)

    # H is brought to zero before ψ, since moving the state to H = 0 changes ψ.
    moments = bring(change(ComponentSystem.switching, rate), 0.0 * x)
    # The first moment of the impulses moves the state by d and, through the field, by (∂F/∂x) d.
    _, moved = jax.jvp(lambda x: system.field(t, x, sides), (x,), (moments,))
    rate = rate + moved
    return bring(change(psi, rate), rate)


def _by_weights(at: _Start, mode: Components, off: Components) -> Components:
    """∂f/∂w (∂ψ/∂w)⁻¹ times the distances `off` of the state from its sliding surfaces."""
    system, t, x = at
    system = system.in_mode(mode)
    fields, rates = filippov.corners(system, t, x)
    # Beside a rest the weights change the reactions too, so these are a part of the fields.
    if filippov.holds_together(system):
        held = filippov.balance(system, t, x, mode, fields, rates)
        fields, rates, mode = held.fields, held.rates, held.mode
    w, change = weights(mode, rates), response(mode, rates, off)

    def field(w: Components) -> Components:
        return system.squared(filippov.blend_fields(system, fields, mode, w))

    _, moved = jax.jvp(field, (w,), (change,))
    return moved
