"""Averages along a motion, computed as quadratures that are integrated with the state.

They have the order of the stepper and are exact through contacts.
"""

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfil.integrate.run.observed import checked_observable, with_rate
from jaxfil.integrate.run.options import Adjoint
from jaxfil.integrate.run.solve import solve
from jaxfil.integrate.run.step_choice import StepLength
from jaxfil.integrate.steppers.explicit import Stepper
from jaxfil.model import check
from jaxfil.model.card import outcome, precision
from jaxfil.model.observe import Observe
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.model.types import Scalar, State
from jaxfil.xla.known import is_known, without_derivatives
from jaxfil.xla.select import select
from jaxfil.xla.valid_derivative import only_if_valid


class Average(eqx.Module):
    """The mean of a function along a run."""

    value: Float[jax.Array, "*shape"]
    """The mean, over the time before `t_final` if the run ended early."""
    result: RESULTS
    """The outcome of the run."""
    t_final: Float[jax.Array, ""]
    """The final time."""
    x_final: Float[jax.Array, " n"]
    """The state at `t_final`, from which another run can continue."""

    def __repr__(self) -> str:
        told = precision(self.value)
        if isinstance(self.value, jax.core.Tracer) or self.t_final.ndim:
            return f"Average{told}: a batch of shape {self.t_final.shape}"
        mean = np.array2string(np.asarray(self.value), precision=9, separator=", ")
        return (
            f"Average{told}: {mean} up to t = {float(self.t_final):.10g}\n  {outcome(self.result)}"
        )


def average(
    system: System,
    function: Observe,
    x0: State,
    t0: Scalar,
    t1: Scalar,
    dt: StepLength,
    *,
    stepper: Stepper | None = None,
    adjoint: Adjoint = diffrax.ForwardMode(),  # noqa: B008
    throw: bool = True,
) -> Average:
    r"""The mean of a function along a motion, such as a power or the share of sticking.

    $$\bar g = \frac{1}{t_1 - t_0} \int_{t_0}^{t_1} g(t, x(t), \mathrm{side}(t), \dots)\, dt$$

    The integral is integrated with the state, at the order of the stepper, and its steps end on
    contacts. The mean of a function of the mode that is 1 or 0 is therefore a share of time, to
    rounding. On a slide g is the blend of both sides, as the field is.

    **Arguments**

    - `system`, `x0`, `t0`, `t1`, `dt`, `stepper`, `adjoint`, `throw`: as in `solve`, but t1 ≠ t0.
    - `function`: g, a function of the time and the state, shape (n,), that returns an array of any
      shape, with optional arguments `side`, `reaction` and `mode` as in `observe` of `solve`.

    **Returns** an `Average` with the shape of the value of `function`. It has derivatives like the
    states of a `Solution`.

    **Outcomes**: `successful`; `max_steps_reached`, `nonfinite`, `step_too_long`, `nonunique`,
    `mode_undecided`, `undeclared_sliding`, `zeno`, `reset_undecided` and, in backward time,
    `irreversible_reset`.

    **Source**: textbook; E. Hairer, S. P. Nørsett and G. Wanner, Solving Ordinary Differential
    Equations I, Springer (1993), section II.1, where a quadrature is a differential equation.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> spring = jf.piecewise(
    ...     lambda t, x: jnp.stack([x[1], -x[0]]), lambda t, x: jnp.stack([x[1], -4 * x[0]]),
    ...     lambda t, x: x[0])
    >>> above = jf.average(
    ...     spring, lambda t, x, side: 0.5 * (1 + side), jnp.array([0.0, 1.0]), 0.0, 1.5 * jnp.pi,
    ...     0.1)
    >>> print(round(float(above.value), 9))  # a time π of 3π/2
    0.666666667
    >>> block = jf.systems.CoulombOscillator()  # from 3 it moves for a time 4π, and then sticks
    >>> stuck = jf.average(
    ...     block, lambda t, x, mode: jnp.where(mode == 0, 1.0, 0.0), jnp.array([3.0, 0.0]), 0.0,
    ...     8 * jnp.pi, 0.1)
    >>> print(round(float(stuck.value), 9))
    0.5
    """
    x = check.state("x0", x0)
    check.system("system", system)
    check.flags(throw=throw)
    observable = checked_observable("function", function, system, x)
    wider, start = with_rate(system, observable, x)
    since, until = check.scalar("t0", t0, x.dtype), check.scalar("t1", t1, x.dtype)
    # Under `jax.jit` an array made of a known time is traced, while `solve` counts steps by it.
    end, times = t1, [check.concrete(t) for t in (t0, t1)]
    if all(t is not None for t in times):
        same = np.diff(np.asarray(times, x.dtype)) == 0
    else:
        same = without_derivatives(until) == without_derivatives(since)
    if not is_known(same):
        # A traced time that is invalid has an outcome, as in `solve`.
        end = select(same, jnp.nan, until)
    elif same:
        raise ValueError(f"`t1` must differ from `t0`, since a mean is over a time, got {t1}.")
    sol = solve(
        wider,
        start,
        t0,
        end,
        dt,
        stepper=stepper,
        max_events=None,
        adjoint=adjoint,
        throw=throw,
    )
    n = x.shape[0]
    integral = sol.x_final[n:].reshape(observable.shape)
    # A run that has failed at its start has a mean of 0/0.
    mean = only_if_valid(_mean, integral, sol.t_final, since)
    return Average(mean, sol.result, sol.t_final, sol.x_final[:n])


def _mean(integral: jax.Array, t: jax.Array, since: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Whether a mean over the time from `since` to t is finite, and the mean."""
    mean = integral / (t - since)
    return jnp.all(jnp.isfinite(mean)), mean
