"""Lyapunov exponents from the variational equation.

A system and an initial state enter; all n exponents of the orbit they lead to leave, each with a
standard error, a running estimate, and whether the orbit was the same kind of motion throughout.
"""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfil.exponents.batch_means import BATCHES, average_card, averages, batch_ends
from jaxfil.exponents.intervals import Counts, counts_of, interval_of
from jaxfil.exponents.variational import Variation, propagate, vary
from jaxfil.integrate.components import build, pack, unpack
from jaxfil.integrate.initial_mode import initial_state
from jaxfil.integrate.loop import advance, finish
from jaxfil.integrate.problem import NOTHING, Problem, grid_of_periods
from jaxfil.integrate.state import LoopState, is_running
from jaxfil.integrate.stepper import Stepper, checked_stepper, tableau_of
from jaxfil.model import check
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.xla.kernel import kernel_if_it_fits


class LyapunovSpectrum(eqx.Module):
    """All exponents of one orbit, largest first, per unit time.

    - `exponents`: shape (n,). −inf for a direction that sticking takes away altogether. NaN for one
      that contracts against another by more than rounding resolves within one interval (take a
      shorter `interval`), and for a lane that failed.
    - `standard_error`: shape (n,), by batch means; 0 for −inf.
    - `running`: the estimates at `times`, shape (batches, n), for a picture of the convergence.
    - `times`: the time averaged over so far, shape (batches,).
    - `x0`, `x_final`: the state before the transient, which decides between coexisting attractors,
      and at the end, shape (n,).
    - `settled`: False if the growth changed for good somewhere within the average, as it does where
      a transient ends. The exponents are then those of no motion: take a longer transient.
    - `result`: the lane's outcome.
    """

    exponents: Float[Array, " n"]
    standard_error: Float[Array, " n"]
    running: Float[Array, "batches n"]
    times: Float[Array, " batches"]
    x0: Float[Array, " n"]
    x_final: Float[Array, " n"]
    settled: Bool[Array, ""]
    result: RESULTS

    def plot(self, ax: Any = None) -> Any:
        """Draw the running estimates of one orbit's exponents; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        exponents = self.exponents
        return average_card("LyapunovSpectrum", self, exponents, self.standard_error)


def lyapunov_spectrum(
    system: System,
    x0: Float[Array, " n"],
    *,
    periods: int = 1000,
    transient: int = 200,
    steps: int = 40,
    interval: Array | float | None = None,
    stepper: Any = None,
) -> LyapunovSpectrum:
    r"""The Lyapunov exponents λ_i = lim (1/T) Σ_k log R_ii(k) of the orbit from `x0` at t = 0.

    n tangent vectors are carried along the orbit, exactly through crossings, slides and resets, and
    orthonormalised once a forcing period: M_k Q_{k−1} = Q_k R(k) with M_k the derivative of the
    flow over period k. The orbit runs `transient` periods first, the last quarter of them with the
    tangent vectors, which lets them turn to where they belong; then `periods` more are averaged
    over.

    **Arguments**

    - `x0`: initial state, shape (n,).
    - `periods`, `transient`: forcing periods averaged over, and run before.
    - `steps`: steps per forcing period.
    - `interval`: the time that takes the place of the forcing period; an autonomous system needs
      one. Within an interval the ratio of two directions' growths must stay far from 1/eps.
    - `stepper`: as in `solve`; by default `diffrax.Dopri8()`.

    Runs under `jax.jit` and `equinox.filter_vmap` (over a system with batched leaves, or over x0),
    each lane with its own outcome, and has forward-mode derivatives.

    **Returns** a `LyapunovSpectrum`.

    Benettin, Galgani, Giorgilli and Strelcyn, Meccanica 15 (1980) 9–30; Müller, Chaos, Solitons and
    Fractals 5 (1995) 1671–1681 for discontinuous systems.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> decay = jf.piecewise(lambda t, x: -x, lambda t, x: -x, lambda t, x: x[0])
    >>> found = jf.lyapunov_spectrum(decay, jnp.ones(1), periods=10, transient=0, interval=0.5)
    >>> print(round(float(found.exponents[0]), 5))
    -1.0
    """
    x = check.state("x0", x0)
    check.system("system", system)
    system = cast(system, x.dtype)
    duration = interval_of(system, interval, x.dtype)
    counts = counts_of(periods, transient, steps)
    stepper = checked_stepper(stepper)
    return _spectrum(system, x, duration, counts, stepper, min(BATCHES, periods))


@eqx.filter_jit
def _spectrum(
    system: System, x0: Array, duration: Array, counts: Counts, stepper: Stepper, batches: int
) -> LyapunovSpectrum:
    periods, transient, steps = counts
    grid = grid_of_periods(duration, transient + periods, steps)
    problem = Problem(build(system, x0), tableau_of(stepper), grid, NOTHING)
    alone = (transient - transient // 4) * steps
    ends = batch_ends(periods, batches)
    stops = (transient + jnp.append(0, ends)) * steps

    def run(x0: Array) -> tuple[LoopState, Array]:
        state = jax.lax.while_loop(
            lambda state: is_running(grid, state, alone),
            lambda state: advance(problem, state),
            initial_state(problem, unpack(x0)),
        )

        def batch(variation: Variation, stop: Array) -> tuple[Variation, Array]:
            after = propagate(problem, steps, variation, stop)
            return after, jnp.stack(after.growth)

        last, growth = jax.lax.scan(batch, vary(problem.system, state, steps), stops)
        return finish(grid, last.state), growth

    state, growth = kernel_if_it_fits(run)(x0)
    times = ends.astype(x0.dtype) * duration
    done = state.index >= grid.num_steps
    growth = jnp.where(done, growth[1:], jnp.nan)  # the first only turned the frame
    exponents, running, error, settled = averages(growth, times)
    return LyapunovSpectrum(
        exponents=exponents,
        standard_error=error,
        running=running,
        times=times,
        x0=x0,
        x_final=pack(state.x, x0.dtype),
        settled=settled,
        result=state.result,
    )
