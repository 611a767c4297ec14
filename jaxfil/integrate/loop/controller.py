"""The controller of the step length under a tolerance.

From the relative error q of a trial step (`error_estimate.relative_error`) it chooses the length of
the next one, by the formulas in `steppers.adaptive.Adaptive`. A step that was cut short, at a
contact or a saving time, is no evidence against a longer one.

An accurate state does not imply that contacts are detected. While a mass sticks, every step is
exact, and the force that ends the stick may rise and fall within one. Each guard is therefore also
evaluated in the middle of a step, where the cubic used in the search must be accurate within the
search's allowance, or far from zero. Its error is of order four.
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

# Exponents of q and of the last q, times the order, and the safety factor of the length.
_NOW, _LAST, _SAFETY = 0.7, 0.4, 0.9
# Bounds of the factor between consecutive lengths.
_SHRINKS, _GROWS = 0.2, 10.0
# A guard whose error is below this part of its lower bound is far from zero.
_CLEAR = 1 / 4
# The least q, in place of zero.
_EXACT = 1e-12
# The first step, as a part of the time in which the state changes by its own size. For a state that
# is zero to within the tolerance, or at rest, it is the second part of the span.
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
    """The deviation of a guard from its cubic in the middle of a trial step, relative to the
    allowed one, as an error of the order of the stepper."""
    system, start, stop, h = problem.system, state.motion, end.motion, length.h
    t, x0, x1, f0, f1 = problem.grid.t0 + start.tau + 0.5 * h, start.x, stop.x, start.f, stop.f
    # Hermite's cubics in the middle of the step, for the state here and for the guard below.
    middle = 0.5 * (x0 + x1) + 0.125 * h * (f0 - f1)
    known = stop_gradient((system, t, middle, start.mode))
    g0, d0, g1, d1 = stop_gradient((start.g, h * start.rate, stop.g, h * stop.rate))
    off = abs(guard(*known) - (0.5 * (g0 + g1) + 0.125 * (d0 - d1)))
    low = on_each(lower_bound, g0, d0, g1, d1)
    allowed = maximum(SUSPICIOUS * (abs(d0) + abs(d1)), _CLEAR * low)
    allowed = maximum(allowed, 4 * maximum(start.noise, stop.noise))
    # A NaN guard makes the trial non-finite, which is handled elsewhere; the ratio ignores it.
    ratio = where(off > 0, off / where(allowed > 0, allowed, 1), 0.0)
    # A step whose guard ends below zero is cut at its contact, and the shorter one is examined. An
    # H that has jumped below zero at the start would be refused at any length.
    ratio = where(g1 < -stop.noise, 0.0, ratio)
    if problem.kept is not None:  # a lane pinned to its mode has no contacts
        ratio = where(problem.kept.on, 0.0, ratio)
    ratio = largest(ratio)
    return ratio ** (problem.tableau.order / 4)


def controlled(
    problem: Problem, state: LoopState, taken: Step, refused: Array, error: Array
) -> Trust:
    """The limits of the next trial step, after one with this relative error."""
    trust, tolerance, order = state.trust, problem.tableau.tolerance, problem.tableau.order
    assert tolerance is not None and trust.error is not None
    h = stop_gradient(abs(taken.length.h))
    goes_on = taken.advances
    # The error of a trial that is not finite is NaN, and then the step shrinks most.
    least = jnp.maximum(error, _EXACT)
    shorter = jnp.clip(_SAFETY * least ** (-1 / order), _SHRINKS, 1.0)
    shorter = select(least < jnp.inf, shorter, _SHRINKS)
    factor = _SAFETY * least ** (-_NOW / order) * trust.error ** (_LAST / order)
    # Directly after a refusal the length does not grow.
    factor = jnp.clip(factor, _SHRINKS, select(trust.taken == 0, 1.0, _GROWS))
    cut, following = h < trust.longest, factor * h
    following = select(cut, jnp.maximum(following, trust.longest), following)
    longest = select(refused, shorter * h, select(goes_on, following, trust.longest))
    if tolerance.dtmax is not None:
        longest = jnp.minimum(longest, tolerance.dtmax)
    # A step shorter than the spacing of times does not count as progress.
    one, short = refused.astype(jnp.int32), h < problem.same_time(state.motion.tau)
    return dataclasses.replace(
        trust,
        longest=longest,
        taken=select(refused, 0, trust.taken + goes_on.astype(jnp.int32)),
        refused=select(goes_on & ~short, 0, trust.refused + one),
        halvings=trust.halvings + one,
        # A step that was cut short is no evidence of the error of the next one.
        error=select(goes_on & ~cut, least, trust.error),
    )
