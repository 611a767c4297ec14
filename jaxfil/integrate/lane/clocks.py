"""Clocks in the loop: steps end on their ticks, and functions never look across one.

A problem whose system has clocks and the ticks that come next enter; the time to the next tick
leaves, and the problem as it is between two ticks. Where a field or H jumps at a tick, no rounding
of the time may tell on which side of it a function is taken. Within the loop, functions of time are
therefore given a time that is in between by more than rounding.
"""

import dataclasses
import functools as ft

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.extension import Extension, Step, Verdict
from jaxfil.integrate.lane.problem import SAME_TIME, Problem
from jaxfil.integrate.lane.state import LoopState, Motion, StepEnd
from jaxfil.integrate.system.components import Components, where
from jaxfil.model.clock import Ticks
from jaxfil.xla.select import select


class ClockState(eqx.Module):
    """What a lane knows of its clocks."""

    ticks: Ticks
    """The next tick of each clock, counted."""
    field: Components | None
    """The field with which a tick was reached that waits for its switch, n components; None where
    there are no surfaces, and a tick is passed at once."""


class Clocks(Extension):
    """The clocks of a system: steps end on ticks, and functions see what is between two of them."""

    def before_step(self, problem: Problem, own: ClockState | None) -> Problem:
        ticks = first_ticks(problem) if own is None else own.ticks
        tick = next_tick(problem, ticks)
        return dataclasses.replace(between_ticks(problem, ticks), tick=tick)

    def begin(self, problem: Problem, state: LoopState) -> tuple[LoopState, ClockState]:
        still = state.motion.x.like(jnp.zeros_like(state.motion.tau))
        return state, ClockState(first_ticks(problem), still if problem.system.m else None)

    def after_step(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: ClockState,
        step: Step,
        verdict: Verdict | None,
    ) -> tuple[LoopState, ClockState]:
        assert step.length.ticking is not None
        ticking = step.length.ticking & step.accepted & step.moved
        ticks = _passed(problem, own, ticking, step.end.motion.tau)
        if own.field is None:
            motion = _behind(problem, after.motion, ticks, ticking)
            return dataclasses.replace(after, motion=motion), ClockState(ticks, None)
        # A switch waits, in which everything is taken just after the tick.
        end, pending = step.end.motion, after.pending
        kick = _moved(problem, ticks, end.tau, own.field, end.f)
        x = where(step.switched, after.motion.x + kick, after.motion.x)
        after = dataclasses.replace(
            after,
            motion=dataclasses.replace(after.motion, x=x),
            pending=dataclasses.replace(
                pending,
                waits=pending.waits | ticking,
                surfaces=where(ticking, _met(problem, state, step.end, ticks), pending.surfaces),
                grazes=pending.grazes & ~ticking,
                jumped=pending.jumped | ticking,
            ),
        )
        return after, ClockState(ticks, where(ticking, end.f, own.field))


def first_ticks(problem: Problem) -> Ticks:
    """The ticks after t0, in the direction of time."""
    grid, ticks = problem.grid, []
    for period, phase in problem.system.clocks:
        passed = stop_gradient((grid.t0 - phase) / period)
        same = _same_time(problem, jnp.zeros_like(passed)) / stop_gradient(period)
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


def _behind(problem: Problem, motion: Motion, ticks: Ticks, ticking: Array) -> Motion:
    """A motion without surfaces just behind a tick, given the ticks that come next."""
    system, t = between_ticks(problem, ticks).system, problem.grid.t0 + motion.tau
    f = system.field(t, motion.x, motion.mode)
    x = motion.x + _moved(problem, ticks, motion.tau, motion.f, f)
    x, f = where(ticking, x, motion.x), where(ticking, f, motion.f)
    return dataclasses.replace(motion, x=x, f=f)


def _passed(problem: Problem, own: ClockState, ticking: Array, tau: Array) -> Ticks:
    """The next ticks behind an elapsed time at which a lane's step has ended on one."""
    grid, same, after = problem.grid, _same_time(problem, tau), []
    for k, at in zip(own.ticks, _taus(problem, own.ticks), strict=True):
        here = ticking & ((stop_gradient(at) - tau) * grid.direction <= same)
        after.append(select(here, k + grid.direction, k))
    return tuple(after)


def between_ticks(problem: Problem, ticks: Ticks) -> Problem:
    """The problem whose functions look no further than from the last ticks to the next."""
    grid, lows, highs = problem.grid, [], []
    last = tuple(k - grid.direction for k in ticks)
    for a, b in zip(_taus(problem, last), _taus(problem, ticks), strict=True):
        lows.append(stop_gradient(grid.t0 + jnp.minimum(a, b)))
        highs.append(stop_gradient(grid.t0 + jnp.maximum(a, b)))
    low, high = lows[0], highs[0]
    for a, b in zip(lows[1:], highs[1:], strict=True):
        low, high = jnp.maximum(low, a), jnp.minimum(high, b)
    margins = (_same_time(problem, v - grid.t0) for v in (low, high))
    window = low + next(margins), high - next(margins)
    return dataclasses.replace(problem, system=dataclasses.replace(problem.system, window=window))


def just_after(problem: Problem, t: Array) -> Problem:
    """The problem as it is from a time on, to the next ticks."""
    if not problem.system.clocks:
        return problem
    grid = dataclasses.replace(problem.grid, t0=stop_gradient(t))
    here = dataclasses.replace(problem, grid=grid)
    return between_ticks(here, first_ticks(here))


def _same_time(problem: Problem, tau: Array) -> Array:
    """The rounding of ticks near an elapsed time: that of times, and that of phases, which may be
    much larger, in φ + kT as in a field's own t − φ."""
    grid, phases = problem.grid, [abs(stop_gradient(phase)) for _, phase in problem.system.clocks]
    largest = ft.reduce(jnp.maximum, phases)
    return grid.same_time(tau) + SAME_TIME * problem.system.eps * largest


def _met(problem: Problem, state: LoopState, end: StepEnd, ticks: Ticks) -> Components:
    """The surfaces that jump across the state at a tick, or away from one that slides on them,
    given the ticks that come next."""
    after = between_ticks(problem, ticks)
    h = after.system.switching(problem.grid.t0 + end.motion.tau, end.motion.x)
    met = (abs(h) > end.gathered) & (state.motion.mode * h <= 0)
    return met if problem.kept is None else ~problem.kept.on & met


def _moved(
    problem: Problem, ticks: Ticks, tau: Array, before: Components, f: Components
) -> Components:
    """What ticks that move do to the state just after them, given those that come next and the
    fields before and after: (f₋ − f₊) δ, with δ zero but for its derivative, as the step has ended
    where it has."""
    last = tuple(k - problem.grid.direction for k in ticks)
    same, moved = _same_time(problem, tau), f.like(jnp.zeros_like(tau))
    for when in _taus(problem, last):
        delta = when - tau
        here = abs(stop_gradient(delta)) <= same
        moved = moved + select(here, delta - stop_gradient(delta), 0.0) * (before - f)
    return moved
