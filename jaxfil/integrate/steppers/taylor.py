"""A step by the power series of a solution.

The operations of a field have power series (`xla.series`), from which the polynomial of the
solution within a step is computed, and the polynomials of the guards of its mode. It is scaled to
the step; at a fraction s of a step of length h the state is

    x(t + s h) = Σ_k c_k s^k,   c_0 = x(t),   c_{k+1} = h f_k/(k + 1)

where f_k are the coefficients of the field along the solution. The truncation error at the end is
estimated by the defect h (f(t + h, x(t + h)) − Σ_k f_k)/(p + 1), with p the order.

**Source**: À. Jorba and M. Zou, A software package for the numerical integration of ODEs by means
of high-order Taylor methods, Experimental Mathematics 14 (2005).
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.steppers.adaptive import Adaptive
from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.model.argument import is_whole, told
from jaxfil.xla.series import AHEAD, Expansion, Series, kept
from jaxfil.xla.series_jumps import kinks_of

# Useful orders. Below, Runge–Kutta is cheaper; above, coefficients are dominated by rounding.
_ORDERS = range(4, 41)
# Number of orders whose coefficients are computed behind one fence (`Expansion.stage`). With fewer,
# compilation takes longer; with more, XLA recomputes values that several of them use.
_TOGETHER = 5


class Taylor(eqx.Module):
    """A step by the Taylor series of the solution, for wherever `stepper` is an argument.

    x(t + h) = Σ_{k ≤ p} x_k h^k of order p, with the coefficients x_k by recurrences over the
    operations of the field, which must have power series: sums, products, quotients, powers,
    exponentials, trigonometric and hyperbolic functions and their inverses, selections. A selection
    is decided at the start of the step, and on a kink of `max`, `abs`, `where`, or a jump of
    `sign`, `floor`, `%` and the like, by the motion just after it. With `Adaptive` a step ends at
    the first kink or jump inside it, of which the time has its derivatives, so that kinks do not
    reduce the order, and where the tail of the series has grown to the tolerance. Without, the
    error shows a kink if it is estimated beyond it, by the defect of the field at the end of the
    step, and not if a step passes it twice; only at kinks of `switching` a step always ends. A
    root, a power that is not whole, a power by a parameter above 4 or a quotient (`jnp.sinc`) has
    no series where it is made of an exact zero that the motion leaves, as `|v|` at rest. Such a run
    ends as `nonfinite`, and of a power by a parameter up to 4 the derivative by that parameter is
    NaN; `diffrax.Dopri8()` has both. With `diffrax.RecursiveCheckpointAdjoint()` the gradient is
    NaN where the field of the other side is NaN; `jax.grad` without `adjoint` has no such limit.
    Contacts are located on the polynomial, without a second step. Sweeps of piecewise linear
    systems take 0.4 to 0.8 of the time that they take with `diffrax.Dopri8()`, and fields with
    several products of states up to 1.6 times as long. Steps in which a motion rests on a surface,
    or slides on surfaces whose weights depend on each other, use `diffrax.Dopri8()`.

    **Errors**: a `ValueError` for an order out of range, and one that names an operation of the
    field without a power series, for example a `jax.lax.while_loop`, or where steps end at kinks
    an operation whose jumps cannot be located, for example `jnp.argmin`.

    **Source**: À. Jorba and M. Zou, A software package for the numerical integration of ODEs by
    means of high-order Taylor methods, Experimental Mathematics 14 (2005).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> sd = jf.systems.SDOscillator()
    >>> sol = jf.solve(sd, jnp.array([0.5, 0.0]), 0.0, 20.0, 0.5, stepper=jf.Taylor(16))
    >>> int(sol.num_events)
    4
    """

    order: int = eqx.field(static=True, default=12)
    """p, from 4 to 40."""

    def __check_init__(self):
        if not is_whole(self.order) or self.order not in _ORDERS:
            raise ValueError(
                f"`order` must be a whole number from {_ORDERS[0]} to {_ORDERS[-1]}, got "
                f"{told(self.order)}."
            )


class TaylorTableau(eqx.Module):
    """The coefficients of a Taylor method, as a step uses them; `crude` and `tolerance` are as
    in `ExplicitTableau`."""

    order: int = eqx.field(static=True)
    name: str = eqx.field(static=True)
    crude: bool = eqx.field(static=True, default=False)
    tolerance: Adaptive | None = eqx.field(static=True, default=None)

    @property
    def d(self) -> tuple[float, ...]:
        """The share of the field at the end in the error estimate (see `ExplicitTableau.d`)."""
        return (1 / (self.order + 1),)

    @property
    def stages(self) -> int:
        """Passes over the operations of the field."""
        return self.order

    @property
    def times(self) -> list[float]:
        """Times in a step, as fractions, at which the field is evaluated alone: its end."""
        return [1.0]


def solved(
    once: Callable,
    expansion: Expansion,
    functions: Callable[[Series, list[Series]], tuple[list[Series], list[Series]]],
    order: int,
    at: tuple[Array, Components, Array],
    like: Components,
    kinks: bool = False,
) -> Polynomial:
    """The polynomial of a step of length h from (t, x), with `at` = (t, x, h). `functions` maps the
    series of time and state to the series of the field and of the guards, which have the components
    of `like`. Each coefficient is computed `once` (see `ComponentSystem.once`). With the `kinks` of
    the field if asked for."""
    t, x, h = at
    # `fields`, with the decisions up to each order, is filled below, since the series of states and
    # of fields refer to each other.
    time, fields = expansion.linear(t, h), []

    def state(i: int, x0: Array) -> Series:
        def make(k: int) -> Any:
            if k == 0:
                return x0
            slope = fields[min(k - 1, AHEAD)][i][k - 1]
            # A structural zero stays one, and operations on it are omitted.
            return None if slope is None else (h * (1.0 / k)) * slope

        return expansion.series(make)

    states = [state(i, x0) for i, x0 in enumerate(x.parts)]
    kept(*states)
    found, guards = functions(time, states)
    fields.extend([found] * (AHEAD + 1))
    if expansion.jumps:
        _decide(expansion, lambda: functions(time, states)[0], states, fields, once)
    # Other series of which later coefficients need all earlier ones. Guards that are linear in the
    # state are none of these: they are cheaper to recompute than to store and read.
    others = [
        v
        for v in expansion.made
        if v.is_kept and v.degree is None and not v.is_of_time and v not in states
    ]
    _in_stages(expansion, states, others, order, once)
    # A stored guard depends on coefficients that are known only up to one order less.
    if any(v.is_kept for v in guards):
        known = (*_coefficients(guards, order, like), 0.0 * like)
    else:
        known = _coefficients(guards, order + 1, like)
    compared = kinks_of(expansion, order + 1) if kinks else None
    path = _coefficients(states, order + 1, x)
    return Polynomial(h, path, known, jnp.zeros((), bool), compared)


def _decide(
    expansion: Expansion, field: Callable, states: list[Series], fields: list, once: Callable
) -> None:
    """Computes the coefficients of the states that decide jumps (see `series_jumps`); `fields` are
    those with the decisions up to each order, of which the last one is made."""
    num_made = len(expansion.made)
    for ahead in range(AHEAD):
        expansion.ahead = ahead
        fields[ahead] = field()
    expansion.ahead = AHEAD
    expansion.stage(states, range(AHEAD + 1), once)
    # Higher orders depend on none of these series.
    del expansion.made[num_made:]


def _in_stages(
    expansion: Expansion, states: list[Series], others: list[Series], order: int, once: Callable
) -> None:
    """Computes the coefficients of the states up to an order, and of the `others` that they depend
    on, a few orders at a time, so that a compiler computes each only once."""
    if not others:
        for first in range(0, order + 1, _TOGETHER):
            orders = range(first, min(first + _TOGETHER, order + 1))
            expansion.stage(states, orders, once)
        return
    # Coefficient k of the others needs coefficient k of the states, whose next one needs both. The
    # last one of the states has no next one.
    for k in range(order + 1):
        expansion.stage(states, range(k, k + 1), once)
        if k < order:
            expansion.stage(others, range(k, k + 1), once)


def _coefficients(parts: Sequence[Series], orders: int, like: Components) -> tuple:
    """The coefficients of some series as components, with zeros for structural zeros."""
    return tuple(
        Components(
            jnp.zeros_like(one) if v[k] is None else jnp.broadcast_to(v[k], one.shape)
            for v, one in zip(parts, like.parts, strict=True)
        )
        for k in range(orders)
    )


def end_alone(
    order: int, h: Array, x0: Components, x1: Components, f: Components, m: Components
) -> Polynomial:
    """A polynomial that is right only at the end of a step, with the state x1 and the rate f there,
    for a step of another method. It has as many guards as m."""
    nothing, none, apart = 0.0 * x0, 0.0 * m, h * f - (x1 - x0)
    # The quadratic through both states with the slope h f at its end.
    x = x0, (x1 - x0) - apart, apart, *(nothing,) * (order - 2)
    return Polynomial(h, x, (none,) * (order + 1), jnp.ones((), bool))


def error_at(tableau: TaylorTableau, known: Polynomial, s: Array) -> Components:
    """The share of the polynomial in the error estimate, the defect of the field (see
    `Trial.error`)."""
    # The field at the end is added with the same share in `error_estimate`, where it is known. The
    # sum is the defect.
    return stop_gradient(-tableau.d[0] * known.rate_at(s))
