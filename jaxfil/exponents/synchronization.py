"""Lyapunov exponents by chaos synchronisation, without derivatives.

In the system of a drive and a response coupled to it, ẋ = F(t, x), ẏ = F(t, y) + ε(x − y), small
distances |x − y| grow at the rate λ1 − ε. λ1 is either the smallest coupling ε of a grid at which
the two synchronise, or follows from the rate itself. Stefański and Kapitaniak, Discrete Dynamics in
Nature and Society 4 (2000) 207–215.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.exponents.batch_means import BATCHES, averages, batch_ends
from jaxfil.exponents.coupled import Synchronization, TransverseExponent
from jaxfil.exponents.distance import away, distance_in, or_one, size_of
from jaxfil.exponents.drive_response import drive_response
from jaxfil.exponents.intervals import Interval, Pace, interval_of, pace_of
from jaxfil.exponents.separation import parted
from jaxfil.integrate.lane.problem import Problem, period_outcome
from jaxfil.integrate.lane.state import is_running
from jaxfil.integrate.loop.extensions import problem_of
from jaxfil.integrate.loop.iterate import advance, finish, integrate
from jaxfil.integrate.loop.start import initial_state
from jaxfil.integrate.run.step_choice import StepCount
from jaxfil.integrate.steppers.explicit import Stepper, tableau_of
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import build
from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.model.types import Scalar, State
from jaxfil.xla.kernel import kernel_if_it_fits
from jaxfil.xla.lanes import lanes_of
from jaxfil.xla.select import select

# The distances that count as synchronised by default, in sizes of the drive. Each is far above
# rounding, which a pair that is driven keeps, and far below an attractor.
_TOLERANCES = {"float64": 1e-10, "float32": 1e-5, "float16": 4e-3}
# The distance of a response at its start, in sizes of the drive.
_START = 0.01


def synchronization_exponent(
    system: System,
    x0: State,
    couplings: Float[Array, " c"] | Float[np.ndarray, " c"],
    *,
    periods: int = 1500,
    transient: int = 200,
    steps: StepCount = 40,
    tolerance: Scalar | None = None,
    interval: Scalar | None = None,
    stepper: Stepper | None = None,
    compact: bool | None = None,
) -> Synchronization:
    """The largest Lyapunov exponent as the smallest coupling that synchronises two copies.

        ẋ = F(t, x),    ẏ = F(t, y) + ε(x − y):    λ1 ≈ min {ε : |x − y| → 0}

    The drive x runs `transient` periods from `x0` at t = 0. The response y starts at a distance of
    0.01·s, and both run until |x − y| ≤ `tolerance`·s, for `periods` periods at most. The size s is
    the recent maximum of |x| at that time, without a transient that of the first period, or 1 if x
    is zero. With resets that move the state by a jump the pair has another threshold than λ1: from
    the reset of one to the reset of the other the coupling acts on the jump.

    Runs under `jax.jit` and `equinox.filter_vmap` over parameters; couplings are batched inside.

    **Arguments**

    - `system`: any `System`.
    - `x0`: initial state of the drive, shape (n,).
    - `couplings`: values of ε, per unit of time, shape (c,), ascending. Their spacing is the
      resolution of the result.
    - `periods`: forcing periods of drive and response. Short runs give too large an exponent (see
      `Synchronization.bias`).
    - `transient`: forcing periods of the drive before the response starts.
    - `steps`: steps per forcing period; or `Adaptive`, a tolerance; or the result of `choose_step`,
      which has its own `stepper`.
    - `tolerance`: the distance that counts as synchronised, relative to the size s, above 0 and
      below 0.01; by default 1e-10, in float32 1e-5. A large one is reached by chance within chaos:
      at 1e-3 almost any coupling synchronises. One below rounding may never be reached.
    - `interval`: the time that replaces the forcing period; an autonomous system needs one.
    - `stepper`: as in `solve`; by default `diffrax.Dopri8()`.
    - `compact`: as in `solve`.

    **Returns** a `Synchronization`. `transverse_exponent` is sharper by an order of magnitude.

    **Outcomes**, one for each coupling in `results`: `successful`, whether it synchronises or not,
    `max_steps_reached`, `zeno`, `nonunique`, `mode_undecided`, `undeclared_sliding`, `nonfinite`,
    `reset_undecided`, `step_too_long`, `invalid_period`.

    **Source**: A. Stefański and T. Kapitaniak, Using chaos synchronization to estimate the largest
    Lyapunov exponent of nonsmooth systems, Discrete Dynamics in Nature and Society 4 (2000)
    207–215.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall = jf.systems.ImpactOscillator(damping=1.0)  # λ1 = λ2 = −1/2 away from it
    >>> found = jf.synchronization_exponent(
    ...     wall, jnp.array([0.1, 0.0]), jnp.array([-0.55, -0.3]), periods=20, transient=0,
    ...     steps=20, stepper=jf.RK4())
    >>> print(round(float(found.exponent), 3))  # the first above λ1
    -0.3
    """
    x = check.state("x0", x0)
    check.system("system", system)
    system = cast(system, x.dtype)
    grid = check.numbers("couplings", couplings, x.dtype, "real numbers of shape (c,) with c ≥ 1")
    if grid.ndim != 1 or grid.shape[0] == 0:
        raise ValueError(f"`couplings` must be of shape (c,) with c ≥ 1, got shape {grid.shape}.")
    values = check.concrete(grid)
    # The first that synchronises is the result.
    if values is not None and not np.all(np.diff(values) > 0):
        raise ValueError(f"`couplings` must be ascending, got {values}.")
    period = interval_of(system, interval, x.dtype)
    tolerance = _TOLERANCES[x.dtype.name] if tolerance is None else tolerance
    limit = check.scalar("tolerance", tolerance, x.dtype, positive=True)
    known = check.concrete(limit)
    if known is not None and known >= _START:
        raise ValueError(
            f"`tolerance` must be below {_START}, the distance at which the response starts, got "
            f"{check.told(tolerance)}."
        )
    pace = pace_of(
        drive_response(system, grid[0]),  # one system of twice the size
        jnp.concatenate([x, x]),
        lanes_of((system, x, grid)) * grid.shape[0],
        periods=periods,
        transient=transient,
        steps=steps,
        stepper=stepper,
        compact=compact,
    )
    return _threshold(system, x, grid, limit, period, pace)


def _settle(
    system: System, x0: Array, interval: Interval, transient: Array, pace: Pace
) -> tuple[Interval, Array, Array, RESULTS]:
    """The interval of the system, the drive after its transient (x0 without one), its size, and the
    outcome."""

    def run(x0: Array) -> tuple[Interval, Array, Array, RESULTS]:
        period = interval.of(system, x0, pace)
        grid = period.grid(jnp.maximum(transient, 1), pace.steps)
        field = build(system, x0, compact=pace.compact)
        problem = problem_of(field, tableau_of(pace.stepper), grid)
        state = integrate(problem, problem.system.unpack(x0))
        # A grid needs a step: without a transient one period is run and discarded.
        moved = transient > 0
        x = select(moved, pack(state.motion.x, x0.dtype), x0)
        # A drive may pass near the origin, where it is not as small as its state.
        recent = size_of(pack(state.motion.scale, x0.dtype))
        recent = select(state.result == RESULTS.successful, recent, 0.0)
        size = or_one(jnp.maximum(recent, size_of(x)))
        return period, x, size, RESULTS.where(moved, state.result, RESULTS.successful)

    return kernel_if_it_fits(run, pace.compact)(x0)


@eqx.filter_jit
def _threshold(
    system: System,
    x0: Array,
    couplings: Array,
    tolerance: Array,
    interval: Interval,
    pace: Pace,
) -> Synchronization:
    periods, transient, steps = pace.periods, pace.transient, pace.steps
    interval, x, size, settled = _settle(system, x0, interval, transient, pace)

    def lane(coupling: Array) -> tuple[Array, RESULTS]:
        grid = interval.grid(periods, steps, transient)
        z = jnp.concatenate([x, away(system, grid.t0, x, _START * size)])
        pair = build(drive_response(system, coupling), z, compact=pace.compact)
        problem = problem_of(pair, tableau_of(pace.stepper), grid)

        def on(carry: tuple) -> Array:
            state, nearest, _ = carry
            return is_running(grid, state) & (nearest > tolerance)

        def go(carry: tuple) -> tuple:
            state, nearest, left = carry
            after = advance(problem, state)
            left = left - (after.counts.index - state.counts.index)
            due = (left <= 0) & (after.counts.index > state.counts.index)
            nearest = select(due, jnp.minimum(nearest, distance_in(after.motion.x, size)), nearest)
            return after, nearest, select(due, steps, left)

        begun = initial_state(problem, pair.unpack(z))
        first = begun, distance_in(begun.motion.x, size), steps
        state, nearest, _ = jax.lax.while_loop(on, go, first)
        met = (nearest <= tolerance) & (state.result == RESULTS.successful)
        result = RESULTS.where(met, state.result, finish(grid, state).result)
        result = RESULTS.where(settled == RESULTS.successful, result, settled)
        result = period_outcome(interval.length, result)
        return select(result == RESULTS.successful, nearest, jnp.nan), result

    def threshold(nearest: Array, results: RESULTS) -> Synchronization:
        met = nearest <= tolerance
        time = periods.astype(x0.dtype) * interval.length
        first = jnp.argmax(met)  # also 0 without a synchronised one
        # λ1 is in the step of the grid that ends at the result, whose middle is half a step below.
        # No step ends at the lowest coupling.
        spacing = jnp.diff(couplings, prepend=jnp.nan)[first]
        return Synchronization(
            exponent=select(jnp.any(met), couplings[first], jnp.nan),
            couplings=couplings,
            distances=nearest * size,
            synchronized=met,
            tolerance=tolerance * size,
            time=time,
            bias=spacing / 2 + jnp.log(_START / tolerance) / time,
            x0=x0,
            results=results,
            compact=pace.compact,
        )

    return kernel_if_it_fits(threshold)(*jax.vmap(kernel_if_it_fits(lane, pace.compact))(couplings))


def transverse_exponent(
    system: System,
    x0: State,
    *,
    coupling: Scalar = 0.0,
    periods: int = 2000,
    transient: int = 200,
    steps: StepCount = 40,
    interval: Scalar | None = None,
    stepper: Stepper | None = None,
    compact: bool | None = None,
) -> TransverseExponent:
    """The largest Lyapunov exponent from the rate at which drive and response separate.

        λ1 = ε + lim (1/t) log (|x − y|(t) / |x − y|(0))    at small distance

    The drive x runs from `x0` at t = 0. For the last quarter of the `transient` periods the
    response y joins it, as in `drive_response`, at a distance of eps^0.4·|x|, and is reset to that
    distance once a period, so that it aligns with the direction of fastest growth before growth is
    counted. Where a period ends between an impact of one of them and the same impact of the other,
    this is done a part of a period later. The rate is zero at the coupling λ1, and λ1 does not
    depend on the coupling used, unless a reset moves the state by a jump: the coupling acts on the
    jump from the reset of one to the reset of the other, and only ε = 0 gives λ1.

    **Arguments**

    - `system`: any `System`.
    - `x0`: initial state of the drive, shape (n,).
    - `coupling`: ε, per unit of time.
    - `periods`, `transient`: averaged forcing periods, and periods before the average.
    - `steps`: steps per forcing period; or `Adaptive`, a tolerance; or the result of `choose_step`,
      which has its own `stepper`.
    - `interval`: the time that replaces the forcing period; an autonomous system needs one.
    - `stepper`: as in `solve`; by default `diffrax.Dopri8()`.
    - `compact`: as in `solve`.

    **Returns** a `TransverseExponent`.

    **Outcomes**: `successful`, `max_steps_reached`, `zeno`, `nonunique`, `mode_undecided`,
    `reset_undecided`, `undeclared_sliding`, `nonfinite`, `step_too_long`, `invalid_period`.

    **Source**: A. Stefański and T. Kapitaniak, Discrete Dynamics in Nature and Society 4 (2000)
    207–215, for the coupling; G. Benettin, L. Galgani and J.-M. Strelcyn, Kolmogorov entropy and
    numerical experiments, Physical Review A 14 (1976) 2338–2345, for the reset of the distance.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall = jf.systems.ImpactOscillator(damping=1.0)  # λ1 = λ2 = −1/2 away from it
    >>> found = jf.transverse_exponent(
    ...     wall, jnp.array([0.1, 0.0]), periods=20, transient=0, steps=20, stepper=jf.RK4())
    >>> print(round(float(found.exponent), 2))
    -0.5
    """
    x = check.state("x0", x0)
    check.system("system", system)
    system = cast(system, x.dtype)
    strength = check.scalar("coupling", coupling, x.dtype)
    period = interval_of(system, interval, x.dtype)
    pace = pace_of(
        drive_response(system, strength),
        jnp.concatenate([x, x]),
        lanes_of((system, x, strength)),
        periods=periods,
        transient=transient,
        steps=steps,
        stepper=stepper,
        compact=compact,
    )
    return _transverse(system, x, strength, period, pace, min(BATCHES, int(periods)))


@eqx.filter_jit
def _transverse(
    system: System, x0: Array, coupling: Array, interval: Interval, pace: Pace, batches: int
) -> TransverseExponent:
    # The pair already runs in the last quarter of the transient, so that its distance aligns
    # with the direction of fastest growth before it counts.
    turning = pace.transient // 4
    alone = pace.transient - turning
    interval, x, size, settled = _settle(system, x0, interval, alone, pace)

    def run(x: Array, size: Array, coupling: Array) -> TransverseExponent:
        # A distance d has an error of d from the curvature of the flow and of eps/d from rounding,
        # least at √eps; a larger one has room to shrink within an interval.
        separation = float(jnp.finfo(x.dtype).eps) ** 0.4 * size
        start = interval.grid(jnp.ones_like(pace.steps), pace.steps, alone).t0
        z = jnp.concatenate([x, away(system, start, x, separation)])
        pair = build(drive_response(system, coupling), z, compact=pace.compact)
        ends = batch_ends(pace.periods, batches)

        def problem(k: Array, begin: Array, end: Array) -> Problem:
            grid = interval.part(pace.steps, alone + k, begin, end)
            return problem_of(pair, tableau_of(pace.stepper), grid)

        stops = turning + jnp.append(0, ends)
        z, result, growth = parted(problem, z, separation, stops, settled)
        growth = growth[1:]
        times = ends.astype(x.dtype) * interval.length
        growth = select(result == RESULTS.successful, growth, jnp.nan)
        # The coupling shrinks every distance at its rate, which is added back.
        growth = growth + coupling * jnp.diff(times, prepend=0.0)
        exponent, running, error, steady = averages(growth[:, None], times)
        return TransverseExponent(
            exponent=exponent[0],
            standard_error=error[0],
            running=running[:, 0],
            times=times,
            separation=separation,
            x0=x0,
            x_final=z[: x.shape[0]],
            settled=steady,
            result=period_outcome(interval.length, result),
            compact=pace.compact,
        )

    return kernel_if_it_fits(run, pace.compact)(x, size, coupling)
