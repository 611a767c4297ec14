"""Averages along a motion: quadratures carried with the state.

A system and a function of time, state and sides enter; the mean of the function along a run leaves,
of the order of the stepper and exact through contacts.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfil.integrate.options import Adjoint
from jaxfil.integrate.solve import solve
from jaxfil.integrate.step_choice import StepChoice
from jaxfil.integrate.stepper import Stepper
from jaxfil.model import check
from jaxfil.model.clock import Clocks
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast
from jaxfil.model.system import System, has_resets
from jaxfil.model.types import Scalar, State


class Average(eqx.Module):
    """The mean of a function along a run, and how the run ended."""

    value: Float[jax.Array, "*shape"]
    """The mean; of the time that was reached where the run has ended before."""
    result: RESULTS
    """How the run ended."""
    t_final: Float[jax.Array, ""]
    """How far it came."""
    x_final: Float[jax.Array, " n"]
    """The state there, for another run to go on from."""


class _WithIntegral(System):
    """A system with the integral of a function behind its state, which no surface sees."""

    system: System
    function: Callable[[Array, Array, Array], Array]
    n: int = eqx.field(static=True)

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        state = x[: self.n]
        rate = jnp.ravel(jnp.asarray(self.function(t, state, side), x.dtype))
        return jnp.concatenate([self.system.vector_field(t, state, side), rate])

    def switching(self, t: Array, x: Array) -> Array:
        return self.system.switching(t, x[: self.n])

    @property
    def slides(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.slides

    @property
    def clocks(self) -> Clocks:
        return self.system.clocks


class _WithImpacts(_WithIntegral):
    """The same of a system with impacts, which do not change an integral."""

    def reset(self, t: Array, x: Array, surface: Array) -> Array:
        after = self.system.reset(t, x[: self.n], surface)
        return jnp.concatenate([after, x[self.n :]])


def average(
    system: System,
    function: Callable[[Array, Array, Array], Array],
    x0: State,
    t0: Scalar,
    t1: Scalar,
    dt: Scalar | StepChoice,
    *,
    stepper: Stepper | None = None,
    adjoint: Adjoint = diffrax.ForwardMode(),  # noqa: B008
    throw: bool = True,
) -> Average:
    r"""The mean of a function along a motion: a power, a duty cycle, the part of time on a side.

    $$\bar g = \frac{1}{t_1 - t_0} \int_{t_0}^{t_1} g(t, x(t), \mathrm{side}(t))\, dt$$

    The integral is carried with the state, at the order of the stepper, and its steps end on
    contacts as those of the state do. On a slide it is that of the blend of both sides, as the
    field is.

    **Arguments**

    - `system`, `x0`, `t0`, `t1`, `dt`, `stepper`, `adjoint`, `throw`: as in `solve`.
    - `function`: g, a function of the time, the state, shape (n,), and the sides, as
      `System.vector_field` is given them, that returns an array of any shape.

    **Returns** an `Average` with the shape of what `function` returns. It has derivatives as the
    states of a `Solution` have.

    **Outcomes**: `successful`; `max_steps_reached`, `nonfinite`, `step_too_long`, `nonunique`,
    `mode_undecided`, `undeclared_sliding`, `zeno`, `reset_undecided` and, in backward time,
    `irreversible_reset`.

    **Source**: textbook; E. Hairer, S. P. Nørsett and G. Wanner, Solving Ordinary Differential
    Equations I, Springer (1993), section II.1, where a quadrature is a differential equation.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> spring = jf.piecewise(
    ...     lambda t, x: jnp.stack([x[1], -x[0]]), lambda t, x: jnp.stack([x[1], -4 * x[0]]),
    ...     lambda t, x: x[0])
    >>> above = jf.average(
    ...     spring, lambda t, x, side: 0.5 * (1 + side), jnp.array([0.0, 1.0]), 0.0, 1.5 * jnp.pi,
    ...     0.1)
    >>> print(round(float(above.value), 9))  # a time π of 3π/2
    0.666666667
    """
    x = check.state("x0", x0)
    check.system("system", system)
    h = check.shapes(system, x)
    shape = _shape(function, x, h)
    size = 1
    for k in shape:
        size *= k
    make = _WithImpacts if has_resets(system) else _WithIntegral
    wider = make(system, cast(function, x.dtype), x.shape[0])
    start = jnp.concatenate([x, jnp.zeros((size,), x.dtype)])
    sol = solve(
        wider, start, t0, t1, dt, stepper=stepper, max_events=None, adjoint=adjoint, throw=throw
    )
    n, elapsed = x.shape[0], sol.t_final - jnp.asarray(t0, x.dtype)
    mean = sol.x_final[n:].reshape(shape) / elapsed
    return Average(mean, sol.result, sol.t_final, sol.x_final[:n])


def _shape(function: Callable, x: Array, h: tuple[int, ...]) -> tuple[int, ...]:
    """That of what a function returns."""
    if not callable(function):
        raise ValueError(f"`function` must be a callable of (t, x, side), got {function!r}.")
    out: Any = jax.eval_shape(function, jnp.zeros((), x.dtype), x, jnp.ones(h, x.dtype))
    if not hasattr(out, "shape"):
        raise ValueError(f"`function` must return an array, got {out!r}.")
    return tuple(out.shape)
