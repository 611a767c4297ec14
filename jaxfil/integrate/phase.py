"""The phase of the forcing: elapsed times that start anew in each of its periods.

A lane that has come to the end of a forcing period enters; the same lane leaves, at time zero of
the next one, where the forced system is what it was.

A time that grows is known less and less well: after 300 periods to 5e-14 in float64, and to 2e-5
in float32, and the phase of the forcing, and every contact, no better. A phase stays as small as
the period, and at the start of one it is exact.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.problem import TimeGrid
from jaxfil.integrate.state import LoopState


def next_period(grid: TimeGrid, state: LoopState) -> LoopState:
    """The lane, in the next period of the forcing if it has come to the end of one."""
    if grid.forcing is None:
        return state
    assert state.period_start is not None
    period, turn = grid.forcing.length, state.turn
    over = state.index - state.period_start >= grid.forcing.steps
    if turn is not None:
        turn = dataclasses.replace(turn, tau=jnp.where(over, turn.tau - period, turn.tau))
    return dataclasses.replace(
        state,
        tau=jnp.where(over, 0.0, state.tau),
        contact_tau=jnp.where(over, state.contact_tau - period, state.contact_tau),
        turn=turn,
        period_start=jnp.where(over, state.index, state.period_start),
    )


def steps_in_period(state: LoopState) -> Array:
    """Grid steps completed in this period of the forcing; since t0 where time goes on."""
    return state.index if state.period_start is None else state.index - state.period_start
