"""How far a trial step goes.

A `Problem` and the `LoopState` of a lane enter; the `Length` of the next trial step leaves: to the
next grid point, saving time or tick, to a contact expected before it, or as far as steps have been
trusted lately, whichever is nearest.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.xla.select import select

# Where a tolerance says how long steps are, one at the start is taken for this part of the grid's.
_AT_START = 2.0**-6


class Length(eqx.Module):
    """How far a trial step goes, and what is at its end."""

    h: Array
    """Signed length."""
    end: Array
    """Elapsed time at its end."""
    room: Array
    """Signed time from there to the next grid point, saving time or tick."""
    cutting: Array
    """Whether an expected contact is at its end."""
    gridded: Array
    """Whether a grid point is."""
    saving: Array
    """Whether a time to be saved is."""
    ticking: Array | None = None
    """Whether a tick of a clock is; None without clocks."""

    @property
    def known(self) -> Array:
        """Whether its end is one of these times, which are known."""
        known = self.gridded | self.saving
        return known if self.ticking is None else known | self.ticking


def typical_step(problem: Problem, state: LoopState | None = None) -> Array:
    """The length of steps here: that of the grid, or where a tolerance says it the one that it
    allows now; without a state, at the start, a small part of the grid's."""
    dt = abs(problem.grid.dt)
    if problem.tableau.tolerance is None:
        return dt
    return _AT_START * dt if state is None else jnp.minimum(state.trust.longest, dt)


def choose_length(problem: Problem, state: LoopState) -> Length:
    """To the next grid point, saving time or tick, to the contact expected before it, or as far as
    a step is trusted."""
    grid, counts = problem.grid, state.counts
    target, gridded, saving = grid.grid_point(counts.in_period + 1), True, jnp.zeros((), bool)
    wanted, ticking = problem.recording.recorder.next_time(counts.num_saved), None
    if wanted is not None:
        (at, due), same = wanted, grid.same_time(target)
        ahead = (at - target) * grid.direction
        saving = due & (ahead <= same)
        gridded = ~saving | (ahead >= -same)
        target = select(gridded, target, at)
    if problem.tick is not None:
        target, ticking = _up_to_tick(problem, state, target)
        gridded, saving = gridded & ~ticking, saving & ~ticking
    tau, trust = state.motion.tau, state.trust
    full, longest = target - tau, grid.direction * trust.longest
    if problem.system.m == 0:
        short = abs(full) > trust.longest
        # The state moves, be it by less than times tell apart.
        h = select(short, longest, full)
        end = select(short, tau + h, target)
        ends = gridded & ~short, saving & ~short, None if ticking is None else ticking & ~short
        length = Length(h, end, full * 0, saving & False, *ends)
        return _to_crossing(problem, state, length)
    full, aimed, waits = full - state.tau_low, state.search.length, state.pending.waits
    short = abs(full) > trust.longest
    trusted = select(short, longest, full)
    cutting = (aimed != 0) & (abs(aimed) < abs(trusted)) & ~waits
    whole = ~waits & ~cutting & ~short
    h = select(cutting, aimed, select(waits, 0.0, trusted))
    length = Length(
        h=h,
        end=select(whole, target, state.motion.tau + h),
        room=full - h,
        cutting=cutting,
        gridded=gridded & whole,
        saving=saving & whole,
        ticking=None if ticking is None else ticking & whole,
    )
    return _to_crossing(problem, state, length)


def _up_to_tick(problem: Problem, state: LoopState, target: Array) -> tuple[Array, Array]:
    """The elapsed time up to which a step goes, which is the next tick if that comes before the
    target or with it, and whether it does.

    A tick is a discontinuity of its own: what is saved at its time is saved after it, by a step of
    length zero. So is a time that the tick falls on but for rounding, which then moves with it.
    """
    grid, tick = problem.grid, problem.tick
    assert tick is not None
    known, tau = stop_gradient((tick, state.motion.tau))
    ahead = (known - stop_gradient(target)) * grid.direction
    same = grid.same_time(target)
    # Backward in time a tick at the end is not in the span, which is open where it is least.
    last = (grid.direction < 0) & (state.counts.index + 1 >= grid.num_steps)
    ticking = (ahead < -same) | (ahead <= same) & ~last
    at = select(abs(ahead) <= same, stop_gradient(target), known)
    # One of two ticks at one time comes after the other.
    at = select((at - tau) * grid.direction < 0, tau, at)
    return select(ticking, at + (tick - known), target), ticking


def _to_crossing(problem: Problem, state: LoopState, length: Length) -> Length:
    """The length of a trial step that only looks for a crossing, where one is sought."""
    if problem.look is None:
        return length
    seeking, h = problem.look.seeking, problem.look.length
    return Length(
        h=select(seeking, h, length.h),
        end=select(seeking, state.motion.tau + h, length.end),
        room=select(seeking, length.h + length.room - h, length.room),
        cutting=length.cutting & ~seeking,
        gridded=length.gridded & ~seeking,
        saving=length.saving & ~seeking,
        ticking=None if length.ticking is None else length.ticking & ~seeking,
    )
