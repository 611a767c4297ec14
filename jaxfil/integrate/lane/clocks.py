"""Clocks in the loop: steps end on their ticks, and functions never look across one.

A problem whose system has clocks and the ticks that come next enter; the time to the next tick
leaves, and the problem as it is between two ticks. Where a field or H jumps at a tick, no rounding
of the time may tell on which side of it a function is taken. Within the loop, functions of time are
therefore given a time that is in between by more than rounding.
"""

import dataclasses

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem, TimeGrid
from jaxfil.integrate.lane.state import LoopState, StepEnd
from jaxfil.integrate.system.components import Components, any_of, where
from jaxfil.model.clock import Ticks
from jaxfil.xla.select import select


def is_contact(state: LoopState) -> Array:
    """Whether a switch waits that is one of a contact, and not of a clock alone."""
    return state.pending if state.ticks is None else state.pending & any_of(state.hit)


def first_ticks(problem: Problem) -> Ticks:
    """The ticks after t0, in the direction of time."""
    grid, ticks = problem.grid, []
    for period, phase in problem.system.clocks:
        passed = stop_gradient((grid.t0 - phase) / period)
        same = grid.same_time(jnp.zeros_like(passed)) / stop_gradient(period)
        up, down = jnp.floor(passed + same) + 1, jnp.ceil(passed - same) - 1
        ticks.append(select(grid.direction > 0, up, down))
    return tuple(ticks)


def _taus(problem: Problem, ticks: Ticks) -> tuple[Array, ...]:
    """The elapsed times of ticks."""
    t0 = problem.grid.t0
    each = zip(problem.system.clocks, ticks, strict=True)
    return tuple((phase - t0) + k * period for (period, phase), k in each)


def next_tick(problem: Problem, ticks: Ticks) -> Array:
    """The elapsed time of the first of the ticks that come next."""
    first, *others = _taus(problem, ticks)
    for tau in others:
        first = select((tau - first) * problem.grid.direction < 0, tau, first)
    return first


def follow(
    problem: Problem, state: LoopState, after: LoopState, end: StepEnd, what: tuple[Array, Array]
) -> LoopState:
    """`after`, to which `state` has gone on, with its clocks. A step that has ended on a tick waits
    for a switch, in which everything is taken just after it."""
    ticking, switched = what
    ticks = _passed(problem, state, ticking, end.tau)
    met = _met(problem, state, end, ticks)
    assert state.left is not None
    kick = _moved(problem, ticks, end.tau, state.left, end.f)
    return dataclasses.replace(
        after,
        ticks=ticks,
        left=where(ticking, end.f, state.left),
        x=where(switched, after.x + kick, after.x),
        pending=after.pending | ticking,
        hit=where(ticking, met, after.hit),
        graze=after.graze & ~ticking,
        jumped=after.jumped | ticking,
    )


def tick(
    problem: Problem, state: LoopState, end: StepEnd, ticking: Array | None, moved: Array
) -> tuple[Ticks | None, Components, Components]:
    """The next ticks, the state and the field behind the end of a step where there are no
    surfaces."""
    if ticking is None:
        return None, end.x, end.f
    ticking = ticking & moved
    ticks = _passed(problem, state, ticking, end.tau)
    behind = between_ticks(problem, ticks).system
    f = behind.field(problem.grid.t0 + end.tau, end.x, end.mode)
    x = end.x + _moved(problem, ticks, end.tau, end.f, f)
    return ticks, where(ticking, x, end.x), where(ticking, f, end.f)


def _passed(problem: Problem, state: LoopState, ticking: Array, tau: Array) -> Ticks:
    """The next ticks behind an elapsed time at which a lane's step has ended on one."""
    assert state.ticks is not None
    grid, same = problem.grid, problem.grid.same_time(tau)
    after = []
    for k, at in zip(state.ticks, _taus(problem, state.ticks), strict=True):
        here = ticking & ((stop_gradient(at) - tau) * grid.direction <= same)
        after.append(select(here, k + grid.direction, k))
    return tuple(after)


def between_ticks(problem: Problem, ticks: Ticks | None) -> Problem:
    """The problem whose functions look no further than from the last ticks to the next."""
    if ticks is None:
        return problem
    grid, lows, highs = problem.grid, [], []
    last = tuple(k - grid.direction for k in ticks)
    for a, b in zip(_taus(problem, last), _taus(problem, ticks), strict=True):
        lows.append(stop_gradient(grid.t0 + jnp.minimum(a, b)))
        highs.append(stop_gradient(grid.t0 + jnp.maximum(a, b)))
    low, high = lows[0], highs[0]
    for a, b in zip(lows[1:], highs[1:], strict=True):
        low, high = jnp.maximum(low, a), jnp.minimum(high, b)
    window = low + _margin(grid, low), high - _margin(grid, high)
    return dataclasses.replace(problem, system=dataclasses.replace(problem.system, window=window))


def just_after(problem: Problem, t: Array) -> Problem:
    """The problem as it is from a time on, to the next ticks."""
    if not problem.system.clocks:
        return problem
    grid = dataclasses.replace(problem.grid, t0=stop_gradient(t))
    here = dataclasses.replace(problem, grid=grid)
    return between_ticks(here, first_ticks(here))


def _margin(grid: TimeGrid, t: Array) -> Array:
    return grid.same_time(t - grid.t0)


def _met(problem: Problem, state: LoopState, end: StepEnd, ticks: Ticks) -> Components:
    """The surfaces that jump across the state at a tick, or away from one that slides on them,
    given the ticks that come next."""
    after = between_ticks(problem, ticks)
    h = after.system.switching(problem.grid.t0 + end.tau, end.x)
    met = (abs(h) > end.touch) & (state.mode * h <= 0)
    return met if problem.kept is None else ~problem.kept.on & met


def _moved(
    problem: Problem, ticks: Ticks, tau: Array, before: Components, f: Components
) -> Components:
    """What ticks that move do to the state just after them, given those that come next and the
    fields before and after: (f₋ − f₊) δ, with δ zero but for its derivative, as the step has ended
    where it has."""
    last = tuple(k - problem.grid.direction for k in ticks)
    same, moved = problem.grid.same_time(tau), f.like(jnp.zeros_like(tau))
    for when in _taus(problem, last):
        delta = when - tau
        here = abs(stop_gradient(delta)) <= same
        moved = moved + select(here, delta - stop_gradient(delta), 0.0) * (before - f)
    return moved
