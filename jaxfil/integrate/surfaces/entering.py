"""Entering a slide: the derivative of a state that starts, or that a map puts, on its surface.

A state on a surface H = 0 by its numbers need not stay there when a parameter or the state itself
changes. Pushed off by δ it is back after a time δ/|ψ| along the field f of that side, with ψ the
rate of H, and then slides along f_s. To first order the state has moved by (f − f_s) δ/|ψ|. The
difference f − f_s is a multiple of ∂f/∂w, the change of the field with the weight w of the slide,
so both sides give the same derivative,

    S = I − ∂f/∂w (∂ψ/∂w)⁻¹ ∇H,

the saltation matrix of a slide that begins (Leine & Nijmeijer, Dynamics and Bifurcations of
Non-Smooth Mechanical Systems, 2004, section 7.3). For several surfaces ∂ψ/∂w is a matrix. A contact
that is located has this derivative by the derivative of its time.
"""

import jax
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.surfaces import filippov
from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.surfaces.weights import response, weights
from jaxfil.integrate.system.components import Components, where
from jaxfil.integrate.system.lowered import ComponentSystem


def entered(
    system: ComponentSystem,
    t: Array,
    x: Components,
    mode: Components,
    on_sides: tuple[Corners, Corners],
    surfaces: Components,
) -> Components:
    """x, n components, with the derivative of a state from which a slide on some `surfaces`, m
    flags, begins. `on_sides` are the fields on all sides and the rates along them."""
    h = where(surfaces, system.switching(t, x), 0.0)
    system, t, at, mode, (fields, rates) = stop_gradient((system, t, x, mode, on_sides))
    if filippov.holds_together(system):
        held = filippov.balance(system, t, at, mode, fields, rates)
        fields, rates, mode = held.fields, held.rates, held.mode
    w, change = weights(mode, rates), response(mode, rates, h)
    _, moved = jax.jvp(lambda w: filippov.blend_fields(system, fields, mode, w), (w,), (change,))
    return _less(x, moved)


@jax.custom_jvp
def _less(x: Components, moved: Components) -> Components:
    """x, with the derivative of x − moved: numbers stay to the last bit, and a program without
    derivatives has no trace of this."""
    return x


@_less.defjvp
def _less_jvp(primals: tuple, tangents: tuple) -> tuple[Components, Components]:
    (x, _), (rate, change) = primals, tangents
    return x, rate - change
