"""The phase of the forcing: elapsed times that restart in each of its periods.

A lane at the end of a forcing period goes on at time zero of the next one. This is valid only for a
system that is periodic, which `repeats` tests first.

The rounding of a time grows with it: after 300 periods it is 5e-14 in float64 and 2e-5 in float32,
and the phase of the forcing and every contact have the same error. A phase stays as small as the
period, and is exact at the start of one.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import TimeGrid
from jaxfil.integrate.lane.state import LoopState
from jaxfil.model import check
from jaxfil.model.system import System, field_of
from jaxfil.xla.select import select

# Times of the test, in periods; forces of other periods are not zero at both.
_PHASES = (0.29, 0.83)
# Tolerance of the test, in eps. The sum t + T is rounded, and cosines of multiples of the frequency
# magnify that rounding.
_SAME = 1024


def repeats(system: System, period: Array, x: Array) -> Array:
    """Whether field, H and resets at a state x are the same one period later. Forces of two
    frequencies, or kicks at times of their own, are examples where they are not."""
    m = check.shapes(system, x)
    x, period = stop_gradient(x), stop_gradient(period)

    def values(t: Array, side: Array) -> Array:
        own = field_of(system, t, x, side * jnp.ones(m, x.dtype)), system.switching(t, x)
        if system.resets:
            count = m[0] if m else 1
            own += tuple(system.reset(t, x, jnp.asarray(j)) for j in range(count))
        return jnp.concatenate([jnp.ravel(v) for v in own])

    at = jnp.asarray(_PHASES, x.dtype) * period
    both = jnp.asarray([-1.0, 1.0], x.dtype)
    several = jax.vmap(jax.vmap(values, in_axes=(None, 0)), in_axes=(0, None))
    # Shape (2 times, 2 sides, numbers). The size is the largest over times and sides, since a
    # number may vanish at one of them.
    now, later = several(at, both), several(at + period, both)
    size = jnp.max(abs(now) + abs(later), axis=(0, 1))
    same = abs(now - later) <= _SAME * jnp.finfo(x.dtype).eps * size
    return jnp.all(same)


def next_period(grid: TimeGrid, state: LoopState) -> LoopState:
    """The lane, moved to the next period of the forcing if it is at the end of one."""
    if grid.forcing is None:
        return state
    period, over = grid.forcing.length, state.counts.in_period >= grid.forcing.steps

    def back(tau: Array) -> Array:
        return select(over, tau - period, tau)

    # The end of a period is a grid point, where `tau_low` is zero already.
    start = select(over, state.counts.index, state.counts.period_start)
    turn = state.turn and dataclasses.replace(state.turn, tau=back(state.turn.tau))
    return dataclasses.replace(
        state,
        # Zero, and not the difference, which would carry rounding on. Earlier times become
        # negative, so that their distances from the lane remain.
        motion=dataclasses.replace(state.motion, tau=select(over, 0.0, state.motion.tau)),
        pending=dataclasses.replace(state.pending, tau=back(state.pending.tau)),
        counts=dataclasses.replace(state.counts, period_start=start),
        turn=turn,
    )
