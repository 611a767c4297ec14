"""Second derivatives of a landing, and a landing that is here already.

Newton's step in time, t += δ, x += δ f, δ = −g/ġ with constant ġ, has the first derivatives of a
landing. This file has the terms that complete the second ones.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.surfaces.filippov import ModeField, guard
from jaxfil.integrate.system.components import Components, any_of, total, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.second_derivative import add_second_derivative
from jaxfil.xla.select import select


def met_here(
    system: ComponentSystem,
    at: tuple[Array, Components],
    motion: tuple[Components, Components],
    gap: tuple[Components, Components],
    met: Components,
) -> tuple[Array, Components]:
    """The time to a contact with the surface `met` (m flags, at most one set) and the state there,
    on a motion of the given mode with the field f, where g, one of the gaps, is zero to rounding,
    with its rate. The value of the time is zero, and its derivatives are not."""
    (t, x), (mode, f), (g, rate) = at, motion, gap
    missing = -g / where(met, rate, 1.0)
    delta = total(where(met, missing - stop_gradient(missing), 0.0))
    moved = where(any_of(met), x + delta * f, x)
    return add_second_derivative(beyond_newton, (delta, moved), system, t, x, mode, met)


def beyond_newton(
    system: ComponentSystem, t: Array, x: Components, mode: Components, met: Components
) -> tuple[Array, Components]:
    """The terms missing in the second derivatives of the time δ to a contact with the surface
    `met`, and of the state there. Their values and first derivatives are zero."""

    def gap(system: ComponentSystem, t: Array, x: Components) -> Any:
        return total(where(met, guard(system, t, x, mode), 0.0))

    return beyond_newton_to(gap, lambda system: system, system, (t, x), mode)


def beyond_newton_to(
    gap: Callable, system_of: Callable, given: Any, at: tuple[Array, Components], mode: Components
) -> tuple[Array, Components]:
    """The same terms where `gap(given, t, x)` vanishes, on a motion of `system_of(given)`.

    Along the motion g is expanded to second order, δ = −g/ġ − (g/ġ)² g̈/2ġ, and so is the state,
    x + δ f + δ² f'/2, with f' the rate of the field.
    """

    def field(given: Any, t: Array, x: Components) -> Components:
        return ModeField(system_of(given), mode)(t, x)

    def along(function: Callable, given: Any, t: Array, x: Components) -> Any:
        """A function of the given system, time and state, and its rate along the motion."""
        moved = jnp.ones_like(t), field(given, t, x)
        return jax.jvp(lambda t, x: function(given, t, x), (t, x), moved)

    def rate(*at: Any) -> Array:
        return along(gap, *at)[1]

    g, slope = along(gap, given, *at)
    # Lanes without a contact have g = ġ = 0, and with this divisor δ = 0.
    slope = select(slope == 0, 1.0, slope)
    here = stop_gradient((given, *at))
    _, bend = along(rate, *here)
    # `here` is constant: g̈ and the field's rate multiply δ², which has no derivative of lower
    # order than the second.
    f, turn = along(field, *here)
    # The landing divides by a constant ġ, and its δ = −g/ġ is subtracted. Where g = 0 the two
    # quotients have the same value and the same first derivative.
    fixed, delta = stop_gradient(slope), -g / slope
    beyond = delta + g / fixed - 0.5 * bend / fixed * delta * delta
    return beyond, beyond * f + 0.5 * delta * delta * turn
