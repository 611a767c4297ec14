"""What an estimated error says of a step: too long to be trusted, or not.

A trial step's ends, its fields there and what the method says of its error enter; whether the step
is too long leaves. It is if it has missed by a tenth or more of what it does to a component: of its
displacement, of |h f| at both ends, as round a turning point, or of the state, whichever is most.
That depends on no units and on no state that is zero: a step of a motion at rest is not too long,
since what it misses is rounding.

Of a long chain that is pulled at one end, a mass far away begins to move like a high power of time,
above the method's order: all of its first steps is missed, and means nothing. Where a state is
that large, a component is compared with what the others do to it, too (`_reached`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.steppers.explicit import Tableau, Trial
from jaxfil.integrate.steppers.rosenbrock import RosenbrockTableau
from jaxfil.integrate.system.components import Components, any_of, maximum, minimum, where
from jaxfil.integrate.system.lowered import ComponentSystem

# Estimated errors of a step up to this part of what it does are left to the user to judge.
_GROSS = 0.1
# Rounding of a step, in eps of the terms that it is made of.
_ROUNDING = 64
# An error below this part of what other components do to one in a step is none of its own.
_FAINT = 1e-4
# A motion begins with a power of time above the order of a method only through many components:
# at least so many are needed for one above the least order that estimates its error.
_CHAIN = 4
# So many components deep rounding is followed from one to the next.
_DEEP = 4


class SmoothStep(eqx.Module):
    """A step of length h from (t, x0), and its fields at both ends."""

    t: Array
    h: Array
    x0: Components
    f0: Components
    f1: Components
    trial: Trial


def may_be_too_long(tableau: Tableau, step: SmoothStep) -> Array:
    """Whether a step should be looked at by `is_too_long`: cheap, and never False in error, as the
    state at its end is part of what the error is compared with."""
    missed = _missed(tableau, step)
    if missed is None:
        return jnp.zeros((), bool)
    return any_of(missed > _GROSS * stop_gradient(abs(step.trial.x)))


def is_too_long(
    system: ComponentSystem, tableau: Tableau, step: SmoothStep, sides: Components
) -> Array:
    """Whether a step of a lane on these sides cannot be trusted: see the top of this file."""
    if step.trial.error is None:
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
    """Whether a step has missed by a tenth of what it does, and by more than rounding."""
    missed = _missed(tableau, step)
    assert missed is not None
    h, x0, x1 = step.h, step.x0, step.trial.x
    t, x = step.t + 0.5 * h, 0.5 * (x0 + x1)
    middle = system.field(t, x, sides)
    rounded = _terms(system, t, x, h, sides, middle)
    measure = _measure(h, x0, x1, step.f0, step.f1)
    faint = measure.like(jnp.zeros_like(t))
    if system.n > _CHAIN:
        faint = _reached(system, t, x, h, sides, measure)
    rounding = _ROUNDING * system.eps * (rounded + maximum(abs(x0), abs(x1)))
    return any_of(missed > maximum(maximum(_GROSS * measure, rounding), _FAINT * faint))


def _reached(
    system: ComponentSystem, t: Array, x: Components, h: Array, sides: Components, size: Components
) -> Components:
    """How far motions of these sizes move each component in a step of length h, through all others:
    s_i = max(size_i, |h Σ_j ∂f_i/∂x_j s_j|). Zero where that grows without end, as it does where
    the step is long beside the rates of the field."""

    def passed_on(_: Array | int, now: tuple[Components, Array]) -> tuple[Components, Array]:
        size, _grows = now
        _, change = jax.jvp(lambda x: system.field(t, x, sides), (x,), (_generic(size),))
        after = maximum(size, abs(h * change))
        return after, any_of(after > size)

    # A way through all components is n − 1 long.
    first = size, jnp.zeros((), bool)
    size, grows = jax.lax.fori_loop(0, system.n, passed_on, first)
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
    system: ComponentSystem, t: Array, x: Components, h: Array, sides: Components, f: Components
) -> Components:
    """The size of the terms that a step of length h is made of.

    Rounding of the state and of h f enters the field with its derivative, and so on from component
    to component: here along a direction in which terms that cancel in the field do not.
    """

    def passed_on(size: Components) -> Components:
        generic = _generic(size)
        _, change = jax.jvp(lambda t, x: system.field(t, x, sides), (t, x), (abs(t), generic))
        return size + abs(h * change)

    size = abs(x) + abs(h * f)
    return jax.lax.fori_loop(0, min(system.n, _DEEP), lambda _, size: passed_on(size), size)


def _generic(size: Components) -> Components:
    """Numbers of these sizes of which no two are alike."""
    if size.is_array:
        (v,) = size.parts
        return jnp.asarray(1 + (0.618 * np.arange(v.shape[0])) % 1, v.dtype) * size
    return Components((1 + (0.618 * i) % 1) * v for i, v in enumerate(size.parts))


def _missed(tableau: Tableau, step: SmoothStep) -> Components | None:
    """The estimated errors of a step; None of a method without an estimate."""
    if isinstance(tableau, RosenbrockTableau) or step.trial.error is None:
        return None
    return abs(step.h * (step.trial.error + tableau.d[-1] * stop_gradient(step.f1)))
