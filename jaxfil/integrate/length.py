"""How far a trial step goes.

A `Problem` and the `LoopState` of a lane enter; the `Length` of the next trial step leaves.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.problem import Problem
from jaxfil.integrate.state import LoopState


class Length(eqx.Module):
    """How far a trial step goes, and what is at its end."""

    h: Array
    """Signed length."""
    end: Array
    """Elapsed time at its end."""
    room: Array
    """Signed time from there to the next grid or saving time."""
    cutting: Array
    """Whether an expected contact is at its end,"""
    gridded: Array
    """a grid point,"""
    saving: Array
    """or a time to be saved."""


def choose_length(problem: Problem, state: LoopState) -> Length:
    """To the next grid point or saving time, or to the contact expected before it."""
    grid, recording = problem.grid, problem.recording
    target, gridded, saving = grid.grid_point(state.index + 1), True, jnp.zeros((), bool)
    if recording.save == "ts":
        assert recording.ts is not None
        count = recording.ts.shape[0]
        at = recording.ts[jnp.minimum(state.num_saved, count - 1)]
        ahead = (at - target) * grid.direction
        same = grid.same_time(target)
        saving = (state.num_saved < count) & (ahead <= same)
        gridded = ~saving | (ahead >= -same)
        target = jnp.where(gridded, target, at)
    full = target - state.tau
    if problem.system.m == 0:
        return Length(full, target, full * 0, saving & False, (saving & False) | gridded, saving)
    full = full - state.rest
    cutting = (state.cut != 0) & (abs(state.cut) < abs(full)) & ~state.pending
    whole = ~state.pending & ~cutting
    h = jnp.where(cutting, state.cut, jnp.where(state.pending, 0.0, full))
    end = jnp.where(whole, target, state.tau + h)
    return Length(h, end, full - h, cutting, gridded & whole, saving & whole)
