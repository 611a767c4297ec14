"""The largest value of a function along a trajectory, between steps too.

On the most promising steps the zero of the function's derivative along the field is bracketed, and
the step is repeated up to it, as an integrator locates an event.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfil.integrate.run.solution import Dense, step_again, within_step
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import build
from jaxfil.orbits.regula_falsi import zero_between
from jaxfil.xla.select import select

# Number of steps on which it is located, with the largest estimates. Of two maxima that are equal
# within the error of a parabola, either may be returned.
_LOOKED_AT = 3


class Extremum(eqx.Module):
    """The largest value of a function, its time and state, and the mode there."""

    value: Float[Array, ""]
    t: Float[Array, ""]
    x: Float[Array, " n"]
    mode: Float[Array, " m"]


class _Start(eqx.Module):
    """The start of a step, and its length."""

    t: Array
    x: Array
    mode: Array
    h: Array


def largest(dense: Dense, function: Callable[[Array, Array], Array]) -> Extremum:
    """The largest value of `function(t, x)` over all steps of a trajectory."""
    dtype = dense.xs.dtype
    system = build(dense.system, dense.xs[0], compact=dense.compact)

    def look(start: _Start, h: Array) -> tuple[Array, Array, Array]:
        """State, value and rate after a fraction h of a step."""
        here = within_step(dense, system, start.t)
        field = ModeField(here, here.of_surfaces(start.mode.astype(dtype)))
        end = step_again(dense, here, field, start.t, here.unpack(start.x), h)
        t, f = start.t + h, pack(field(start.t + h, end), dtype)
        x = pack(end, dtype)
        value, rate = jax.jvp(function, (t, x), (jnp.ones_like(t), f))
        return x, value, rate

    def estimate(start: _Start) -> tuple[Array, Array]:
        """The largest value on a step by the parabola through both slopes; the slopes."""
        _, values, rates = jax.vmap(lambda h: look(start, h))(jnp.stack([0 * start.h, start.h]))
        # The parabola through both slopes and the value at the start; flat slopes have no peak.
        gap = rates[0] - rates[1]
        peak = values[0] + 0.5 * rates[0] ** 2 * start.h / select(gap == 0, 1, gap)
        inside = (rates[0] > 0) & (rates[1] < 0)
        return jnp.maximum(jnp.max(values), select(inside, peak, -jnp.inf)), rates

    def locate(start: _Start, rates: Array) -> tuple[Array, Array, Array]:
        """The largest value on one step, its time and state."""
        peak = zero_between(lambda h: look(start, h)[2], 0 * start.h, start.h, *rates)
        # Without a change of sign the search returns any point; the ends are the candidates.
        inside = (rates[0] > 0) & (rates[1] < 0)
        ends = jnp.stack([0 * start.h, select(inside, peak, 0), start.h])
        xs, values, _ = jax.vmap(lambda h: look(start, h))(ends)
        best = jnp.argmax(values)
        return values[best], start.t + ends[best], xs[best]

    # Rows beyond the last step are padding, and steps of length zero have no extremum.
    ends = jnp.append(dense.ts[1:], jnp.inf)
    real = jnp.isfinite(ends) & (ends != dense.ts)
    starts = _Start(
        t=select(real, dense.ts, dense.ts[0]),
        x=select(real[:, None], dense.xs, dense.xs[0]),
        mode=dense.modes,
        h=select(real, ends - dense.ts, 0),
    )
    estimates, rates = jax.vmap(estimate)(starts)
    _, likely = jax.lax.top_k(select(real, estimates, -jnp.inf), min(_LOOKED_AT, real.size))
    starts, rates = jax.tree.map(lambda v: v[likely], (starts, rates))
    values, ts, xs = jax.vmap(locate)(starts, rates)
    best = jnp.argmax(select(real[likely], values, -jnp.inf))
    return Extremum(values[best], ts[best], xs[best], starts.mode[best].astype(dtype))
