"""The length of a trial step.

A trial step goes to the next grid point, saving time or tick, to a contact expected before it, or
as far as steps are trusted, whichever is nearest.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.xla.select import select

# First step length under a tolerance, as a fraction of the grid's step.
_AT_START = 2.0**-6


class Length(eqx.Module):
    """The length of a trial step, and the times that its end coincides with."""

    h: Array
    """Signed length."""
    end: Array
    """Elapsed time at the end."""
    room: Array
    """Signed time from the end of the step to the next grid point, saving time or tick."""
    cutting: Array
    """Whether the step ends at an expected contact."""
    gridded: Array
    """Whether the step ends at a grid point."""
    saving: Array
    """Whether the step ends at a saving time."""
    ticking: Array | None = None
    """Whether the step ends at a tick of a clock; None without clocks."""

    @property
    def known(self) -> Array:
        """Whether the step ends at a grid point, saving time or tick, which are known in advance.

        A step that ends at a contact or at a trusted length is not known in this sense.
        """
        known = self.gridded | self.saving
        return known if self.ticking is None else known | self.ticking

    def beyond(self, time: Array) -> Array:
        """How far a positive time from the end of the step, forward in time, exceeds the room."""
        return jnp.maximum(stop_gradient(time - self.room), 0)


def typical_step(problem: Problem, state: LoopState | None = None) -> Array:
    """The current length of steps. It is the grid's step, or with a tolerance the length that the
    tolerance allows now; without a state, at the start, a small fraction of the grid's step."""
    dt = abs(problem.grid.dt)
    if problem.tableau.tolerance is None:
        return dt
    return _AT_START * dt if state is None else jnp.minimum(state.trust.longest, dt)


def moment(problem: Problem, state: LoopState | None = None) -> Array:
    """A signed time that is short beside a step, after which a motion is off a kink by far more
    than rounding."""
    step = typical_step(problem, state)
    return problem.grid.direction * float(problem.system.eps) ** 0.5 * step


def choose_length(problem: Problem, state: LoopState) -> Length:
    """The length up to the next grid point, saving time or tick, to the contact expected before it,
    or to the trusted length."""
    grid, counts = problem.grid, state.counts
    target, gridded, saving = grid.grid_point(counts.in_period + 1), True, jnp.zeros((), bool)
    wanted, ticking = problem.recording.recorder.next_time(counts.num_saved), None
    if wanted is not None:
        (at, due, more), same = wanted, problem.same_time(target)
        ahead = (at - target) * grid.direction
        # A saving time within rounding of the grid point is the same point, so that no step as
        # short as the rounding remains between them.
        saving = due & (ahead <= same)
        # At the end only the last saving time is, since the loop ends with the last grid point.
        more = more & (counts.index + 1 >= grid.num_steps)
        gridded = ~saving | (ahead >= -same) & ~more
        target = select(gridded, target, at)
    if problem.tick is not None:
        target, ticking = _up_to_tick(problem, state, target, saving)
        gridded, saving = gridded & ~ticking, saving & ~ticking
    tau, trust = state.motion.tau, state.trust
    full, longest = target - tau, grid.direction * trust.longest
    if problem.system.m == 0 and problem.tick is None:
        short = abs(full) > trust.longest
        # Without contacts `h` is not adapted to the rounding of the elapsed time; the state moves
        # even if `end` rounds to `tau`.
        h = select(short, longest, full)
        end = select(short, tau + h, target)
        ends = gridded & ~short, saving & ~short, None if ticking is None else ticking & ~short
        length = Length(h, end, full * 0, saving & False, *ends)
        return _to_crossing(problem, state, length)
    # The target is known exactly, so the time to it does without the rounding of `tau`.
    full, aimed, waits = full - state.tau_low, state.search.length, state.pending.waits
    short = abs(full) > trust.longest
    trusted = select(short, longest, full)
    cutting = (aimed != 0) & (abs(aimed) < abs(trusted)) & ~waits
    whole = ~waits & ~cutting & ~short
    # A pending switch is carried out by a step of length zero.
    h = select(cutting, aimed, select(waits, 0.0, trusted))
    length = Length(
        h=h,
        # A known end is the target itself, without the rounding of a sum.
        end=select(whole, target, state.motion.tau + h),
        room=full - h,
        cutting=cutting,
        gridded=gridded & whole,
        saving=saving & whole,
        ticking=None if ticking is None else ticking & whole,
    )
    return _to_crossing(problem, state, length)


def _up_to_tick(
    problem: Problem, state: LoopState, target: Array, saving: Array
) -> tuple[Array, Array]:
    """The elapsed time at which a step ends, which is the next tick if that is not later than the
    target, and whether it is a tick.

    A tick is a discontinuity of its own. A state to be saved at its time is the one after it, so it
    is saved by a step of length zero that follows, or backward in time before the tick. A target
    that coincides with the tick up to rounding is replaced by it, and then moves with the tick in
    derivatives.
    """
    grid, tick = problem.grid, problem.tick
    assert tick is not None
    known, tau = stop_gradient((tick, state.motion.tau))
    ahead = (known - stop_gradient(target)) * grid.direction
    same = problem.same_time(target)
    ticking = (ahead < -same) | (ahead <= same) & ~(saving & (grid.direction < 0))
    at = select(abs(ahead) <= same, stop_gradient(target), known)
    # Of two ticks at one time the second must not lie before the current time by rounding.
    at = select((at - tau) * grid.direction < 0, tau, at)
    # The tick's value is rounded to `at`; the difference carries its derivative.
    return select(ticking, at + (tick - known), target), ticking


def _to_crossing(problem: Problem, state: LoopState, length: Length) -> Length:
    """The length of a trial step, or of the probe for a crossing where one is sought."""
    if problem.look is None:
        return length
    seeking, h = problem.look.seeking, problem.look.length
    return Length(
        h=select(seeking, h, length.h),
        end=select(seeking, state.motion.tau + h, length.end),
        # The room is measured from the end of the probe.
        room=select(seeking, length.h + length.room - h, length.room),
        cutting=length.cutting & ~seeking,
        gridded=length.gridded & ~seeking,
        saving=length.saving & ~seeking,
        ticking=None if length.ticking is None else length.ticking & ~seeking,
    )
