"""The controller: how long the next step may be, where a tolerance says it.

The relative error q of a trial step enters (`error_estimate.relative_error`); the length of the
next one leaves, by the formulas of `steppers.adaptive.Adaptive`. A step that was cut short, at a
contact or a saving time, says nothing against a longer one.

A state that is known to its tolerance does not say that contacts are seen: while a mass sticks, any
step is exact, and the force that ends it may go up and down in one. So each guard is looked at in
the middle of a step too, where the cubic that contacts are found on must be right to what the
search allows for, or be far from zero. That error is of order four.
"""

import dataclasses

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import SUSPICIOUS, lower_bound
from jaxfil.integrate.lane.extension import Step
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, Motion, StepEnd, Trust
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.surfaces.filippov import guard
from jaxfil.integrate.system.components import (
    Components,
    dot,
    largest,
    maximum,
    on_each,
    where,
)
from jaxfil.xla.select import select

# Exponents of q and of the last q, times the order; what is kept of a length that would just do.
_NOW, _LAST, _SAFETY = 0.7, 0.4, 0.9
# By how much a length changes at most.
_SHRINKS, _GROWS = 0.2, 10.0
# A guard that is off by less than this part of its least value is far from zero.
_CLEAR = 1 / 4
# The least q: a step without any error.
_EXACT = 1e-12
# The first step is of this part of the time in which the state changes by itself; of a state that
# is zero to within the tolerance, or at rest, this part of the span.
_FIRST, _BLIND = 1e-2, 1e-6


def first_length(problem: Problem, motion: Motion) -> Array:
    """The length of the first trial step."""
    tolerance, grid = problem.tableau.tolerance, problem.grid
    assert tolerance is not None
    allowed = tolerance.atol + tolerance.rtol * abs(motion.x)

    def size(v: Components) -> Array:
        return jnp.sqrt(dot(v / allowed, v / allowed))

    x, f = size(motion.x), size(motion.f)
    told = (x > 1e-5) & (f > 1e-5) & (x < jnp.inf) & (f < jnp.inf)
    span = abs(grid.length)
    length = select(told, _FIRST * x / select(told, f, 1), _BLIND * span)
    longest = jnp.inf if tolerance.dtmax is None else tolerance.dtmax
    return stop_gradient(jnp.minimum(jnp.minimum(length, longest), span))


def hidden(problem: Problem, state: LoopState, length: Length, end: StepEnd) -> Array:
    """By how much a guard in the middle of a trial step is off its cubic, relative to what may be
    off, as an error of the order of the stepper."""
    system, start, stop, h = problem.system, state.motion, end.motion, length.h
    t, x0, x1, f0, f1 = problem.grid.t0 + start.tau + 0.5 * h, start.x, stop.x, start.f, stop.f
    middle = 0.5 * (x0 + x1) + 0.125 * h * (f0 - f1)
    known = stop_gradient((system, t, middle, start.mode))
    g0, d0, g1, d1 = stop_gradient((start.g, h * start.rate, stop.g, h * stop.rate))
    off = abs(guard(*known) - (0.5 * (g0 + g1) + 0.125 * (d0 - d1)))
    low = on_each(lower_bound, g0, d0, g1, d1)
    allowed = maximum(SUSPICIOUS * (abs(d0) + abs(d1)), _CLEAR * low)
    allowed = maximum(allowed, 4 * maximum(start.noise, stop.noise))
    # Where a guard is no number, this says nothing.
    ratio = where(off > 0, off / where(allowed > 0, allowed, 1), 0.0)
    if problem.kept is not None:  # a mode that is kept has no contacts
        ratio = where(problem.kept.on, 0.0, ratio)
    ratio = largest(ratio)
    return ratio ** (problem.tableau.order / 4)


def controlled(
    problem: Problem, state: LoopState, taken: Step, refused: Array, error: Array
) -> Trust:
    """How long the next trial step may be, after one with this relative error."""
    trust, tolerance, order = state.trust, problem.tableau.tolerance, problem.tableau.order
    assert tolerance is not None and trust.error is not None
    h = stop_gradient(abs(taken.length.h))
    goes_on = taken.advances
    # The error of a trial that is not finite is no number.
    least = jnp.maximum(error, _EXACT)
    shorter = jnp.clip(_SAFETY * least ** (-1 / order), _SHRINKS, 1.0)
    shorter = select(least < jnp.inf, shorter, _SHRINKS)
    factor = _SAFETY * least ** (-_NOW / order) * trust.error ** (_LAST / order)
    # After a refusal it does not grow.
    factor = jnp.clip(factor, _SHRINKS, select(trust.taken == 0, 1.0, _GROWS))
    cut, following = h < trust.longest, factor * h
    following = select(cut, jnp.maximum(following, trust.longest), following)
    longest = select(refused, shorter * h, select(goes_on, following, trust.longest))
    if tolerance.dtmax is not None:
        longest = jnp.minimum(longest, tolerance.dtmax)
    # A step that times cannot tell from none is no way out.
    one, short = refused.astype(jnp.int32), h < problem.grid.same_time(state.motion.tau)
    return dataclasses.replace(
        trust,
        longest=longest,
        taken=select(refused, 0, trust.taken + goes_on.astype(jnp.int32)),
        refused=select(goes_on & ~short, 0, trust.refused + one),
        halvings=trust.halvings + one,
        error=select(goes_on & ~cut, least, trust.error),
    )
