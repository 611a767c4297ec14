"""Lyapunov exponents from the variational equation, with standard errors."""

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfil.exponents.batch_means import BATCHES, averages, batch_ends
from jaxfil.exponents.card import average_card
from jaxfil.exponents.intervals import Interval, Pace, interval_of, pace_of
from jaxfil.exponents.variational import Variation, propagate, vary
from jaxfil.integrate.lane.problem import Problem, period_outcome
from jaxfil.integrate.lane.state import LoopState, is_running
from jaxfil.integrate.loop.extensions import problem_of
from jaxfil.integrate.loop.iterate import advance, finish
from jaxfil.integrate.loop.start import initial_state
from jaxfil.integrate.run.step_choice import StepCount
from jaxfil.integrate.steppers.explicit import Stepper, tableau_of
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import build
from jaxfil.model import check
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.model.types import Axes, Scalar, State
from jaxfil.xla.kernel import kernel_if_it_fits
from jaxfil.xla.lanes import lanes_of
from jaxfil.xla.select import select


class LyapunovSpectrum(eqx.Module):
    """All exponents of one orbit, largest first, per unit time.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall = jf.systems.ImpactOscillator(damping=1.0)  # too weakly forced to reach it
    >>> found = jf.lyapunov_spectrum(
    ...     wall, jnp.array([0.1, 0.0]), periods=20, transient=0, steps=20, stepper=jf.RK4())
    >>> found.running.shape, bool(found.settled)
    ((20, 2), True)
    """

    exponents: Float[Array, " n"]
    """The exponents. −inf for a direction that sticking removes completely. NaN for a direction
    that contracts against another by more than rounding resolves within one interval (use a shorter
    `interval`), and for a failed lane."""
    standard_error: Float[Array, " n"]
    """Standard error of each exponent, by batch means; 0 for −inf."""
    running: Float[Array, "batches n"]
    """The estimates at `times`, for a picture of the convergence."""
    times: Float[Array, " batches"]
    """The times of the running average."""
    x0: Float[Array, " n"]
    """The state before the transient, which selects one of several coexisting attractors."""
    x_final: Float[Array, " n"]
    """The state at the end."""
    settled: Bool[Array, ""]
    """False if the growth changed permanently within the average, as at the end of a transient. The
    exponents then belong to no single motion; use a longer transient."""
    result: RESULTS
    """The lane's outcome."""
    compact: bool = eqx.field(static=True, default=False)
    """Whether the stages of a step were a loop in the program (see `solve`)."""

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the running estimates of one orbit's exponents; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        return average_card(self, self.exponents)


def lyapunov_spectrum(
    system: System,
    x0: State,
    *,
    periods: int = 1000,
    transient: int = 200,
    steps: StepCount = 40,
    interval: Scalar | None = None,
    stepper: Stepper | None = None,
    compact: bool | None = None,
) -> LyapunovSpectrum:
    """All n Lyapunov exponents of the orbit from `x0` at t = 0.

        λ_i = lim (1/t) Σ_k log R_ii(k),    M_k Q_{k−1} = Q_k R(k)

    with M_k the derivative of the flow over period k. n tangent vectors are propagated along the
    orbit, exactly through crossings, slides and resets. They are orthonormalised once a forcing
    period, before and after each contact that may remove a direction, and along slides. The orbit
    first runs `transient` periods. The tangent vectors join it for the last quarter of them (in a
    compact program from the start), which aligns them; the average is then taken over `periods`
    more.

    Runs under `jax.jit` and `equinox.filter_vmap` (over a batched system, or over x0),
    each lane with its own outcome, and has forward-mode derivatives.

    **Arguments**

    - `system`: any `System`.
    - `x0`: initial state, shape (n,).
    - `periods`, `transient`: averaged forcing periods, and periods before the average.
    - `steps`: steps per forcing period; or `Adaptive`, a tolerance; or the result of `choose_step`,
      which has its own `stepper`.
    - `interval`: the time that replaces the forcing period; an autonomous system needs one. Within
      an interval the ratio of the growth of two directions must stay far from 1/eps.
    - `stepper`: as in `solve`; by default `diffrax.Dopri8()`.
    - `compact`: as in `solve`.

    **Returns** a `LyapunovSpectrum`.

    **Outcomes**: `successful`, `max_steps_reached`, `zeno`, `nonunique`, `mode_undecided`,
    `reset_undecided`, `undeclared_sliding`, `nonfinite`, `step_too_long`, `invalid_period`.

    **Source**: G. Benettin, L. Galgani, A. Giorgilli and J.-M. Strelcyn, Lyapunov characteristic
    exponents for smooth dynamical systems, Meccanica 15 (1980) 9–30; P. C. Müller, Calculation of
    Lyapunov exponents for dynamic systems with discontinuities, Chaos, Solitons and Fractals 5
    (1995) 1671–1681.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall = jf.systems.ImpactOscillator(damping=1.0)  # too weakly forced to reach it
    >>> found = jf.lyapunov_spectrum(
    ...     wall, jnp.array([0.1, 0.0]), periods=20, transient=0, steps=20, stepper=jf.RK4())
    >>> print(round(float(found.exponents.sum()), 2))  # minus the damping
    -1.0
    """
    x = check.state("x0", x0)
    check.system("system", system)
    system = cast(system, x.dtype)
    between = interval_of(system, interval, x.dtype)
    pace = pace_of(
        system,
        x,
        lanes_of((system, x)),
        periods=periods,
        transient=transient,
        steps=steps,
        stepper=stepper,
        compact=compact,
        tangents=x.size,
    )
    return _spectrum(system, x, between, pace, min(BATCHES, int(periods)))


@eqx.filter_jit
def _spectrum(
    system: System, x0: Array, interval: Interval, pace: Pace, batches: int
) -> LyapunovSpectrum:
    def run(x0: Array) -> LyapunovSpectrum:
        between = interval.of(system, x0, pace)
        grid = between.grid(pace.periods + pace.transient, pace.steps)
        field = build(system, x0, compact=pace.compact)
        problem = problem_of(field, tableau_of(pace.stepper), grid)
        ends = batch_ends(pace.periods, batches)
        state, growth = _grown(problem, pace, ends, x0)
        times = ends.astype(x0.dtype) * between.length
        growth = select(state.counts.index >= grid.num_steps, growth, jnp.nan)
        exponents, running, error, settled = averages(growth, times)
        return LyapunovSpectrum(
            exponents=exponents,
            standard_error=error,
            running=running,
            times=times,
            x0=x0,
            x_final=pack(state.motion.x, x0.dtype),
            settled=settled,
            result=period_outcome(between.length, state.result),
            compact=pace.compact,
        )

    # The averages too, because many small operations outside of a kernel are slow to compile.
    return kernel_if_it_fits(run, pace.compact)(x0)


def _grown(problem: Problem, pace: Pace, ends: Array, x0: Array) -> tuple[LoopState, Array]:
    """The end of the run, and the growth of the logarithms up to each of `ends`."""
    transient, steps = pace.transient, pace.steps
    state = initial_state(problem, problem.system.unpack(x0))
    # The frame costs n times the orbit, so it joins late in the transient. In a compact program a
    # loop without it costs more than it saves.
    if not problem.compact:
        alone = (transient - transient // 4) * steps
        state = jax.lax.while_loop(
            lambda state: is_running(problem.grid, state, alone),
            lambda state: advance(problem, state),
            state,
        )

    def batch(variation: Variation, stop: Array) -> tuple[Variation, Array]:
        after = propagate(problem, steps, variation, stop)
        return after, pack(after.growth, x0.dtype)

    first = vary(problem.system, state, steps)
    last, growth = jax.lax.scan(batch, first, (transient + jnp.append(0, ends)) * steps)
    return finish(problem.grid, last.state), growth[1:]  # the first only aligned the frame
