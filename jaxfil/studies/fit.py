"""`fit`: parameters of a system from measured data.

The residuals come from the event-driven solution, and their Jacobian is its derivative, exact
through every contact.
"""

from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaxfil.integrate.run.observed import Observable, checked_observable
from jaxfil.integrate.run.solve import solve
from jaxfil.integrate.run.step_choice import StepLength, dt_and_stepper
from jaxfil.integrate.steppers.adaptive import Adaptive
from jaxfil.integrate.steppers.explicit import Stepper, checked_stepper
from jaxfil.model import check
from jaxfil.model.card import outcome, precision
from jaxfil.model.observe import Observe
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import cast, get_parameter, replace_parameters, scalar_parameters
from jaxfil.model.system import System
from jaxfil.model.types import Scalar, State
from jaxfil.xla.select import select
from jaxfil.xla.thresholds import PIVOT


class Fit(eqx.Module):
    """Parameters that fit data best, from g initial guesses, with their covariance."""

    values: Float[Array, " k"]
    """The fitted parameters."""
    covariance: Float[Array, "k k"]
    """Covariance of the parameters, (JᵀJ)⁻¹ with J the Jacobian of the residuals, each divided by
    its `sigma`; without `sigma` times the variance of the residuals, which is infinite unless
    there are more numbers than parameters. Infinite for parameters that do not affect the data."""
    residuals: Float[Array, " N"]
    """(observed − measured)/sigma, in the order of the data."""
    system: System
    """The system with the fitted parameters."""
    result: RESULTS
    """The outcome of the search from the best guess."""
    all_values: Float[Array, "g k"]
    """Final parameters of the search from each guess."""
    costs: Float[Array, " g"]
    """Half the sum of squared residuals at `all_values`; NaN if there is no motion."""
    num_steps: Int[Array, " g"]
    """Number of steps of each search."""
    results: RESULTS
    """The outcome of each search."""
    parameters: tuple[str, ...] = eqx.field(static=True)
    """The names of the parameters."""

    @property
    def errors(self) -> Float[Array, " k"]:
        """Standard errors of the parameters, the square roots of the variances."""
        return jnp.sqrt(jnp.diag(self.covariance))

    def __repr__(self) -> str:
        cost = float(jnp.sqrt(jnp.mean(self.residuals**2)))
        near = self.costs <= jnp.nanmin(self.costs) * (1 + 1e-6) + 1e-300
        lines = [
            f"Fit of {type(self.system).__name__}{precision(self.values)} to "
            f"{self.residuals.shape[0]} numbers: {outcome(self.result)}",
            *(
                f"  {name} = {float(value):.10g} ± {float(error):.2g}"
                for name, value, error in zip(
                    self.parameters, self.values, self.errors, strict=True
                )
            ),
            f"  root mean square of the residuals {cost:.3g}; {int(near.sum())} of "
            f"{len(self.costs)} guesses end here",
        ]
        return "\n".join(lines)


def fit(
    system: System,
    parameters: Sequence[str],
    ts: Any,
    data: Any,
    x0: State,
    dt: StepLength,
    *,
    t0: Scalar = 0.0,
    observe: Observe | None = None,
    sigma: Any = None,
    guesses: Any = None,
    stepper: Stepper | None = None,
    tolerance: float = 1e-8,
    max_steps: int = 100,
    throw: bool = True,
) -> Fit:
    """Fit parameters of a system to measurements of its motion.

        minimise ½ Σ_i |(observe(t_i, x(t_i)) − data_i)/sigma|²

    Levenberg and Marquardt's method runs from every guess at once, each with its own damping. Where
    a step changes the number of contacts, the residuals stay continuous, but their derivatives
    jump, and are infinite at grazing. A step that does not decrease the residuals is rejected, and
    a shorter one tried. Guesses on the wrong side of such a kink may end there.

    **Arguments**

    - `system`: the `System`, which defines the values of all other parameters.
    - `parameters`: the names of k scalar parameters, or of entries as "a[0,1]".
    - `ts`: times of the measurements, shape (q,), ascending, not before `t0`.
    - `data`: measurements, shape (q,) or (q, …), finite.
    - `x0`: the state at `t0`, shape (n,).
    - `dt`, `stepper`: as in `solve`.
    - `t0`: the time of `x0`.
    - `observe`: a function of (t, x) that returns the measured quantity, with optional arguments as
      in `solve`; None for the whole state.
    - `sigma`: standard deviations of the measurements, of a shape that broadcasts to the shape of
      `data`; None if they are equal and unknown.
    - `guesses`: initial guesses, shape (g, k) or (k,); None for the system's own values.
    - `tolerance`: relative change of the parameters and the sum at which a search ends; at least 8
      eps.
    - `max_steps`: the largest number of steps of a search.
    - `throw`: whether to raise an error unless the outcome of the best guess is `successful`.

    **Returns** a `Fit`, from the guess with the smallest sum of squares.

    **Outcomes**, in `result` and for each guess in `results`: `successful`; `fit_not_converged`;
    and without a motion at the end of the search, its cause: `max_steps_reached`,
    `mode_undecided`, `zeno`, `nonunique`, `nonfinite`, `reset_undecided`, `undeclared_sliding` or
    `step_too_long`.

    **Source**: D. Marquardt, An algorithm for least-squares estimation of nonlinear parameters,
    SIAM Journal 11 (1963), as in Optimistix; J. Nocedal, S. J. Wright, Numerical Optimization
    (2006), section 10.3.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> block, x0 = jf.systems.CoulombOscillator(friction=0.3), jnp.array([3.0, 0.0])
    >>> ts = jnp.linspace(0.5, 6.0, 12)
    >>> data = 0.4 + 2.6 * jnp.cos(ts[:5])  # before it turns, with a friction of 0.4
    >>> found = jf.fit(block, ("friction",), ts[:5], data, x0, 0.1, observe=lambda t, x: x[0])
    >>> print(round(float(found.values[0]), 6))
    0.4
    """
    check.system("system", system)
    check.flags(throw=throw)
    x = check.state("x0", x0)
    system = cast(system, x.dtype)
    names = scalar_parameters(system, parameters)
    start = check.scalar("t0", t0, x.dtype)
    times, measured = _data(ts, data, start)
    seen = None if observe is None else checked_observable("observe", observe, system, x)
    _check_seen(seen, measured, x)
    spread = _spread(sigma, measured)
    own = jnp.stack([jnp.asarray(get_parameter(system, name)) for name in names])
    starts = own if guesses is None else _guesses(guesses, len(names), x.dtype)
    step, method = dt_and_stepper(dt, stepper)
    if isinstance(dt, Adaptive):  # as `solve` accepts it
        step, method = dt, stepper
    else:
        step = check.scalar("dt", step, x.dtype, positive=True)
    model = _Model(
        system,
        x,
        start,
        step,
        times,
        measured,
        spread,
        names,
        seen and seen.function,
        checked_stepper(method),
    )
    rtol = float(check.scalar("tolerance", tolerance, float, positive=True))
    rtol = max(rtol, 8 * float(jnp.finfo(x.dtype).eps))
    most = check.count("max_steps", max_steps)
    found = _search(model, jnp.atleast_2d(starts), rtol, most, sigma is None)
    if not throw:
        return found
    return raise_if_failed(found, found.result)


def _data(ts: Any, data: Any, t0: Array) -> tuple[Array, Array]:
    dtype = t0.dtype
    times = check.numbers("ts", ts, dtype, "times of shape (q,)")
    measured = check.numbers("data", data, dtype, "real numbers, a row for each of the times")
    if times.ndim != 1 or times.size == 0:
        raise ValueError(f"`ts` must be of shape (q,) with q ≥ 1, got shape {times.shape}.")
    instants = check.concrete(times)
    if instants is not None and not np.all(np.isfinite(instants)):
        raise ValueError(f"`ts` must be finite, got {check.told(instants)}.")
    since = check.concrete(t0)
    if instants is not None and since is not None and np.any(np.diff(instants, prepend=since) < 0):
        raise ValueError(
            f"`ts` must be ascending and not before `t0` = {since}, got {check.told(instants)}."
        )
    if measured.ndim == 0 or measured.shape[0] != times.shape[0]:
        raise ValueError(
            f"`data` must have a row for each of the times, got {measured.shape} and `ts` of shape "
            f"{times.shape}."
        )
    known = check.concrete(measured)
    if known is not None and not np.isfinite(known).all():
        raise ValueError(
            f"`data` must be finite, got {check.told(known)}. Omit times without a measurement."
        )
    return times, measured


def _check_seen(seen: Observable | None, measured: Array, x: Array) -> None:
    """Check that data and computed values have the same shape."""
    shape = x.shape if seen is None else seen.shape
    if measured.shape[1:] != shape:
        given = (
            "that of the whole state without `observe`" if seen is None else "as `observe` returns"
        )
        raise ValueError(
            f"`data` must have rows of shape {shape}, {given}, got rows of shape "
            f"{measured.shape[1:]}."
        )


def _spread(sigma: Any, measured: Array) -> Array:
    """Standard deviations in the shape of the data."""
    if sigma is None:
        return jnp.ones_like(measured)
    must = f"positive, and of a shape that broadcasts to that of `data`, {measured.shape}"
    spread = check.numbers("sigma", sigma, measured.dtype, must)
    known = check.concrete(spread)
    positive = known is None or (np.all(known > 0) and np.all(np.isfinite(known)))
    try:
        fits = np.broadcast_shapes(spread.shape, measured.shape) == measured.shape
    except ValueError:
        fits = False
    if not positive or not fits:
        raise ValueError(f"`sigma` must be {must}, got {check.told(sigma)}.")
    return jnp.broadcast_to(spread, measured.shape)


def _guesses(guesses: Any, k: int, dtype: Any) -> Array:
    """First guesses of k parameters."""
    must = f"finite numbers of shape (g, {k}), a column for each parameter"
    starts = jnp.atleast_2d(check.numbers("guesses", guesses, dtype, must))
    known = check.concrete(starts)
    finite = known is None or np.isfinite(known).all()
    if starts.ndim != 2 or starts.shape[1] != k or len(starts) == 0 or not finite:
        raise ValueError(f"`guesses` must be {must}, got {check.told(guesses)}.")
    return starts


class _Model(eqx.Module):
    """All inputs of the residuals except the parameters."""

    system: System
    x0: Array
    t0: Array
    dt: Array | Adaptive
    ts: Array
    data: Array
    sigma: Array
    names: tuple[str, ...] = eqx.field(static=True)
    observe: Observe | None
    stepper: Stepper = eqx.field(static=True)

    def at(self, values: Array) -> System:
        """The system with these parameters."""
        return replace_parameters(self.system, self.names, values)

    def residuals(self, values: Array, _: Any = None) -> tuple[Array, RESULTS]:
        """Residuals, NaN without a motion, and its outcome."""
        sol = solve(
            self.at(values),
            self.x0,
            self.t0,
            self.ts[-1],
            self.dt,
            stepper=self.stepper,
            saveat=diffrax.SaveAt(ts=self.ts),
            max_events=None,
            throw=False,
            observe=self.observe,
        )
        seen = sol.xs if self.observe is None else sol.observed
        assert seen is not None
        away = jnp.ravel((seen - self.data) / self.sigma)
        # A step to parameters without a motion counts as one that does not decrease the sum.
        return select(sol.result == RESULTS.successful, away, jnp.nan), sol.result


@eqx.filter_jit
def _search(model: _Model, starts: Array, rtol: float, max_steps: int, scaled: bool) -> Fit:
    # The sum may be zero; its decrease is then compared with rounding.
    solver = optx.LevenbergMarquardt(rtol=rtol, atol=rtol**2)

    def one(start: Array) -> tuple[Array, Array, Array, Array, RESULTS]:
        found = optx.least_squares(
            model.residuals,
            solver,
            start,
            has_aux=True,
            options={"jac": "fwd"},
            max_steps=max_steps,
            throw=False,
        )
        # To compute the motion at the end again would add half as much to compile.
        last, result = found.state.f_info, found.state.aux
        away, slopes = _at_end((model, found.value), (last.residual, last.jac.as_matrix()))
        ended = found.result == optx.RESULTS.successful
        end = RESULTS.where(ended, RESULTS.successful, RESULTS.fit_not_converged)
        end = RESULTS.where(result == RESULTS.successful, end, result)
        return found.value, away, slopes, found.stats["num_steps"], end

    values, all_away, all_slopes, counts, results = eqx.filter_vmap(one)(starts)
    costs = 0.5 * jnp.sum(all_away**2, axis=1)
    best = jnp.argmin(select(jnp.isnan(costs), jnp.inf, costs))
    value, away, slopes = values[best], all_away[best], all_slopes[best]
    freedom = away.shape[0] - value.shape[0]
    covariance = _inverse(slopes.T @ slopes)
    if scaled and freedom > 0:
        covariance = jnp.sum(away**2) / freedom * covariance
    elif scaled:  # without a residual to spare, the error of the data is unknown
        covariance = jnp.full_like(covariance, jnp.inf)
    return Fit(
        values=value,
        covariance=covariance,
        residuals=away,
        system=model.at(value),
        result=jax.tree.map(lambda v: v[best], results),
        all_values=values,
        costs=costs,
        num_steps=counts,
        results=results,
        parameters=model.names,
    )


@eqx.filter_custom_jvp
def _at_end(at: tuple[_Model, Array], kept: tuple[Array, Array]) -> tuple[Array, Array]:
    """Residuals and their Jacobian at the end of a search, which the solver has kept. Their
    derivatives, which it has not, come from another evaluation."""
    del at
    return kept


@_at_end.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    def computed(model: _Model, values: Array) -> tuple[Array, Array]:
        slopes, away = jax.jacfwd(lambda v: (model.residuals(v)[0],) * 2, has_aux=True)(values)
        return away, slopes

    return eqx.filter_jvp(computed, primals[0], tangents[0])


def _inverse(matrix: Array) -> Array:
    """The inverse of a symmetric matrix whose rows have units; infinite for unknowns that it does
    not determine, alone or together. These do not affect the others."""
    size = jnp.sqrt(jnp.diag(matrix))
    idle = jnp.diag(size == 0)
    scale = select(size > 0, size, 1)
    scaled = select(idle, 1.0, matrix / scale / scale[:, None])
    # Rounding leaves eigenvalues of a singular matrix with any sign.
    eigenvalues, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(scaled))
    eps = float(jnp.finfo(matrix.dtype).eps)
    lost = select(abs(eigenvalues) <= PIVOT * eps, vectors, 0.0)
    part = jnp.sqrt(jnp.sum(lost**2, axis=1)) > eps**0.5
    idle = idle | (part[:, None] & part[None, :])
    inverse = jnp.linalg.inv(scaled + lost @ lost.T) / scale / scale[:, None]
    return select(jnp.isfinite(inverse) & ~idle, inverse, jnp.inf)
