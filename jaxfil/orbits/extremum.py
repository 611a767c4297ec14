"""The largest value of a function along a trajectory, between steps too.

On every part of a step on which the function turns, the zero of its derivative along the field is
bracketed, and the step is repeated up to it, as an integrator locates an event. Nothing that the
ends of a long step tell is accurate enough to compare two maxima of nearly equal height.
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

# Number of maxima that are located at a time.
_AT_A_TIME = 4


class _Part(eqx.Module):
    """A part of a step, by the start of the step and the times from there to both its ends."""

    t: Array
    x: Array
    mode: Array
    low: Array
    high: Array


def largest(dense: Dense, function: Callable[[Array, Array], Array]) -> Float[Array, ""]:
    """The largest value of `function(t, x)` over all steps of a trajectory."""
    dtype = dense.xs.dtype
    system = build(dense.system, dense.xs[0], compact=dense.compact)

    def look(part: _Part, h: Array) -> tuple[Array, Array]:
        """Value and rate after a length h of the step of a part."""
        here = within_step(dense, system, part.t)
        field = ModeField(here, here.of_surfaces(part.mode.astype(dtype)))
        end = step_again(dense, here, field, part.t, here.unpack(part.x), h)
        t, f = part.t + h, pack(field(part.t + h, end), dtype)
        return jax.jvp(function, (t, pack(end, dtype)), (jnp.ones_like(t), f))

    def peak(part: _Part, rates: Array) -> Array:
        """The maximum on a part on which the function turns."""
        h = zero_between(lambda h: look(part, h)[1], part.low, part.high, *rates)
        return look(part, h)[0]

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
    lows, highs = (jax.vmap(look)(parts, h) for h in (parts.low, parts.high))
    best = jnp.max(select(real, jnp.maximum(lows[0], highs[0]), -jnp.inf))
    rates = jnp.stack([lows[1], highs[1]], axis=1)
    turns = real & (rates[:, 0] > 0) & (rates[:, 1] < 0)
    # The parts on which it turns, before the others.
    number = jnp.argsort(~turns, stable=True)
    number = jnp.pad(number, (0, -number.size % _AT_A_TIME), mode="edge")

    def look_further(state: tuple[Array, Array]) -> tuple[Array, Array]:
        done, best = state
        here = jax.lax.dynamic_slice(number, (done,), (_AT_A_TIME,))
        peaks = jax.vmap(peak)(*jax.tree.map(lambda v: v[here], (parts, rates)))
        return done + _AT_A_TIME, jnp.maximum(best, jnp.max(select(turns[here], peaks, -jnp.inf)))

    count, none = jnp.sum(turns, dtype=jnp.int32), jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(lambda state: state[0] < count, look_further, (none, best))[1]
