"""The decision whether a trial step is too long to be trusted, from its estimated error.

A step is too long if the error of a component is a hundredth or more of its change. The change is
measured by the largest of the displacement, of |h f| at both ends (for turning points), and of the
state. The criterion depends neither on units nor on states that are zero: a step of a motion at
rest is not too long, since its error is rounding. The estimates are of a lower order than the step,
whose own error is far smaller. Beyond the stability limit of a method they are half of the state or
more, at any size of the state, so that the growth of an unstable motion is always detected.

In a long chain that is pulled at one end, a distant mass starts to move like a high power of time,
above the method's order, so that the relative error of its first steps is 1 and irrelevant. For
states of more than a few components, an error is therefore also compared with the change that
other components cause in it (`_reached`).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.steppers.explicit import Tableau, Trial
from jaxfil.integrate.steppers.rosenbrock import RosenbrockTableau
from jaxfil.integrate.system.components import (
    Components,
    any_of,
    dot,
    maximum,
    minimum,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select

# Relative estimated error up to which a step is accepted, and the limit after a recent refusal,
# which is lower because an unstable motion could otherwise grow by errors just below the first.
_GROSS, _WATCHED = 1e-2, 1e-5
# The same limits for a crude estimate; beyond the stability of RK4 it exceeds the state.
_CRUDE, _CRUDE_WATCHED = 1.0, 1e-3
# The smallest relative tolerance, in eps.
_LEAST_RTOL = 16
# Rounding of a step, in eps of the terms that are summed in it.
_ROUNDING = 64
# An error below this part of the change that other components cause in one is ignored.
_FAINT = 1e-4
# A motion starts with a power of time above the order of a method only through many components: at
# least this number for a power above the lowest order of an estimate.
_CHAIN = 4
# Depth to which rounding is followed from component to component, and its largest growth by one
# more; a step with a larger growth is beyond the stability of every explicit method.
_DEEP, _STABLE = 4, 16


class SmoothStep(eqx.Module):
    """A step of length h from (t, x0), and its fields at both ends."""

    t: Array
    h: Array
    longest: Array
    """The longest step allowed."""
    x0: Components
    f0: Components
    f1: Components
    trial: Trial
    scale: Components
    """The running maximum of |x| (see `guards.larger`)."""
    watched: Array
    """Whether steps were refused recently."""
    share: Array | None
    """The factor on the usual error limit; None stands for 1."""


def relative_error(
    system: ComponentSystem, tableau: Tableau, step: SmoothStep, sides: Components
) -> Array:
    """The estimated error of a step relative to the tolerance of its tableau, the q of `Adaptive`;
    NaN where it is not finite."""
    assert tableau.tolerance is not None
    step = stop_gradient(step)
    error = abs(step.h * (step.trial.error + tableau.d[-1] * step.f1))
    rtol = max(tableau.tolerance.rtol, _LEAST_RTOL * float(jnp.finfo(step.h.dtype).eps))
    allowed = tableau.tolerance.atol + rtol * maximum(abs(step.x0), abs(step.trial.x))
    if tableau.tolerance.atol == 0:
        # A component that is zero, as the speed of a mass that sticks, has an error of rounding.
        allowed = maximum(allowed, _ROUNDING * system.eps * _terms_of_step(system, step, sides))
    # A component that stays zero has no error, even with an absolute tolerance of zero.
    missed = where(error > 0, error / where(allowed > 0, allowed, 1), 0.0 * error)
    missed = where((error > 0) & (allowed == 0), jnp.inf, missed)
    norm = jnp.sqrt(dot(missed, missed) / missed.size)
    return norm if step.share is None else norm / step.share


def _terms_of_step(system: ComponentSystem, step: SmoothStep, sides: Components) -> Components:
    """The size of the terms summed in a step."""
    return terms_in_step(system.n, step.h, *_in_the_middle(system, step, sides))


def _in_the_middle(
    system: ComponentSystem, step: SmoothStep, sides: Components
) -> tuple[tuple[Array, Components, Components], Callable]:
    """The time, the state and the field in the middle of a step on some sides, and the linear map
    of their changes to the change of the field."""
    t, x = step.t + 0.5 * step.h, 0.5 * (step.x0 + step.trial.x)
    f, push = jax.linearize(lambda t, x: system.field(t, x, sides), t, x)
    return (t, x, f), push


def may_be_too_long(tableau: Tableau, step: SmoothStep) -> Array:
    """Whether a step must be examined by `is_too_long`. This is cheap, and a False is always right,
    since the states at the ends are part of the measure that the error is compared with."""
    if not tableau.d:
        return jnp.zeros((), bool)
    missed, share = _missed(tableau, step)
    ends = stop_gradient(maximum(abs(step.x0), abs(step.trial.x)))
    return any_of(missed > share * ends)


def is_too_long(
    system: ComponentSystem, tableau: Tableau, step: SmoothStep, sides: Components
) -> Array:
    """Whether a step of a lane on these sides cannot be trusted (see the top of this file)."""
    if not tableau.d:
        return jnp.zeros((), bool)
    step = stop_gradient(step)
    suspect = may_be_too_long(tableau, step)

    def gross(step: SmoothStep, sides: Components) -> Array:
        return _is_gross(system, tableau, step, sides)

    def fine(step: SmoothStep, sides: Components) -> Array:
        return jnp.zeros((), bool)

    return suspect & system.where_any(suspect, gross, fine, step, sides)


def _is_gross(
    system: ComponentSystem, tableau: Tableau, step: SmoothStep, sides: Components
) -> Array:
    """Whether the error of a step exceeds both its limit and rounding."""
    missed, share = _missed(tableau, step)
    h, x0, x1 = step.h, step.x0, step.trial.x
    middle, push = _in_the_middle(system, step, sides)
    measure = _measure(h, x0, x1, step.f0, step.f1)
    if isinstance(tableau, RosenbrockTableau):
        # A component that is damped within the step need not be accurate relative to itself.
        measure = maximum(measure, step.scale)
        # The coefficients are large and cancel, which magnifies the rounding of the stages.
        large = max(sum(map(abs, row)) for row in tableau.coupling)
        rounded = large * _damped_terms(h, middle, push)
    else:
        rounded = terms_in_step(system.n, h, middle, push)
    faint = measure.like(jnp.zeros_like(h))
    if system.n > _CHAIN:
        faint = _reached(system.n, h, push, measure)
    # The state is rounded in proportion to its recent maximum.
    known = maximum(maximum(abs(x0), abs(x1)), step.scale)
    # At a jump of the field no step is accurate, so halving would go on without end; the rounding
    # is therefore counted in steps of the longest length.
    known = known + abs(step.longest / h * (x1 - x0))
    rounding = _ROUNDING * system.eps * (rounded + known)
    return any_of(missed > maximum(maximum(share * measure, rounding), _FAINT * faint))


def _reached(n: int, h: Array, push: Callable, size: Components) -> Components:
    """The distance that motions of these sizes move each component in a step of length h, through
    all others: s_i = max(size_i, |h Σ_j ∂f_i/∂x_j s_j|). Zero where the recursion does not settle,
    which means that the step is long compared with the rates of the field."""

    def passed_on(_: Array | int, now: tuple[Components, Array]) -> tuple[Components, Array]:
        size, _grows = now
        after = maximum(size, abs(h) * _change(push, 0 * h, size))
        return after, any_of(after > size)

    # The longest path through all components has n − 1 links, so n passes must reach a fixed point.
    first = size, jnp.zeros((), bool)
    size, grows = jax.lax.fori_loop(0, n, passed_on, first)
    return where(grows, 0.0, size)


def _measure(
    h: Array, x0: Components, x1: Components, f0: Components, f1: Components
) -> Components:
    """The size of the change to which the error of each component is compared."""
    # At a jump of the field that is not declared as a surface, the relative error of the
    # displacement does not decrease with the step. Where the state is not zero, such a step is
    # compared with the state and accepted, as the error of any undeclared jump is the user's.
    state = maximum(abs(x0), abs(x1))
    # The smaller of the two, since after an unstable step the field may be a thousand times larger
    # than the state.
    moved = maximum(abs(x1 - x0), abs(h) * minimum(abs(f0), abs(f1)))
    return maximum(moved, state)


def terms_in_step(
    n: int, h: Array, at: tuple[Array, Components, Components], push: Callable
) -> Components:
    """The size of the terms summed in a step of length h, given a time, the state and the field.

    Rounding of the state and of h f propagates through the derivative of the field from component
    to component. Zero for a step so long that this grows without bound.
    """
    t, x, f = at

    def passed_on(size: Components) -> Components:
        return size + abs(h) * _change(push, abs(t), size)

    size = abs(x) + abs(h * f)
    size = jax.lax.fori_loop(0, min(n, _DEEP), lambda _, size: passed_on(size), size)
    return where(any_of(passed_on(size) > _STABLE * size), 0.0, size)


def _damped_terms(h: Array, at: tuple[Array, Components, Components], push: Callable) -> Components:
    """The same for a step that damps what its field damps: h f_i/(1 + |h ∂f_i/∂x_i|) of the terms
    of f."""
    t, x, f = at
    terms = abs(h) * (abs(f) + _change(push, abs(t), abs(x)))
    return terms / (1 + abs(h * _diagonal(push, x, 0 * h)))


def _diagonal(push: Callable, x: Components, zero: Array) -> Components:
    """∂f_i/∂x_i."""
    if x.is_array:
        eye = jnp.eye(x.parts[0].shape[0], dtype=zero.dtype)
        columns = jax.vmap(lambda v: push(zero, Components([v])).parts[0])(eye)
        return Components([jnp.diagonal(columns)])
    n = len(x.parts)
    units = [Components(zero + float(i == k) for i in range(n)) for k in range(n)]
    return Components(push(zero, unit).parts[k] for k, unit in enumerate(units))


def _change(push: Callable, by_t: Array, size: Components) -> Components:
    """The size of the change of a field for changes of time and state of these sizes. It is the sum
    over two directions, so that terms that cancel in one do not cancel in the other."""
    one, other = (push(by_t, _generic(size, sign)) for sign in (1, -1))
    return abs(one) + abs(other)


def _generic(size: Components, sign: int) -> Components:
    """Distinct numbers of about these sizes, with alternating signs if `sign` is −1."""
    n = size.parts[0].shape[0] if size.is_array else len(size.parts)
    factors = (1 + (0.618 * np.arange(n)) % 1) * sign ** np.arange(n)
    if size.is_array:
        return jnp.asarray(factors, size.parts[0].dtype) * size
    return Components(float(c) * v for c, v in zip(factors, size.parts, strict=True))


def _missed(tableau: Tableau, step: SmoothStep) -> tuple[Components, Any]:
    """The estimated errors of a step, and the allowed ratio of them to the change in it."""
    step = stop_gradient(step)
    error = step.h * (step.trial.error + tableau.d[-1] * step.f1)
    shares = (_CRUDE_WATCHED, _CRUDE) if tableau.crude else (_WATCHED, _GROSS)
    share = select(step.watched, *shares).astype(step.h.dtype)
    return abs(error), share if step.share is None else share * step.share
