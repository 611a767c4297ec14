"""Averages of one lane, as arrays with derivatives.

They equal the averages of a diagram and run under every transformation, so that an optimiser can
follow the map of a diagram.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfil.integrate.lane.problem import Problem, period_outcome
from jaxfil.integrate.loop.iterate import integrate
from jaxfil.integrate.run.step_choice import StepCount
from jaxfil.integrate.steppers.explicit import Stepper
from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast
from jaxfil.model.quantity import Quantities
from jaxfil.model.section import Section
from jaxfil.model.system import System
from jaxfil.model.types import Scalar, State
from jaxfil.sweep.plan import sampling_of
from jaxfil.sweep.sampling import Kept, Sampling
from jaxfil.xla.kernel import kernel_if_it_fits
from jaxfil.xla.lanes import lanes_of
from jaxfil.xla.valid_derivative import only_if_valid


class SettledAverage(eqx.Module):
    """The averages of the long-term motion of one lane.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall = jf.systems.ImpactOscillator(wall=2.0)  # too far away to be reached
    >>> jf.settled_average(
    ...     wall, {"speed": jf.RMS(lambda t, x, side: x[1])}, jnp.zeros(2), transient=20,
    ...     samples=2).x_final.shape
    (2,)
    """

    averages: dict[str, Float[Array, "..."]]
    """The averages by name, as in `BifurcationDiagram`; NaN where the lane failed."""
    result: RESULTS
    """The outcome of the lane."""
    x_final: Float[Array, " n"]
    """The state at the last sample, or where the lane ended."""


def settled_average(
    system: System,
    average: Quantities,
    x0: State,
    *,
    transient: int | None = None,
    samples: int = 100,
    steps: StepCount = 40,
    stepper: Stepper | None = None,
    compact: bool | None = None,
    section: Section | None = None,
    max_return: Scalar | None = None,
    transient_time: Scalar | None = None,
) -> SettledAverage:
    """Averages of the long-term motion of a system from `x0`, one lane of
    `bifurcation_diagram(..., average=…)`, with derivatives.

    The system runs `transient` forcing periods T from t = 0, then `samples` more, over which the
    averages are taken,

        averages[name] = 1/(samples T) ∫ g(t, x(t), side(t)) dt

    or another quantity; with a `section`, from one of its crossings to another.

    Runs under `jax.jit` and `equinox.filter_vmap` (over a batched system, or over x0),
    each lane with its own outcome, and has derivatives, forward (`jax.jvp`, `jax.jacfwd`) and by
    `jax.grad`, which transposes them, by x0 and every float leaf of the system, exact through
    crossings, slides and resets. They are the derivatives of the settled motion as soon as the
    transient has forgotten x0.

    **Arguments**

    - `system`: any `System` with a `period`, or any `System` with a `section`.
    - `average`: as in `bifurcation_diagram`.
    - `x0`: initial state, shape (n,).
    - `transient`, `samples`, `steps`, `section`, `max_return`, `transient_time`: as in
      `bifurcation_diagram`.
    - `stepper`: as in `solve`; by default `diffrax.Dopri8()`.
    - `compact`: as in `solve`.

    **Returns** a `SettledAverage`.

    **Outcomes**: `successful`, `max_steps_reached`, `zeno`, `nonunique`, `mode_undecided`,
    `reset_undecided`, `undeclared_sliding`, `nonfinite`, `step_too_long`, `invalid_period`,
    `section_not_reached`.

    **Source**: textbook; E. Hairer, S. P. Nørsett and G. Wanner, Solving Ordinary Differential
    Equations I, Springer (1993), section II.1, where a quadrature is a differential equation.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> def power(omega):  # taken up by the damper of a linear oscillator: (A c ω)²/2c at ω² = k
    ...     wall = jf.systems.ImpactOscillator(wall=9.0, damping=0.5, omega=omega)
    ...     found = jf.settled_average(
    ...         wall, {"power": lambda t, x, side: 0.5 * x[1] ** 2}, jnp.zeros(2), samples=2)
    ...     return found.averages["power"]
    >>> value, slope = jax.jvp(power, (jnp.array(1.0),), (jnp.array(1.0),))
    >>> print(round(float(value), 9), bool(abs(slope) < 1e-9))  # its largest
    0.01 True
    """
    x = check.state("x0", x0)
    check.system("system", system)
    system = cast(system, x.dtype)
    sampling = sampling_of(
        system,
        x,
        transient=transient,
        samples=samples,
        steps=steps,
        stepper=stepper,
        compact=compact,
        section=section,
        max_return=max_return,
        transient_time=transient_time,
        average=average,
        always_averages=True,
        lanes=lanes_of((system, x)),
    )
    return _settled(sampling, x)


@eqx.filter_jit
def _settled(sampling: Sampling, x0: Array) -> SettledAverage:
    averaging, nowhere = sampling.averaging, jnp.zeros((0,), x0.dtype)
    assert averaging is not None
    point = sampling.point(nowhere, x0)

    def run(x0: Array) -> Any:
        return sampling.outcome(integrate(*sampling.problem(point, x0)))

    kept, result, end = kernel_if_it_fits(run, sampling.compact)(x0)
    # The problem is built outside of the rule for derivatives, where the traced numbers that
    # functions close over become arguments.
    problem, period = sampling.around(point, x0)
    row = only_if_valid(_row, sampling, problem, period, kept, result)
    return SettledAverage(averaging.named(row), period_outcome(period, result), end)


def _row(
    sampling: Sampling, problem: Problem, period: Array, kept: Kept, result: RESULTS
) -> tuple[Array, Array]:
    """Whether a lane has averages, and all their numbers."""
    return result == RESULTS.successful, sampling.averaged(problem, period, kept, result)
