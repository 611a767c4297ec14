"""The phase of the forcing: elapsed times that restart in each of its periods.

A lane at the end of a forcing period goes on at time zero of the next one. This is valid only for a
system that is periodic, which `repeats` tests first.

The rounding of a time grows with it: after 300 periods it is 5e-14 in float64 and 2e-5 in float32,
and the phase of the forcing and every contact have the same error. A phase stays as small as the
period, and is exact at the start of one.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import TimeGrid
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.system.closed_over import with_closed_numbers
from jaxfil.model import check
from jaxfil.model.system import System, field_of
from jaxfil.xla.select import select

# Times of the test, in periods, at which each state is compared with one period later; forces of
# other periods are not zero at both.
_PHASES = 0.29, 0.83
# Distances of the other states of the test, in 1 + |x|, one for each component in turn, and their
# multiples. A force may act only beyond a gap.
_APART, _FARTHER = (0.618, -0.382, 0.854, -0.146, 0.472), (1.0, -1.0, 10.0, -10.0, 100.0, -100.0)
# Number of times at which each of these states is compared with other periods of the run, since a
# force may set in late. The times of all states together are spread over a period and over the run.
# All states at all times would cost more than a hundred periods of a sweep.
_LATER = 5
# Tolerance of the test, in eps for each period. The sum t + T is rounded, and cosines of multiples
# of the frequency magnify that rounding.
_SAME = 1024


def repeats(system: System, period: Array, x: Array, count: Array | int) -> Array:
    """Whether field, H and resets near a state x are the same in all of `count` periods, seen at
    some times. Forces of two frequencies, kicks at times of their own, or a slow start are examples
    where they are not. A pulse shorter than a thirtieth of the run may pass unseen, as may a force
    that acts in a narrow range of states.

    In a derivative by the system their derivatives must be the same too: by the frequency of a
    force, but for one that determines the period, they grow with time."""
    return _repeats(with_closed_numbers(system, x), period, x, count)


@eqx.filter_jit
def differs(system: System, period: Array, x: Array) -> Array:
    """Whether the field at a state x clearly differs after one period, which is no period of the
    system then. H and resets may depend on time where no motion feels it."""
    ones = jnp.ones(check.shapes(system, x), x.dtype)
    sides = jnp.stack([ones, -ones])

    def field(side: Array, t: Array) -> Array:
        return field_of(system, t, x, side, jnp.ones_like(side))

    several = jax.vmap(jax.vmap(field, in_axes=(0, None)), in_axes=(None, 0))
    at = jnp.asarray(_PHASES, x.dtype) * period
    now, later = several(sides, at), several(sides, at + period)
    size = jnp.max(abs(now) + abs(later), axis=(0, 1))
    return jnp.any(abs(now - later) > float(jnp.finfo(x.dtype).eps) ** 0.5 * size)


@eqx.filter_custom_jvp
def _repeats(system: System, period: Array, x: Array, count: Array | int) -> Array:
    same = _Values(system, x, count)
    now, later = same(system, period)
    return _are_same(now, later, same.ahead, abs(now) + abs(later))


@_repeats.def_jvp
def _repeats_jvp(primals: tuple, tangents: tuple) -> tuple:
    (system, period, x, count), (by_system, *_) = primals, tangents
    found, here = _repeats(system, period, x, count), stop_gradient((period, x))
    # Equinox has None for tangents that are zero.
    moving = jax.tree.map(
        lambda v, by: None if by is None else stop_gradient(v),
        system,
        by_system,
        is_leaf=lambda v: v is None,
    )
    theta, unravel = ravel_pytree(moving)
    if theta.size:
        rest = jax.tree.map(lambda v: stop_gradient(v) if eqx.is_array(v) else v, system)
        found = found & _rates_repeat(lambda v: eqx.combine(unravel(v), rest), theta, *here, count)
    return found, None


def _rates_repeat(
    system_of: Callable[[Array], System], theta: Array, period: Array, x: Array, count: Array | int
) -> Array:
    """Whether derivatives by the numbers of a system are the same in all periods."""
    same = _Values(system_of(theta), x, count)

    def length(theta: Array) -> Array:
        return jnp.asarray(system_of(theta).period, x.dtype)

    now, later = jax.jacfwd(lambda v: same(system_of(v), length(v)))(theta)
    _, by_time = jax.jvp(lambda v: same(system_of(theta), v)[1], (period,), (period,))
    # Neither a change with the phase may remain nor one with time at a phase.
    part = abs(jax.jacfwd(length)(theta)) / abs(period)
    return _are_same(now, later, same.ahead, abs(now) + abs(later) + abs(by_time)[..., None] * part)


class _Values:
    """Field, H and resets at some states, on some sides and at some phases, now and later."""

    def __init__(self, system: System, x: Array, count: Array | int):
        self.m = m = check.shapes(system, x)
        # A coefficient that depends on time has no effect where its factor is zero, as at rest, or
        # where the sides of two surfaces cancel it.
        x = stop_gradient(x)
        apart = jnp.asarray(np.resize(_APART, x.shape), x.dtype) * (1 + abs(x))
        turned, ones = np.resize((1.0, -1.0), m), np.ones(m)
        self.states = jnp.stack([x, *(x + times * apart for times in _FARTHER)])
        sides = np.stack([ones, -ones, turned, -turned])
        # The turned sides of a single surface are its sides again.
        self.sides = jnp.asarray(sides if ones.size > 1 else sides[:2], x.dtype)
        states = len(self.states)
        times = np.arange(_LATER * states).reshape(_LATER, states).T
        later = np.linspace(0.01, 0.99, times.size)[times]
        phases = np.hstack([np.tile(_PHASES, (states, 1)), later])
        self.phases = jnp.asarray(phases, x.dtype)
        # In another order than the phases: the factor has no divisor in common with the number of
        # times.
        parts = (1 + times * 12 % times.size) / times.size
        parts = np.hstack([np.zeros((states, len(_PHASES))), parts])
        ahead = jnp.asarray(parts, x.dtype) * (jnp.asarray(count, x.dtype) - 1)
        self.ahead = jnp.maximum(jnp.round(ahead), 1)

    def __call__(self, system: System, period: Array) -> tuple[Array, Array]:
        """The values at both times, shape (7 states, 2 or 4 sides, 7 times, numbers)."""

        def values(x: Array, side: Array, t: Array) -> Array:
            # A coefficient of friction has no effect without a reaction.
            own = field_of(system, t, x, side, jnp.ones_like(side)), system.switching(t, x)
            if system.resets:
                count = self.m[0] if self.m else 1
                own += tuple(system.reset(t, x, jnp.asarray(j)) for j in range(count))
            return jnp.concatenate([jnp.ravel(v) for v in own])

        several, at = values, self.phases * period
        for place in ((None, None, 0), (None, 0, None), (0, None, 0)):
            several = jax.vmap(several, in_axes=place)
        now = several(self.states, self.sides, at)
        return now, several(self.states, self.sides, at + self.ahead * period)


def _are_same(now: Array, later: Array, ahead: Array, size: Array) -> Array:
    """Whether arrays of shape (states, sides, times, …) are the same to rounding, some numbers of
    periods `ahead`, shape (states, times)."""
    # The size is the largest over sides and times, since a number may vanish at one of them.
    size = jnp.max(size, axis=(1, 2), keepdims=True)
    ahead = ahead.reshape(len(ahead), 1, -1, *(1,) * (now.ndim - 3))
    same = abs(now - later) <= _SAME * jnp.finfo(now.dtype).eps * ahead * size
    # A field need not be defined away from its state.
    return jnp.all(same | (now == later) | (jnp.isnan(now) & jnp.isnan(later)))


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
