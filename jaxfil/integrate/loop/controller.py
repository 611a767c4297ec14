"""The controller: how long the next step may be, where a tolerance says it.

The relative error q of a trial step enters (`error_estimate.relative_error`); the length of the
next one leaves, by the formulas of `steppers.adaptive.Adaptive`. A step that was cut short, at a
contact or a saving time, says nothing against a longer one.
"""

import dataclasses

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.extension import Step
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, Motion, Trust
from jaxfil.integrate.system.components import Components, dot
from jaxfil.xla.select import select

# Exponents of q and of the last q, times the order; what is kept of a length that would just do.
_NOW, _LAST, _SAFETY = 0.7, 0.4, 0.9
# By how much a length changes at most.
_SHRINKS, _GROWS = 0.2, 10.0
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


def controlled(
    problem: Problem, state: LoopState, taken: Step, refused: Array, error: Array
) -> Trust:
    """How long the next trial step may be, after one with this relative error."""
    trust, tolerance, order = state.trust, problem.tableau.tolerance, problem.tableau.order
    assert tolerance is not None and trust.error is not None
    h = stop_gradient(abs(taken.length.h))
    goes_on = (taken.moved & taken.accepted & (h > 0)) | taken.lands
    # The error of a trial that is not finite is no number.
    least = jnp.maximum(error, _EXACT)
    shorter = jnp.clip(_SAFETY * least ** (-1 / order), _SHRINKS, 1.0)
    shorter = select(least < jnp.inf, shorter, _SHRINKS)
    factor = _SAFETY * least ** (-_NOW / order) * trust.error ** (_LAST / order)
    # After a refusal it does not grow.
    factor = jnp.clip(factor, _SHRINKS, select(trust.refused > 0, 1.0, _GROWS))
    cut, following = h < trust.longest, factor * h
    following = select(cut, jnp.maximum(following, trust.longest), following)
    longest = select(refused, shorter * h, select(goes_on, following, trust.longest))
    if tolerance.dtmax is not None:
        longest = jnp.minimum(longest, tolerance.dtmax)
    one = refused.astype(jnp.int32)
    return dataclasses.replace(
        trust,
        longest=longest,
        refused=select(goes_on, 0, trust.refused + one),
        halvings=trust.halvings + one,
        error=select(goes_on & ~cut, least, trust.error),
    )
