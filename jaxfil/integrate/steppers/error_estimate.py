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
from jaxfil.integrate.system.components import Components, any_of, is_array
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select

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


class Step(eqx.Module):
    """A step of length h from (t, x0), and its fields at both ends."""

    t: Array
    h: Array
    x0: Components
    f0: Components
    f1: Components
    trial: Trial


def may_be_too_long(tableau: Tableau, step: Step) -> Array:
    """Whether a step should be looked at by `is_too_long`: cheap, and never False in error, as the
    state at its end is part of what the error is compared with."""
    each = zip(_missed(tableau, step), step.trial.x, strict=True)
    return any_of(tuple(missed > _GROSS * stop_gradient(abs(x)) for missed, x in each))


def is_too_long(system: ComponentSystem, tableau: Tableau, step: Step, sides: Components) -> Array:
    """Whether a step of a lane on these sides cannot be trusted: see the top of this file."""
    if not _estimates(tableau):
        return jnp.zeros((), bool)
    step = jax.tree.map(stop_gradient, step)
    suspect = may_be_too_long(tableau, step)

    def gross(step: Step, sides: Components) -> Array:
        return _is_gross(system, tableau, step, sides)

    def fine(step: Step, sides: Components) -> Array:
        return jnp.zeros((), bool)

    return suspect & system.where_any(suspect, gross, fine, step, sides)


def _is_gross(system: ComponentSystem, tableau: Tableau, step: Step, sides: Components) -> Array:
    """Whether a step has missed by a tenth of what it does, and by more than rounding."""
    h, x1 = step.h, step.trial.x
    t, x = step.t + 0.5 * h, tuple(0.5 * (a + b) for a, b in zip(step.x0, x1, strict=True))
    middle = system.field(t, x, sides)
    rounded = _terms(system, t, x, h, sides, middle)
    ends = list(zip(step.x0, x1, step.f0, step.f1, strict=True))
    measures = tuple(_measure(h, *end) for end in ends)
    faint = tuple(jnp.zeros_like(v) for v in measures)
    if system.n > _CHAIN:
        faint = _reached(system, t, x, h, sides, measures)
    gross = []
    each = zip(_missed(tableau, step), ends, measures, rounded, faint, strict=True)
    for missed, (a, b, *_), measure, size, least in each:
        rounding = _ROUNDING * system.eps * (size + jnp.maximum(abs(a), abs(b)))
        allowed = jnp.maximum(jnp.maximum(_GROSS * measure, rounding), _FAINT * least)
        gross.append(missed > allowed)
    return any_of(tuple(gross))


def _reached(
    system: ComponentSystem, t: Array, x: Components, h: Array, sides: Components, size: Components
) -> Components:
    """How far motions of these sizes move each component in a step of length h, through all others:
    s_i = max(size_i, |h Σ_j ∂f_i/∂x_j s_j|). Zero where that grows without end, as it does where
    the step is long beside the rates of the field."""

    def passed_on(_: Array | int, now: tuple[Components, Array]) -> tuple[Components, Array]:
        size, _grows = now
        _, change = jax.jvp(lambda x: system.field(t, x, sides), (x,), (_generic(size),))
        after = tuple(jnp.maximum(v, abs(h * c)) for v, c in zip(size, change, strict=True))
        return after, any_of(tuple(b > a for a, b in zip(size, after, strict=True)))

    # A way through all components is n − 1 long.
    first = size, jnp.zeros((), bool)
    size, grows = jax.lax.fori_loop(0, system.n, passed_on, first)
    return tuple(select(grows, 0.0, v) for v in size)


def _measure(h: Array, x0: Array, x1: Array, f0: Array, f1: Array) -> Array:
    """What the error of a step is compared with, of one component."""
    # A jump of the field that no surface tells of costs a step a part of what it does, however
    # short it is: beside a state that is not zero that is left to the user too.
    state = jnp.maximum(abs(x0), abs(x1))
    # The field at the end of an unstable step is no measure: it may be a thousand times the state.
    moved = jnp.maximum(abs(x1 - x0), abs(h) * jnp.minimum(abs(f0), abs(f1)))
    return jnp.maximum(moved, state)


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
        return tuple(v + abs(h * c) for v, c in zip(size, change, strict=True))

    size = tuple(abs(v) + abs(h * g) for v, g in zip(x, f, strict=True))
    return jax.lax.fori_loop(0, min(system.n, _DEEP), lambda _, size: passed_on(size), size)


def _generic(size: Components) -> Components:
    """Numbers of these sizes of which no two are alike."""
    if is_array(size):
        (v,) = size
        return (jnp.asarray(1 + (0.618 * np.arange(v.shape[0])) % 1, v.dtype) * v,)
    return tuple((1 + (0.618 * i) % 1) * v for i, v in enumerate(size))


def _estimates(tableau: Tableau) -> bool:
    """Whether a step of this method says something of its error."""
    return not isinstance(tableau, RosenbrockTableau) and bool(tableau.d)


def _missed(tableau: Tableau, step: Step) -> list[Array]:
    """The estimated errors of a step; zeros of a method that estimates none."""
    if isinstance(tableau, RosenbrockTableau) or not tableau.d:
        return list(map(jnp.zeros_like, step.x0))
    each = zip(step.trial.error, step.f1, strict=True)
    return [abs(step.h * (e + tableau.d[-1] * stop_gradient(f))) for e, f in each]
