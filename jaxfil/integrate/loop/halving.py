"""Steps that cannot be trusted: refused, and tried again at half their length.

What is known of a trial step enters; whether it is doubted leaves, and how long the next one may
be. The step asked for is the longest:

    refused    a trial step from here is at most half as long
    taken      the next one may be twice as long, up to the length that was refused last: that one
               is tried again after `_CALM` steps, and if it is taken lengths double each time

At the bound of what stability allows that costs a step in nine. For `WATCHED` steps errors are
watched more closely. Grid points, saving times, ticks and contacts are met as ever. Lengths are
constants in derivatives, as those of contacts are.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.extension import Step
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, StepEnd, Trust
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.loop.controller import controlled, hidden
from jaxfil.integrate.steppers.error_estimate import SmoothStep, is_too_long, relative_error
from jaxfil.integrate.steppers.explicit import Trial
from jaxfil.integrate.surfaces.unilateral import sides_of
from jaxfil.integrate.system.components import Components
from jaxfil.xla.select import select

# Steps after which a length that was refused is tried again.
_CALM = 8
# So many steps after a refusal errors are watched more closely.
WATCHED = 128
# A step shorter than this part of the grid's is one of the shortest.
_SHORTEST = 2.0**-10
# So many of those are refused before a run is given up: a jump of the field at some time is closed
# in on in some 50, one that the motion goes to and fro across is never passed. Where a tolerance
# says how long steps are, so many in a row.
_MOST_REFUSED = 96


class Doubt(eqx.Module):
    """What speaks against a trial step."""

    infinite: Array
    """Whether its end is not finite."""
    too_long: Array
    """Whether its estimated error says that it cannot be trusted."""
    given_up: Array
    """Whether half of it would not be tried any more."""
    error: Array | None
    """Its error relative to the tolerance; None where none is asked for."""

    @property
    def refuses(self) -> Array:
        """Whether half of it is tried."""
        return (self.infinite | self.too_long) & ~self.given_up


def smooth_step(
    problem: Problem, state: LoopState, h: Array, f1: Components, trial: Trial
) -> SmoothStep:
    """A trial step of length h, with the field at its end, as its error is judged."""
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
    """What speaks against a trial step."""
    tableau = problem.tableau
    # Where nothing is known of errors, an end that is not finite may follow from steps that were.
    if not tableau.d:
        no = jnp.zeros((), bool)
        return Doubt(infinite, no, ~no, None)
    step = smooth_step(problem, state, length.h, end.motion.f, trial)
    given_up = state.trust.refused >= _MOST_REFUSED
    if tableau.tolerance is not None:
        error = relative_error(tableau, step)
        if problem.system.m > 0:
            error = jnp.maximum(error, hidden(problem, state, length, end))
        return Doubt(infinite, ~(error <= 1), given_up, error)
    too_long = is_too_long(problem.system, tableau, step, sides_of(state.motion.mode))
    return Doubt(infinite, too_long, given_up, None)


def trust_after_free_step(trust: Trust, clear: Array) -> Trust:
    """`next_trust` of a lane at the end of a whole step of the grid, where it is `clear`, so that
    in a batch it halves what it halves alone."""
    return dataclasses.replace(
        trust,
        taken=trust.taken + clear.astype(jnp.int32),
        refused=select(clear, 0, trust.refused),
    )


def next_trust(
    problem: Problem, state: LoopState, taken: Step, refused: Array, doubt: Doubt
) -> Trust:
    """How long the next trial step may be."""
    if doubt.error is not None:
        return controlled(problem, state, taken, refused, doubt.error)
    grid = problem.grid
    trust, h, dt = state.trust, stop_gradient(abs(taken.length.h)), abs(grid.dt)
    goes_on = taken.advances
    steps = trust.taken + goes_on.astype(jnp.int32)
    again = steps >= _CALM
    grows = goes_on & (again | (2 * trust.longest < trust.ceiling))
    longest = select(grows, 2 * trust.longest, trust.longest)
    longest = select(longest < dt, longest, jnp.inf)
    one, short = refused.astype(jnp.int32), h < _SHORTEST * dt
    return Trust(
        longest=select(refused, 0.5 * h, longest),
        ceiling=select(refused, h, select(grows & again, jnp.inf, trust.ceiling)),
        taken=select(refused, 0, steps),
        refused=select(goes_on & ~short, 0, trust.refused + (refused & short).astype(jnp.int32)),
        halvings=trust.halvings + one,
    )
