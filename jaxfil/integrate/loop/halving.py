"""Refusal of steps that cannot be trusted, which are repeated at half their length.

The requested step is the longest:

    refused    the next trial step from here is at most half as long
    taken      the next one may be twice as long, up to the length that was refused last: that one
               is tried again after `_CALM` steps, and if it is taken lengths double each time

Near the stability limit of a method this costs one step in nine. For `WATCHED` steps after a
refusal the error limits are tighter. Grid points, saving times, ticks and contacts are located as
usual. Lengths are constants in derivatives, like the lengths to contacts.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.extension import Step, extensions_of
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, StepEnd, Trust
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.loop.controller import controlled, hidden
from jaxfil.integrate.steppers.error_estimate import SmoothStep, is_too_long, relative_error
from jaxfil.integrate.steppers.explicit import Trial
from jaxfil.integrate.surfaces.unilateral import sides_of
from jaxfil.integrate.system.components import Components
from jaxfil.xla.select import select

# Number of steps after which a refused length is tried again.
_CALM = 8
# Number of steps after a refusal with tighter error limits.
WATCHED = 128
# A step shorter than this part of the grid's step counts as one of the shortest.
_SHORTEST = 2.0**-10
# Number of refusals of the shortest steps after which a run is given up. An undeclared jump of the
# field at a fixed time is located in some 50; one that the motion chatters across is never passed.
# With a tolerance, the number of consecutive refusals.
_MOST_REFUSED = 96


class Doubt(eqx.Module):
    """Reasons to distrust a trial step."""

    infinite: Array
    """Whether its end is not finite."""
    too_long: Array
    """Whether its estimated error is too large."""
    given_up: Array
    """Whether no shorter step will be tried."""
    error: Array | None
    """The error relative to the tolerance; None without a tolerance."""

    @property
    def refuses(self) -> Array:
        """Whether the step is refused, and a shorter one tried."""
        return (self.infinite | self.too_long) & ~self.given_up


def smooth_step(
    problem: Problem, state: LoopState, h: Array, f1: Components, trial: Trial
) -> SmoothStep:
    """A trial step of length h, with the field at its end, in the form that the error tests use."""
    start, grid = state.motion, problem.grid
    return SmoothStep(
        t=grid.t0 + start.tau,
        h=h,
        longest=grid.dt,
        x0=start.x,
        f0=start.f,
        f1=f1,
        trial=trial,
        scale=start.scale,
        watched=state.trust.taken < WATCHED,
        share=grid.share,
    )


def doubted(
    problem: Problem, state: LoopState, length: Length, trial: Trial, end: StepEnd, infinite: Array
) -> Doubt:
    """The reasons to distrust a trial step."""
    tableau = problem.tableau
    # Without an error estimate even a non-finite end may be caused by earlier, unstable steps, so
    # halving the last one would not help.
    if not tableau.d:
        no = jnp.zeros((), bool)
        return Doubt(infinite, no, ~no, None)
    step = smooth_step(problem, state, length.h, end.motion.f, trial)
    given_up = state.trust.refused >= _MOST_REFUSED
    if tableau.tolerance is not None:
        error = relative_error(problem.system, tableau, step, sides_of(state.motion.mode))
        if problem.system.m > 0:
            error = jnp.maximum(error, hidden(problem, state, length, end))
        for extension, own in extensions_of(problem, state):
            more = extension.error(problem, state, own, length.h, end.motion, trial.path)
            error = error if more is None else jnp.maximum(error, more)
        return Doubt(infinite, ~(error <= 1), given_up, error)
    too_long = is_too_long(problem.system, tableau, step, sides_of(state.motion.mode))
    return Doubt(infinite, too_long, given_up, None)


def trust_after_free_step(trust: Trust, clear: Array) -> Trust:
    """`next_trust` for a lane at the end of a whole step of the grid, where it is `clear`. With it,
    a lane halves the same steps in a batch as alone."""
    return dataclasses.replace(
        trust,
        taken=trust.taken + clear.astype(jnp.int32),
        refused=select(clear, 0, trust.refused),
    )


def next_trust(
    problem: Problem, state: LoopState, taken: Step, refused: Array, doubt: Doubt
) -> Trust:
    """The limits of the next trial step."""
    if doubt.error is not None:
        return controlled(problem, state, taken, refused, doubt.error)
    grid = problem.grid
    trust, h, dt = state.trust, stop_gradient(abs(taken.length.h)), abs(grid.dt)
    goes_on = taken.advances
    steps = trust.taken + goes_on.astype(jnp.int32)
    again = steps >= _CALM
    # Below the length that was refused last, lengths double at each step; that length itself is
    # tried again after `_CALM` steps.
    grows = goes_on & (again | (2 * trust.longest < trust.ceiling))
    longest = select(grows, 2 * trust.longest, trust.longest)
    # From the length of the grid's step on there is no limit, which `free_step.is_near` tests.
    longest = select(longest < dt, longest, jnp.inf)
    one, short = refused.astype(jnp.int32), h < _SHORTEST * dt
    return Trust(
        longest=select(refused, 0.5 * h, longest),
        ceiling=select(refused, h, select(grows & again, jnp.inf, trust.ceiling)),
        taken=select(refused, 0, steps),
        refused=select(goes_on & ~short, 0, trust.refused + (refused & short).astype(jnp.int32)),
        halvings=trust.halvings + one,
    )
