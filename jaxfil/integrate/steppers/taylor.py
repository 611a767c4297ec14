"""A step by the power series of a solution.

A field whose operations have power series (`xla.series`) enters with a time, a state and a length;
the polynomial of the solution within the step leaves, with those of the guards of its mode. It is
scaled to the step: at a fraction s of a step of length h the state is

    x(t + s h) = Σ_k c_k s^k,   c_0 = x(t),   c_{k+1} = h f_k/(k + 1)

where f_k are the coefficients of the field along it. What the series misses at its end is known
from its defect there: h (f(t + h, x(t + h)) − Σ_k f_k)/(p + 1), p the order.

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
from jaxfil.integrate.system.components import Components, Polynomial
from jaxfil.model.argument import is_whole, told
from jaxfil.xla.series import Expansion, Series, kept

# Orders that make sense: below, Runge–Kutta is cheaper; above, coefficients are rounding.
_ORDERS = range(4, 41)
# Orders whose coefficients are computed together. Fewer take longer to compile, and of more XLA
# computes again what several of them use.
_TOGETHER = 5


class Taylor(eqx.Module):
    """A step by the Taylor series of the solution, for wherever `stepper` is an argument.

    x(t + h) = Σ_{k ≤ p} x_k h^k of order p, with the coefficients x_k by recurrences over the
    operations of the field, which must have power series: sums, products, quotients, powers,
    exponentials, trigonometric and hyperbolic functions and their inverses, selections. What is
    selected is what the state at the start of the step says; a kink inside the step shows in its
    error, which is estimated by the defect of the field at the end of the step. Contacts are
    located on the polynomial, without a second step. Sweeps of piecewise linear systems take about
    half the time that they take with `diffrax.Dopri8()`, those of fields with several products of
    states up to 1.6 times as long. Steps in which a motion rests on a surface, or slides on
    surfaces whose weights depend on each other, are those of `diffrax.Dopri8()`.

    **Errors**: a `ValueError` for an order out of range, and one that names an operation of the
    field without a power series, as a `jax.lax.while_loop` is.

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
    """What a step needs to know of a Taylor method."""

    order: int = eqx.field(static=True)
    name: str = eqx.field(static=True)
    crude: bool = eqx.field(static=True, default=False)
    tolerance: Adaptive | None = eqx.field(static=True, default=None)

    @property
    def d(self) -> tuple[float, ...]:
        """As `ExplicitTableau.d`: the share of the field at the end."""
        return (1 / (self.order + 1),)

    @property
    def stages(self) -> int:
        """Passes over the operations of the field."""
        return self.order

    @property
    def times(self) -> list[float]:
        """Where in a step the field is evaluated as it is: at its end."""
        return [1.0]


def solved(
    once: Callable,
    expansion: Expansion,
    functions: Callable[[Series, list[Series]], tuple[list[Series], list[Series]]],
    order: int,
    at: tuple[Array, Components, Array],
    like: Components,
) -> Polynomial:
    """The polynomial of a step from (t, x) of length h, `at` = (t, x, h), along the field that
    `functions` makes of series of time and state, with guards that are `like` what it makes too.
    Each coefficient is computed `once`, as `ComponentSystem.once` has it."""
    t, x, h = at
    time, fields = expansion.linear(t, h), []

    def state(i: int, x0: Array) -> Series:
        def make(k: int) -> Any:
            if k == 0:
                return x0
            slope = fields[i][k - 1]
            return None if slope is None else (h * (1.0 / k)) * slope

        return expansion.series(make)

    states = [state(i, x0) for i, x0 in enumerate(x.parts)]
    kept(*states)
    found, guards = functions(time, states)
    fields.extend(found)
    # Guards that are linear in the state are cheaper made again than read again, and not kept.
    others = [
        v
        for v in expansion.made
        if v.is_kept and v.degree is None and not v.is_of_time and v not in states
    ]
    _in_stages(expansion, states, others, order, once)
    if any(v.is_kept for v in guards):  # what they are made of is known to one order less
        known = (*_coefficients(guards, order, like), 0.0 * like)
    else:
        known = _coefficients(guards, order + 1, like)
    return Polynomial(h, _coefficients(states, order + 1, x), known, jnp.zeros((), bool))


def _in_stages(
    expansion: Expansion, states: list[Series], others: list[Series], order: int, once: Callable
) -> None:
    """Make the coefficients of the states up to an order, and those of others that they are made
    of, a few at a time, so that a compiler computes none of them twice."""
    if not others:
        for first in range(0, order + 1, _TOGETHER):
            orders = range(first, min(first + _TOGETHER, order + 1))
            expansion.stage(states, orders, once)
        return
    for k in range(order + 1):
        expansion.stage(states, range(k, k + 1), once)
        if k < order:
            expansion.stage(others, range(k, k + 1), once)


def _coefficients(parts: Sequence[Series], orders: int, like: Components) -> tuple:
    """Components of the coefficients of some series; those that are zero by structure too."""
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
    """The polynomial that is right at the end of a step alone, where the state is x1 and its rate
    f: the step of another method. It has as many guards as m."""
    nothing, none, apart = 0.0 * x0, 0.0 * m, h * f - (x1 - x0)
    x = x0, (x1 - x0) - apart, apart, *(nothing,) * (order - 2)
    return Polynomial(h, x, (none,) * (order + 1), jnp.ones((), bool))


def error_at(tableau: TaylorTableau, known: Polynomial, s: Array) -> Components:
    """The share of the polynomial in the estimate of an error, the defect of the field: see
    `Trial.error`."""
    return stop_gradient(-tableau.d[0] * known.rate_at(s))
