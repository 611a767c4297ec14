"""Lyapunov exponents by chaos synchronisation, which needs no derivative.

A system enters twice: as a drive and as a response that is pulled towards it,
ẋ = F(t, x), ẏ = F(t, y) + ε(x − y). Small distances |x − y| grow at the rate λ1 − ε. What leaves is
λ1, either as the smallest coupling ε of a grid at which the two synchronise, or from the rate
itself. Stefański and Kapitaniak, Discrete Dynamics in Nature and Society 4 (2000) 207–215.
"""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfil.exponents.batch_means import BATCHES, average_card, averages, batch_ends
from jaxfil.exponents.drive_response import drive_response
from jaxfil.exponents.intervals import Counts, counts_of, interval_of
from jaxfil.integrate.components import Components, build, pack, unpack
from jaxfil.integrate.initial_mode import initial_state
from jaxfil.integrate.loop import advance, finish, integrate_in_kernel
from jaxfil.integrate.problem import NOTHING, Problem, grid_of_periods
from jaxfil.integrate.state import is_running
from jaxfil.integrate.stepper import Stepper, checked_stepper, tableau_of
from jaxfil.model import check
from jaxfil.model.card import precision
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.xla.kernel import kernel_if_it_fits

# A distance of fewer eps of the size of the state is rounding.
_RESOLVED = 64


class Synchronization(eqx.Module):
    """Which couplings synchronise drive and response.

    - `exponent`: the smallest of `couplings` that does, an estimate of λ1; NaN if none does.
    - `couplings`: shape (c,), as given; `distances`: shape (c,), the smallest distance |x − y|
      seen, at the ends of periods, until it fell to `tolerance`; `synchronized`: shape (c,).
    - `tolerance`: the distance that counts as synchronised; `time`: how long they were given.
    - `bias`: by how much the estimate is expected to lie above λ1: half a step of the grid, and
      log(d0/tolerance)/time, since the distance must fall from its initial d0 within that time.
    - `results`: an outcome for each coupling, shape (c,).
    """

    exponent: Float[Array, ""]
    couplings: Float[Array, " c"]
    distances: Float[Array, " c"]
    synchronized: Bool[Array, " c"]
    tolerance: Float[Array, ""]
    time: Float[Array, ""]
    bias: Float[Array, ""]
    x0: Float[Array, " n"]
    results: RESULTS

    def plot(self, ax: Any = None) -> Any:
        """Draw the distances against the couplings; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        told = precision(self.exponent)
        if isinstance(self.exponent, jax.core.Tracer) or self.exponent.ndim > 0:
            return f"Synchronization{told}: a batch of shape {self.exponent.shape}"
        state = np.array2string(np.asarray(self.x0), precision=6, separator=", ")
        low, high = float(self.couplings[0]), float(self.couplings[-1])
        return "\n".join(
            [
                f"Synchronization{told}: exponent {float(self.exponent):.5g}, biased by "
                f"about {float(self.bias):.2g}",
                f"  {int(np.sum(self.synchronized))} of {self.couplings.size} couplings from "
                f"{low:g} to {high:g} synchronise to {float(self.tolerance):.1g} within a time of "
                f"{float(self.time):.6g}, from x0 = {state}",
            ]
        )


class TransverseExponent(eqx.Module):
    """λ1 from the rate at which a small distance between drive and response grows.

    - `exponent`: that rate plus the coupling, per unit time, and its `standard_error` by batch
      means. NaN where the distance fell below what rounding resolves within one interval.
    - `running`: the estimates at `times`, shape (batches,).
    - `separation`: the distance to which it was set back after every interval.
    - `settled`: as in `LyapunovSpectrum`; `x0`, `x_final`: the drive's first and last state.
    - `result`: the lane's outcome.
    """

    exponent: Float[Array, ""]
    standard_error: Float[Array, ""]
    running: Float[Array, " batches"]
    times: Float[Array, " batches"]
    separation: Float[Array, ""]
    x0: Float[Array, " n"]
    x_final: Float[Array, " n"]
    settled: Bool[Array, ""]
    result: RESULTS

    @property
    def exponents(self) -> Float[Array, " 1"]:
        """The one that is known, as `LyapunovSpectrum.exponents`."""
        return self.exponent[..., None]

    def plot(self, ax: Any = None) -> Any:
        """Draw the running estimate; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        return average_card("TransverseExponent", self, self.exponent, self.standard_error)


def synchronization_exponent(
    system: System,
    x0: Float[Array, " n"],
    couplings: Float[Array, " c"],
    *,
    periods: int = 1500,
    transient: int = 200,
    steps: int = 40,
    tolerance: Array | float = 1e-10,
    interval: Array | float | None = None,
    stepper: Any = None,
) -> Synchronization:
    """The largest Lyapunov exponent as the smallest coupling that synchronises two copies.

    The drive runs `transient` periods from `x0` at t = 0. The response starts 1 % away from it, and
    both run until |x − y| ≤ `tolerance`, for `periods` periods at most.

    **Arguments**

    - `couplings`: shape (c,), ascending. Their spacing is the resolution of the answer.
    - `tolerance`: too large a one is met by chance in the middle of chaos: 1e-3 finds almost any
      coupling to synchronise.
    - `periods`: short runs find too large an exponent, as `Synchronization.bias` tells.
    - the others: as in `lyapunov_spectrum`.

    Runs under `jax.jit` and `equinox.filter_vmap`: over parameters here, over couplings inside.

    **Returns** a `Synchronization`. `transverse_exponent` is sharper by an order of magnitude.
    """
    x = check.state("x0", x0)
    check.system("system", system)
    system = cast(system, x.dtype)
    grid = jnp.asarray(couplings, x.dtype)
    if grid.ndim != 1 or grid.shape[0] == 0:
        raise ValueError(f"`couplings` must be of shape (c,) with c ≥ 1, got shape {grid.shape}.")
    values = check.concrete(grid)
    if values is not None and not np.all(np.diff(values) > 0):
        raise ValueError(f"`couplings` must be ascending, got {values}.")
    duration = interval_of(system, interval, x.dtype)
    within = check.scalar("tolerance", tolerance, x.dtype, positive=True)
    counts = counts_of(periods, transient, steps)
    stepper = checked_stepper(stepper)
    return _threshold(system, x, grid, within, duration, counts, stepper)


def _distance(z: Components) -> Array:
    n = len(z) // 2
    return jnp.sqrt(sum((a - b) ** 2 for a, b in zip(z[:n], z[n:], strict=True)))


def _settle(
    system: System, x0: Array, duration: Array, counts: Counts, stepper: Stepper
) -> tuple[Array, RESULTS]:
    """The drive alone, after its transient."""
    _, transient, steps = counts
    grid = grid_of_periods(duration, jnp.maximum(transient, 1), steps)
    problem = Problem(build(system, x0), tableau_of(stepper), grid, NOTHING)
    state = integrate_in_kernel(problem, unpack(x0))
    moved = transient > 0
    x = jnp.where(moved, pack(state.x, x0.dtype), x0)
    return x, RESULTS.where(moved, state.result, RESULTS.successful)


def _away(x: Array, part: float) -> tuple[Array, Array]:
    """A state at a distance of `part` of the size of x, in no special direction; the distance."""
    direction = np.random.default_rng(0).normal(size=x.shape[0])
    unit = jnp.asarray(direction / np.linalg.norm(direction), x.dtype)
    norm = jnp.sqrt(jnp.sum(x * x))
    distance = part * jnp.where(norm > 0, norm, 1.0)
    return x + distance * unit, distance


@eqx.filter_jit
def _threshold(
    system: System,
    x0: Array,
    couplings: Array,
    tolerance: Array,
    duration: Array,
    counts: Counts,
    stepper: Stepper,
) -> Synchronization:
    periods, transient, steps = counts
    x, settled = _settle(system, x0, duration, counts, stepper)
    y, distance = _away(x, 0.01)
    z = jnp.concatenate([x, y])
    grid = grid_of_periods(duration, periods, steps, transient)

    def lane(coupling: Array) -> tuple[Array, RESULTS]:
        pair = build(drive_response(system, coupling), z)
        problem = Problem(pair, tableau_of(stepper), grid, NOTHING)

        def on(carry: tuple) -> Array:
            state, nearest, _ = carry
            return is_running(grid, state) & (nearest > tolerance)

        def go(carry: tuple) -> tuple:
            state, nearest, left = carry
            after = advance(problem, state)
            left = left - (after.index - state.index)
            due = (left <= 0) & (after.index > state.index)
            nearest = jnp.where(due, jnp.minimum(nearest, _distance(after.x)), nearest)
            return after, nearest, jnp.where(due, steps, left)

        begun = initial_state(problem, unpack(z))
        state, nearest, _ = jax.lax.while_loop(on, go, (begun, _distance(begun.x), steps))
        met = (nearest <= tolerance) & (state.result == RESULTS.successful)
        return nearest, RESULTS.where(met, state.result, finish(grid, state).result)

    nearest, results = jax.vmap(kernel_if_it_fits(lane))(couplings)
    results = RESULTS.where(settled == RESULTS.successful, results, settled)
    nearest = jnp.where(results == RESULTS.successful, nearest, jnp.nan)
    met = nearest <= tolerance
    time = periods.astype(x0.dtype) * duration
    spacing = jnp.diff(couplings)[jnp.argmax(met) - 1] if couplings.shape[0] > 1 else 0.0
    return Synchronization(
        exponent=jnp.where(jnp.any(met), couplings[jnp.argmax(met)], jnp.nan),
        couplings=couplings,
        distances=nearest,
        synchronized=met,
        tolerance=tolerance,
        time=time,
        bias=spacing / 2 + jnp.log(distance / tolerance) / time,
        x0=x0,
        results=results,
    )


def transverse_exponent(
    system: System,
    x0: Float[Array, " n"],
    *,
    coupling: Array | float = 0.0,
    periods: int = 2000,
    transient: int = 200,
    steps: int = 40,
    interval: Array | float | None = None,
    stepper: Any = None,
) -> TransverseExponent:
    """The largest Lyapunov exponent from the rate of log|x − y| at small distance, plus ε.

    Drive and response start eps^0.4·|x| apart after the drive's `transient` periods from `x0` at
    t = 0, and the response is set back to that distance once a period. The rate is λ1 − ε; λ1 is
    the coupling at which it is zero, whichever coupling it was measured at.

    **Arguments**: as in `lyapunov_spectrum`; `coupling` is ε.

    **Returns** a `TransverseExponent`.
    """
    x = check.state("x0", x0)
    check.system("system", system)
    system = cast(system, x.dtype)
    strength = check.scalar("coupling", coupling, x.dtype)
    duration = interval_of(system, interval, x.dtype)
    counts = counts_of(periods, transient, steps)
    stepper = checked_stepper(stepper)
    return _transverse(system, x, strength, duration, counts, stepper, min(BATCHES, periods))


@eqx.filter_jit
def _transverse(
    system: System,
    x0: Array,
    coupling: Array,
    duration: Array,
    counts: Counts,
    stepper: Stepper,
    batches: int,
) -> TransverseExponent:
    periods, transient, steps = counts
    x, settled = _settle(system, x0, duration, counts, stepper)
    eps = float(jnp.finfo(x0.dtype).eps)
    y, separation = _away(x, eps**0.4)
    n, z = x.shape[0], jnp.concatenate([x, y])
    pair = build(drive_response(system, coupling), z)

    def period(carry: tuple) -> tuple:
        k, z, growth, _ = carry
        grid = grid_of_periods(duration, jnp.ones_like(steps), steps, transient + k)
        state = integrate_in_kernel(Problem(pair, tableau_of(stepper), grid, NOTHING), unpack(z))
        end = pack(state.x, x0.dtype)
        distance = _distance(state.x)
        resolved = distance > _RESOLVED * eps * jnp.sqrt(jnp.sum(end * end))
        growth = growth + jnp.where(resolved, jnp.log(distance / separation), jnp.nan)
        apart = (end[n:] - end[:n]) * (separation / jnp.where(resolved, distance, 1.0))
        return k + 1, jnp.concatenate([end[:n], end[:n] + apart]), growth, state.result

    def batch(carry: tuple, stop: Array) -> tuple:
        k, z, result = carry
        k, z, growth, result = jax.lax.while_loop(
            lambda s: (s[0] < stop) & (s[3] == RESULTS.successful),
            period,
            (k, z, jnp.zeros_like(duration), result),
        )
        return (k, z, result), growth

    ends = batch_ends(periods, batches)
    (_, z, result), growth = jax.lax.scan(batch, (jnp.zeros_like(periods), z, settled), ends)
    times = ends.astype(x0.dtype) * duration
    growth = jnp.where(result == RESULTS.successful, growth, jnp.nan)
    growth = growth + coupling * jnp.diff(times, prepend=0.0)
    exponent, running, error, steady = averages(growth[:, None], times)
    return TransverseExponent(
        exponent=exponent[0],
        standard_error=error[0],
        running=running[:, 0],
        times=times,
        separation=separation,
        x0=x0,
        x_final=z[:n],
        settled=steady,
        result=result,
    )
