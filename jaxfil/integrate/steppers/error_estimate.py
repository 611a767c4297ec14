"""What an estimated error says of a step: too long to be trusted, or not.

A trial step's ends, its fields there and what the method says of its error enter; whether the step
is too long leaves. It is if it has missed by a hundredth or more of what it does to a component:
of its displacement, of |h f| at both ends, as round a turning point, or of the state, whichever is
most. That depends on no units and on no state that is zero: a step of a motion at rest is not too
long, since what it misses is rounding. The estimates are of a lower order than the step, whose own
error is far less; and beyond the stability of a method they are half of the state and more, however
large that is, so that no motion grows by it unseen.

Of a long chain that is pulled at one end, a mass far away begins to move like a high power of time,
above the method's order: all of its first steps is missed, and means nothing. Where a state is
that large, a component is compared with what the others do to it, too (`_reached`).
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

# Estimated errors of a step up to this part of what it does are left to the user to judge; after
# one that was worse, up to the second: an unstable motion grows unseen to what is left to judge.
_GROSS, _WATCHED = 1e-2, 1e-5
# The same of a crude estimate: beyond the stability of RK4 it is more than the state.
_CRUDE, _CRUDE_WATCHED = 1.0, 1e-3
# The least relative tolerance, in eps.
_LEAST_RTOL = 16
# Rounding of a step, in eps of the terms that it is made of.
_ROUNDING = 64
# An error below this part of what other components do to one in a step is none of its own.
_FAINT = 1e-4
# A motion begins with a power of time above the order of a method only through many components:
# at least so many are needed for one above the least order that estimates its error.
_CHAIN = 4
# So many components deep rounding is followed from one to the next. A step by which it then still
# grows by more than this factor is beyond the stability of every explicit method.
_DEEP, _STABLE = 4, 16


class SmoothStep(eqx.Module):
    """A step of length h from (t, x0), and its fields at both ends."""

    t: Array
    h: Array
    longest: Array
    """The longest that a step may be."""
    x0: Components
    f0: Components
    f1: Components
    trial: Trial
    scale: Components
    """The largest |x| of late."""
    watched: Array
    """Whether steps were refused of late."""
    share: Array | None
    """The part of the usual error that it may have; None: all of it."""


def relative_error(tableau: Tableau, step: SmoothStep) -> Array:
    """The estimated error of a step relative to the tolerance of its tableau, as `Adaptive` has it:
    NaN where it is not finite."""
    assert tableau.tolerance is not None
    step = stop_gradient(step)
    error = abs(step.h * (step.trial.error + tableau.d[-1] * step.f1))
    rtol = max(tableau.tolerance.rtol, _LEAST_RTOL * float(jnp.finfo(step.h.dtype).eps))
    allowed = tableau.tolerance.atol + rtol * maximum(abs(step.x0), abs(step.trial.x))
    # Of a number that stays zero nothing is missed, be no absolute error allowed.
    missed = where(error > 0, error / where(allowed > 0, allowed, 1), 0.0 * error)
    missed = where((error > 0) & (allowed == 0), jnp.inf, missed)
    norm = jnp.sqrt(dot(missed, missed) / missed.size)
    return norm if step.share is None else norm / step.share


def may_be_too_long(tableau: Tableau, step: SmoothStep) -> Array:
    """Whether a step should be looked at by `is_too_long`: cheap, and never False in error, as the
    states at its ends are part of what the error is compared with."""
    if not tableau.d:
        return jnp.zeros((), bool)
    missed, share = _missed(tableau, step)
    ends = stop_gradient(maximum(abs(step.x0), abs(step.trial.x)))
    return any_of(missed > share * ends)


def is_too_long(
    system: ComponentSystem, tableau: Tableau, step: SmoothStep, sides: Components
) -> Array:
    """Whether a step of a lane on these sides cannot be trusted: see the top of this file."""
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
    """Whether a step has missed by too much of what it does, and by more than rounding."""
    missed, share = _missed(tableau, step)
    h, x0, x1 = step.h, step.x0, step.trial.x
    t, x = step.t + 0.5 * h, 0.5 * (x0 + x1)
    middle, push = jax.linearize(lambda t, x: system.field(t, x, sides), t, x)
    measure = _measure(h, x0, x1, step.f0, step.f1)
    if isinstance(tableau, RosenbrockTableau):
        # What is damped at once need not be known to a part of itself.
        measure = maximum(measure, step.scale)
        # What its stages take of each other, by large numbers that cancel.
        large = max(sum(map(abs, row)) for row in tableau.coupling)
        rounded = large * _damped_terms(h, (t, x, middle), push)
    else:
        rounded = _terms(system.n, h, (t, x, middle), push)
    faint = measure.like(jnp.zeros_like(t))
    if system.n > _CHAIN:
        faint = _reached(system.n, h, push, measure)
    # What a state has been of late it is known to.
    known = maximum(maximum(abs(x0), abs(x1)), step.scale)
    # And a length, to the rounding of the longest step: at a jump of the field no step is right.
    known = known + abs(step.longest / h * (x1 - x0))
    rounding = _ROUNDING * system.eps * (rounded + known)
    return any_of(missed > maximum(maximum(share * measure, rounding), _FAINT * faint))


def _reached(n: int, h: Array, push: Callable, size: Components) -> Components:
    """How far motions of these sizes move each component in a step of length h, through all others:
    s_i = max(size_i, |h Σ_j ∂f_i/∂x_j s_j|). Zero where that grows without end, as it does where
    the step is long beside the rates of the field."""

    def passed_on(_: Array | int, now: tuple[Components, Array]) -> tuple[Components, Array]:
        size, _grows = now
        after = maximum(size, abs(h) * _change(push, 0 * h, size))
        return after, any_of(after > size)

    # A way through all components is n − 1 long.
    first = size, jnp.zeros((), bool)
    size, grows = jax.lax.fori_loop(0, n, passed_on, first)
    return where(grows, 0.0, size)


def _measure(
    h: Array, x0: Components, x1: Components, f0: Components, f1: Components
) -> Components:
    """What the error of each component is compared with."""
    # A jump of the field that no surface tells of costs a step a part of what it does, however
    # short it is: beside a state that is not zero that is left to the user too.
    state = maximum(abs(x0), abs(x1))
    # The field at the end of an unstable step is no measure: it may be a thousand times the state.
    moved = maximum(abs(x1 - x0), abs(h) * minimum(abs(f0), abs(f1)))
    return maximum(moved, state)


def _terms(
    n: int, h: Array, at: tuple[Array, Components, Components], push: Callable
) -> Components:
    """The size of the terms that a step of length h is made of, about a time, the state and the
    field there.

    Rounding of the state and of h f enters the field with its derivative, and so on from component
    to component. In a step so long that it grows without end, that says nothing, and zero leaves.
    """
    t, x, f = at

    def passed_on(size: Components) -> Components:
        return size + abs(h) * _change(push, abs(t), size)

    size = abs(x) + abs(h * f)
    size = jax.lax.fori_loop(0, min(n, _DEEP), lambda _, size: passed_on(size), size)
    return where(any_of(passed_on(size) > _STABLE * size), 0.0, size)


def _damped_terms(h: Array, at: tuple[Array, Components, Components], push: Callable) -> Components:
    """The same of a step that damps what its field damps: h f_i/(1 + |h ∂f_i/∂x_i|) of the terms of
    f."""
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
    """How much changes of time and state of these sizes change a field: along two directions, so
    that two terms which cancel in the one do not in the other."""
    one, other = (push(by_t, _generic(size, sign)) for sign in (1, -1))
    return abs(one) + abs(other)


def _generic(size: Components, sign: int) -> Components:
    """Numbers of these sizes of which no two are alike, each times a sign by its turn."""
    n = size.parts[0].shape[0] if size.is_array else len(size.parts)
    factors = (1 + (0.618 * np.arange(n)) % 1) * sign ** np.arange(n)
    if size.is_array:
        return jnp.asarray(factors, size.parts[0].dtype) * size
    return Components(float(c) * v for c, v in zip(factors, size.parts, strict=True))


def _missed(tableau: Tableau, step: SmoothStep) -> tuple[Components, Any]:
    """The estimated errors of a step, and the part of what it does that they may be."""
    step = stop_gradient(step)
    error = step.h * (step.trial.error + tableau.d[-1] * step.f1)
    shares = (_CRUDE_WATCHED, _CRUDE) if tableau.crude else (_WATCHED, _GROSS)
    share = select(step.watched, *shares).astype(step.h.dtype)
    return abs(error), share if step.share is None else share * step.share
