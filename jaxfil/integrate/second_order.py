"""What second derivatives of a landing are made of.

The end of a step on a contact enters; what Newton's step in time, t += δ, x += δ f, δ = −g/ġ, with
ġ a constant, leaves out of them leaves.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.components import Components, ComponentSystem
from jaxfil.integrate.filippov import ModeField, guard


def beyond_newton(
    system: ComponentSystem, t: Array, x: Components, mode: Components, met: Components
) -> tuple[Array, Components]:
    """Of the time δ to a contact with the surface that is `met`, and of the state there: a function
    with the second derivatives that are missing, whose value and first derivatives are zero.

    Along the motion g is expanded to second order, δ = −g/ġ − (g/ġ)² g̈/2ġ, and so is the state,
    x + δ f + δ² f'/2, with f' the rate of the field.
    """

    def gap(system: ComponentSystem, t: Array, x: Components) -> Any:
        each = zip(met, guard(system, t, x, mode), strict=True)
        return sum(jnp.where(is_met, g, 0.0) for is_met, g in each)

    def along(function: Callable, system: ComponentSystem, t: Array, x: Components) -> Any:
        """A function of the system, time and state, and its rate along the motion."""
        f = ModeField(system, mode)(t, x)
        return jax.jvp(lambda t, x: function(system, t, x), (t, x), (jnp.ones_like(t), f))

    def rate(*at: Any) -> Array:
        return along(gap, *at)[1]

    g, slope = along(gap, system, t, x)
    slope = jnp.where(slope == 0, 1.0, slope)
    here = stop_gradient((system, t, x))
    _, bend = along(rate, *here)
    f, turn = along(lambda system, t, x: ModeField(system, mode)(t, x), *here)
    fixed, delta = stop_gradient(slope), -g / slope
    beyond = delta + g / fixed - 0.5 * bend / fixed * delta * delta
    curved = tuple(beyond * v + 0.5 * delta * delta * w for v, w in zip(f, turn, strict=True))
    return beyond, curved
