"""How far a trial step goes.

A `Problem` and the `LoopState` of a lane enter; the `Length` of the next trial step leaves.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.clocks import next_tick
from jaxfil.integrate.lane.forcing_phase import steps_in_period
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.xla.select import select


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
    ticking: Array | None = None
    """Whether a clock ticks there; None without clocks."""


def choose_length(problem: Problem, state: LoopState) -> Length:
    """To the next grid point or saving time, or to the contact expected before it."""
    grid, recording = problem.grid, problem.recording
    target, gridded, saving = grid.grid_point(steps_in_period(state) + 1), True, jnp.zeros((), bool)
    if recording.save == "ts":
        assert recording.ts is not None
        count = recording.ts.shape[0]
        at = recording.ts[jnp.minimum(state.num_saved, count - 1)]
        ahead = (at - target) * grid.direction
        same = grid.same_time(target)
        saving = (state.num_saved < count) & (ahead <= same)
        gridded = ~saving | (ahead >= -same)
        target = select(gridded, target, at)
    ticking = None
    if state.ticks is not None:
        tick = next_tick(problem, state.ticks)
        ahead = stop_gradient(tick - target) * grid.direction
        same = grid.same_time(target)
        ticking, before = ahead <= same, ahead < -same
        target = select(before, tick, target)
        gridded, saving = gridded & ~before, saving & ~before
    full = target - state.tau
    if problem.system.m == 0:
        gridded = (saving & False) | gridded
        return _to_crossing(
            state, Length(full, target, full * 0, saving & False, gridded, saving, ticking)
        )
    full = full - state.rest
    cutting = (state.cut != 0) & (abs(state.cut) < abs(full)) & ~state.pending
    whole = ~state.pending & ~cutting
    h = select(cutting, state.cut, select(state.pending, 0.0, full))
    end = select(whole, target, state.tau + h)
    length = Length(h, end, full - h, cutting, gridded & whole, saving & whole)
    if ticking is not None:
        length = dataclasses.replace(length, ticking=ticking & whole)
    return _to_crossing(state, length)


def _to_crossing(state: LoopState, length: Length) -> Length:
    """The length of a trial step that only looks for a crossing, where one is sought."""
    if state.watch is None:
        return length
    seeking, h = state.watch.seeking, state.watch.length
    return Length(
        h=select(seeking, h, length.h),
        end=select(seeking, state.tau + h, length.end),
        room=select(seeking, length.h + length.room - h, length.room),
        cutting=length.cutting & ~seeking,
        gridded=length.gridded & ~seeking,
        saving=length.saving & ~seeking,
        ticking=None if length.ticking is None else length.ticking & ~seeking,
    )
