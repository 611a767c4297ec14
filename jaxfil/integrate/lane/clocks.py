"""Clocks in the loop: steps end on ticks, and functions are never evaluated across a tick.

Where a field or H jumps at a tick, the rounding of the time must not decide on which side of the
jump a function is evaluated. Within the loop, functions of time therefore receive a time that is
clamped to the open interval between two ticks, by more than rounding. See `between_ticks`.
"""

import dataclasses
import functools as ft

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.extension import Extension, Step, Verdict
from jaxfil.integrate.lane.problem import SAME_TIME, Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.system.functions import size_of_time
from jaxfil.model.clock import Ticks
from jaxfil.xla.select import select

# A tick closer to a time than this many eps of the time is at it. It is half of `SAME_TIME`, so
# that the rounding of elapsed times does not keep a step from ending on a tick at the end.
_SAME = SAME_TIME / 2


class ClockState(eqx.Module):
    """The state of a lane's clocks."""

    ticks: Ticks
    """The number k of the next tick of each clock, at the time φ + kT."""
    last: Ticks
    """The number of the last tick of each clock in the run."""
    waiting: Array
    """The number of the clock whose tick waits for its switch; −1 without one."""


class Clocks(Extension):
    """The clocks of a system: steps end on ticks, each of which is a discontinuity, and functions
    are evaluated between two of them."""

    def before_step(self, problem: Problem, own: ClockState | None) -> Problem:
        ticks = first_ticks(problem) if own is None else own.ticks
        waiting = None if own is None else own.waiting
        last = ticks if own is None else own.last
        tick, _ = _next_tick(problem, ticks, last)
        return dataclasses.replace(between_ticks(problem, ticks), tick=tick, ticked=waiting)

    def begin(self, problem: Problem, state: LoopState) -> tuple[LoopState, ClockState]:
        none = jnp.full((), -1, jnp.int32)
        return state, ClockState(first_ticks(problem), _last_ticks(problem), none)

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
        _, first = _next_tick(problem, own.ticks, own.last)
        each = enumerate(own.ticks)
        # Only one clock ticks. Another one at the same time has a step of its own.
        ticks = tuple(
            select(ticking & (first == j), k + problem.grid.direction, k) for j, k in each
        )
        none = jnp.full((), -1, jnp.int32)
        # The tick is applied by the pending switch of the next iteration, which evaluates all
        # functions just after the tick. The sides of all surfaces are then decided again, since a
        # field or H may have jumped.
        waiting = select(ticking, first, select(step.switched, none, own.waiting))
        pending = after.pending
        pending = dataclasses.replace(
            pending,
            waits=pending.waits | ticking,
            surfaces=pending.surfaces & ~ticking,
            grazes=pending.grazes & ~ticking,
            jumped=pending.jumped | ticking,
            across=pending.across | ticking,
        )
        return dataclasses.replace(after, pending=pending), ClockState(ticks, own.last, waiting)


def first_ticks(problem: Problem, at_start: bool = True) -> Ticks:
    """The numbers of the first ticks from t0 on, in the direction of time. At the start of a run
    backward in time a tick at t0 is the first one, since the state there is the one after it."""
    # Any other tick at t0 is excluded.
    direction, each = problem.grid.direction, _ticks_near(problem, problem.grid.t0)
    return tuple(
        select(direction > 0, until + 1, until if at_start else since - 1) for until, since in each
    )


def _last_ticks(problem: Problem) -> Ticks:
    """The numbers of the last ticks before the end of the run, or at it if that is its largest
    time."""
    grid = problem.grid
    end = grid.t0 + grid.length if grid.end is None else grid.end
    each = _ticks_near(problem, end)
    return tuple(select(grid.direction > 0, until, until + 1) for until, _ in each)


def _ticks_near(problem: Problem, t: Array) -> list[tuple[Array, Array]]:
    """For each clock the numbers of its last tick up to the time t and of its first from t on,
    which are one tick if it is at t within rounding.

    The rounding depends on the time itself and not on elapsed times. Of runs that are chained at t,
    the one that ends there and the one that starts there then agree on which has the tick.
    """
    system, found = problem.system, []
    for period, phase in system.clocks:
        passed = (t - phase) / period
        # A floor, so that the rounding is not zero at t = 0.
        size = jnp.maximum(size_of_time(system.clocks, abs(t)) / period, 1e-3)
        same = _SAME * system.eps * size
        found.append(stop_gradient((jnp.floor(passed + same), jnp.ceil(passed - same))))
    return found


def _taus(problem: Problem, ticks: Ticks) -> tuple[Array, ...]:
    """The elapsed times of ticks, which carry the derivatives with respect to T and φ."""
    t0 = problem.grid.t0
    # From the whole number k, so that rounding does not add up from tick to tick.
    each = zip(problem.system.clocks, ticks, strict=True)
    return tuple((phase - t0) + k * period for (period, phase), k in each)


def _next_tick(problem: Problem, ticks: Ticks, last: Ticks) -> tuple[Array, Array]:
    """The elapsed time of the earliest upcoming tick, and the number of its clock (the lowest one
    among ticks at the same time). After the `last` tick of a clock its next one counts as beyond
    the end."""
    grid, numbers = problem.grid, zip(ticks, last, strict=True)
    over = [(k - end) * grid.direction > 0 for k, end in numbers]
    taus = zip(over, _taus(problem, ticks), problem.system.clocks, strict=True)
    first, *others = (
        select(beyond, stop_gradient(grid.length + grid.direction * period), tau)
        for beyond, tau, (period, _) in taus
    )
    number = jnp.zeros((), jnp.int32)
    for j, tau in enumerate(others, start=1):
        before = (tau - first) * problem.grid.direction < -problem.same_time(first)
        first, number = select(before, tau, first), select(before, j, number)
    return first, number


def between_ticks(problem: Problem, ticks: Ticks) -> Problem:
    """The problem with its functions restricted to times between the last and the next ticks."""
    grid, direction = problem.grid, problem.grid.direction
    # Ticks k − 1, k and k + 1 of each clock, with times that increase in the direction of the run.
    # They have no derivative, since `ComponentSystem.held` gives a clamped time the derivative of
    # the time.
    numbers = (tuple(k + step * direction for k in ticks) for step in (-1, 0, 1))
    behind, ahead, after = (
        [stop_gradient(direction * tau) for tau in _taus(problem, each)] for each in numbers
    )
    last = ft.reduce(jnp.maximum, behind)
    # Of clocks that tick together one ticks first. Functions are then already evaluated after the
    # ticks of the others.
    same = problem.same_time(last)
    each = zip(ahead, after, strict=True)
    first = ft.reduce(jnp.minimum, (select(a - last <= same, b, a) for a, b in each))
    ends, t0 = (direction * last, direction * first), stop_gradient(grid.t0)
    low, high = t0 + jnp.minimum(*ends), t0 + jnp.maximum(*ends)
    # The window is narrower than the interval by the rounding of a tick at each end, so that a
    # field that computes the tick itself, as t − φ, is on the right side of it.
    margins = (problem.same_time(v - grid.t0) for v in (low, high))
    window = low + next(margins), high - next(margins)
    return dataclasses.replace(problem, system=dataclasses.replace(problem.system, window=window))


def just_after(problem: Problem, t: Array, *, in_time: bool = False) -> Problem:
    """The problem from a time on, up to the next ticks, in the direction of the run or, with
    `in_time`, of growing time."""
    if not problem.system.clocks:
        return problem
    # The first ticks after a t0 are the next ones, so the grid is moved to t.
    grid = dataclasses.replace(problem.grid, t0=stop_gradient(t))
    here = dataclasses.replace(problem, grid=grid)
    return between_ticks(here, first_ticks(here, at_start=in_time))


def just_before(problem: Problem, t: Array) -> Problem:
    """The problem up to a time, from the tick before it, in growing time."""
    if not problem.system.clocks:
        return problem
    length = stop_gradient(problem.grid.length)
    back = -select(length == 0, 1.0, abs(length))  # an empty span has a direction too
    grid = dataclasses.replace(problem.grid, t0=stop_gradient(t), length=back)
    here = dataclasses.replace(problem, grid=grid)
    return between_ticks(here, first_ticks(here, at_start=False))
