"""The largest value of a function along a trajectory, between steps too.

On the most promising parts of steps the zero of the function's derivative along the field is
bracketed, and the step is repeated up to it, as an integrator locates an event.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.integrate.loop.extremes import cubics_of
from jaxfil.integrate.run.solution import Dense, step_again, within_step
from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import build
from jaxfil.orbits.regula_falsi import zero_between
from jaxfil.xla.select import select

# Number of parts of steps on which it is located, with the largest estimates. Of two maxima that
# are equal within the error of a parabola, either may be returned.
_LOOKED_AT = 3


class Extremum(eqx.Module):
    """The largest value of a function, its time and state, and the mode there."""

    value: Float[Array, ""]
    t: Float[Array, ""]
    x: Float[Array, " n"]
    mode: Float[Array, " m"]


class _Part(eqx.Module):
    """A part of a step, by the start of the step and the times from there to both its ends."""

    t: Array
    x: Array
    mode: Array
    low: Array
    high: Array


def largest(dense: Dense, function: Callable[[Array, Array], Array]) -> Extremum:
    """The largest value of `function(t, x)` over all steps of a trajectory."""
    dtype = dense.xs.dtype
    system = build(dense.system, dense.xs[0], compact=dense.compact)

    def look(part: _Part, h: Array) -> tuple[Array, Array, Array]:
        """State, value and rate after a length h of the step of a part."""
        here = within_step(dense, system, part.t)
        field = ModeField(here, here.of_surfaces(part.mode.astype(dtype)))
        end = step_again(dense, here, field, part.t, here.unpack(part.x), h)
        t, f = part.t + h, pack(field(part.t + h, end), dtype)
        x = pack(end, dtype)
        value, rate = jax.jvp(function, (t, x), (jnp.ones_like(t), f))
        return x, value, rate

    def estimate(part: _Part) -> tuple[Array, Array]:
        """The largest value on a part by the parabola through both slopes; the slopes."""
        _, values, rates = jax.vmap(lambda h: look(part, h))(jnp.stack([part.low, part.high]))
        # The parabola through both slopes and the value at the start; flat slopes have no peak.
        gap = rates[0] - rates[1]
        length = part.high - part.low
        peak = values[0] + 0.5 * rates[0] ** 2 * length / select(gap == 0, 1, gap)
        inside = (rates[0] > 0) & (rates[1] < 0)
        return jnp.maximum(jnp.max(values), select(inside, peak, -jnp.inf)), rates

    def locate(part: _Part, rates: Array) -> tuple[Array, Array, Array]:
        """The largest value on one part, its time and state."""
        peak = zero_between(lambda h: look(part, h)[2], part.low, part.high, *rates)
        # Without a change of sign the search returns any point; the ends are the candidates.
        inside = (rates[0] > 0) & (rates[1] < 0)
        ends = jnp.stack([part.low, select(inside, peak, part.low), part.high])
        xs, values, _ = jax.vmap(lambda h: look(part, h))(ends)
        best = jnp.argmax(values)
        return values[best], part.t + ends[best], xs[best]

    # Rows beyond the last step are padding, and steps of length zero have no extremum.
    ends = jnp.append(dense.ts[1:], jnp.inf)
    real = jnp.isfinite(ends) & (ends != dense.ts)
    h = select(real, ends - dense.ts, 0)
    # A step of a series may be as long as the whole trajectory, with several maxima.
    count = cubics_of(tableau_of(dense.stepper))
    divided = h[:, None] * (np.arange(count + 1) / count).astype(dtype)
    real, ts, xs, modes = (
        jnp.repeat(v, count, axis=0)
        for v in (
            real,
            select(real, dense.ts, dense.ts[0]),
            select(real[:, None], dense.xs, dense.xs[0]),
            dense.modes,
        )
    )
    parts = _Part(ts, xs, modes, divided[:, :-1].ravel(), divided[:, 1:].ravel())
    estimates, rates = jax.vmap(estimate)(parts)
    _, likely = jax.lax.top_k(select(real, estimates, -jnp.inf), min(_LOOKED_AT, real.size))
    parts, rates = jax.tree.map(lambda v: v[likely], (parts, rates))
    values, ts, xs = jax.vmap(locate)(parts, rates)
    best = jnp.argmax(select(real[likely], values, -jnp.inf))
    return Extremum(values[best], ts[best], xs[best], parts.mode[best].astype(dtype))
