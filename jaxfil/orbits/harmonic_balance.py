"""`harmonic_balance`: a periodic orbit of a forced system as a Fourier series.

The equations are Galerkin's, ∫ (ẋ − F(t, x, sgn H)) ψ_k dt = 0 for the constant and every cosine
and sine up to harmonic K, alternating between the series and values in time.

`galerkin` takes the integrals, and the solution has derivatives by the implicit function theorem.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxfil.integrate.lane.problem import period_outcome
from jaxfil.integrate.system.closed_over import with_closed_numbers
from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.orbits.fourier import FourierOrbit, equal_phases, project
from jaxfil.orbits.galerkin import CELLS, Galerkin
from jaxfil.orbits.implicit import Equations, SystemOf, solve_implicit
from jaxfil.orbits.newton import Evaluation, newton
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.known import array_of, without_derivatives
from jaxfil.xla.select import select

Guess: TypeAlias = Orbit | Callable[[Array], Array] | Float[Array, "k n"]
"""An orbit, a function of t, or coefficients."""


def harmonic_balance(
    system: System,
    guess: Guess,
    harmonics: int,
    *,
    periods: int = 1,
    newton_steps: int = 50,
    throw: bool = True,
) -> FourierOrbit:
    """Find the periodic orbit near `guess` as a Fourier series of `harmonics` harmonics.

        ∫ (ẋ − F(t, x, sgn H)) ψ_k dt = 0    for ψ = 1, cos kωt, sin kωt, k = 1 … K

    Where the acceleration jumps, the harmonics of a velocity decay as 1/k², the harmonics of a
    position as 1/k³, and the mean square error of the position as K^(−5/2). Many harmonics gain
    little there, and shooting is exact. With friction, where the jumps are at zeros of the
    velocity, the truncation displaces these zeros, and all errors decay only as 1/K. A series
    cannot represent orbits that stick (solve `jf.smoothed`).

    **Arguments**

    - `system`: a forced `System` whose state does not jump, without `reset` and `tick`. The
      coefficients are differentiable with respect to each of its float leaves, forward and reverse,
      and once more.
    - `guess`: an `Orbit`; a function of t, shape (n,); or coefficients as in `FourierOrbit`, of any
      number of harmonics.
    - `harmonics`: K, the number of the highest harmonic.
    - `periods`: forcing periods after which the orbit closes.
    - `newton_steps`: the largest number of evaluations of the residual.
    - `throw`: whether to raise an error unless the outcome is `successful`.

    **Returns** a `FourierOrbit`. For a batch use `equinox.filter_vmap` with `throw=False`.

    **Outcomes**: `successful`; `newton_stalled`, `newton_singular` or `newton_max_steps_reached`
    without an orbit; `nonfinite` if the equations are not finite at the guess; `invalid_period`;
    `step_too_long` if a clock whose period is traced ticks twice in a 4K + 8th part of the period,
    or H crosses zero so often that crossings are missed there (more harmonics have more parts).

    **Source**: textbook: M. Krack, J. Gross, Harmonic Balance for Nonlinear Vibration Problems
    (2019), except for integrals from zero to zero of H, which are ours.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> system = jf.systems.SDOscillator(omega=0.7)
    >>> guess = lambda t: jnp.stack([3 * jnp.cos(0.7 * t), -2.1 * jnp.sin(0.7 * t)])
    >>> series = jf.harmonic_balance(system, guess, harmonics=9)
    >>> print(jnp.round(series.amplitudes[:4, 0], 3))
    [0.    2.973 0.    0.124]
    """
    check.system("system", system)
    check.flags(throw=throw)
    harmonics = check.count("harmonics", harmonics)
    periods = check.count("periods", periods)
    # Traced, so that another number does not recompile.
    budget = jnp.asarray(check.count("newton_steps", newton_steps), jnp.int32)
    if system.period is None:
        raise ValueError(
            f"`system` must be forced, but the period of {type(system).__name__} is None; use "
            "`periodic_orbit`."
        )
    jumps = "reset" if system.resets else "tick" if system.ticks else None
    if jumps is not None:
        raise ValueError(
            f"`system` must have no `{jumps}`, since a Fourier series has no jumps; got a "
            f"{type(system).__name__}. Use `periodic_orbit`."
        )
    check.period(system, jnp.result_type(float))
    first = _first(system, guess, harmonics, periods)
    system = with_closed_numbers(cast(system, first.dtype), first[0])
    equations = _Series(budget, periods, _cells(system, harmonics, periods), *first.shape)
    z, (residual, result, num_steps) = solve_implicit(equations, system, first.ravel())
    period = equations.period(system, first.dtype)
    series = FourierOrbit(z.reshape(first.shape), period, residual, result, num_steps)
    if not throw:
        return series
    return raise_if_failed(series, series.result)


def _first(
    system: System,
    guess: Any,
    harmonics: int,
    periods: int,
) -> Array:
    """The coefficients of the guess, shape (2K + 1, n)."""
    assert system.period is not None
    size = 2 * harmonics + 1
    if isinstance(guess, Orbit):
        # Phases within the orbit's own period at equally spaced times of ours, in forcing periods.
        elapsed = periods * equal_phases(4 * size * periods, guess.x0.dtype)
        forcing = guess.period if guess.system.period is None else guess.system.period
        times, back, phases = _in_own_period(
            elapsed, guess.period, forcing, guess.options.t0, periods
        )
        values = guess.states(times)[back]
        return project(phases.astype(values.dtype), values, harmonics)
    if callable(guess):
        phases = equal_phases(4 * size, jnp.result_type(float))
        check.returned("`guess`", guess, t=jnp.zeros((), phases.dtype))
        at_once = jax.eval_shape(guess, jnp.zeros((), phases.dtype))
        if not hasattr(at_once, "shape") or len(at_once.shape) != 1:
            was = check.told(at_once) if not hasattr(at_once, "shape") else at_once.shape
            raise ValueError(f"`guess` must return a state, an array of shape (n,), got {was}.")
        values: Any = jax.vmap(guess)(array_of(phases * system.period * periods))
        values = values if jnp.issubdtype(values.dtype, jnp.floating) else values.astype(float)
        return project(phases.astype(values.dtype), values, harmonics)
    must = "an Orbit, a function of t, or coefficients of shape (2K + 1, n)"
    array = check.array_or_none(guess)
    if array is None or array.ndim != 2 or array.shape[0] % 2 == 0:
        was = check.told(guess) if array is None else f"shape {array.shape}"
        raise ValueError(f"`guess` must be {must}, got {was}.")
    array = array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)
    return _resized(array, size)


@jax.jit
def _in_own_period(
    elapsed: ArrayLike, period: Array, forcing: ArrayLike, t0: Array, periods: ArrayLike
) -> tuple[Array, Array, Array]:
    """Times at which an orbit of this period has the states at given times in forcing periods,
    sorted; the indices of those times in this order; and their phases in `periods`."""
    local = jnp.mod(elapsed * forcing, period)
    order = jnp.argsort(local)
    return t0 + local[order], jnp.argsort(order), (t0 / forcing + elapsed) / periods


@ft.partial(jax.jit, static_argnames="size")
def _resized(c: Array, size: int) -> Array:
    """`size` coefficients: higher harmonics start from zero, or are dropped."""
    return jnp.zeros((size, c.shape[1]), c.dtype).at[: c.shape[0]].set(c[:size])


def _cells(system: System, harmonics: int, periods: int) -> int:
    """The number of cells of the grid, in each of which a clock of known period ticks at most
    once."""
    cells = CELLS * harmonics + 8
    system = without_derivatives(system)
    for clock in check.clocks(system):
        length, step = check.concrete(system.period), check.concrete(clock.period)
        if length is not None and step is not None and np.isfinite(length / step):
            cells = max(cells, int(np.ceil(periods * length / step)))
    return cells


class _Series(Equations):
    """Galerkin's equations for `size` = 2K + 1 coefficients of n components."""

    newton_steps: Array
    periods: int = eqx.field(static=True)
    cells: int = eqx.field(static=True)
    size: int = eqx.field(static=True)
    n: int = eqx.field(static=True)

    @eqx.filter_jit
    def period(self, system: System, dtype: np.dtype) -> Array:
        """The period of the orbit."""
        return jnp.asarray(system.period, dtype) * self.periods

    def galerkin(self, system: System, dtype: np.dtype) -> Galerkin:
        """The equations of a system."""
        return Galerkin(system, self.period(system, dtype), self.size, self.n, self.cells)

    @eqx.filter_jit
    def solve(self, system: System, guess: Array) -> tuple[Array, Array, tuple]:
        """Newton's iteration; the further data is its residual, outcome and length."""
        galerkin = self.galerkin(system, guess.dtype)

        def evaluate(z: Array) -> Evaluation:
            value, jacobian, is_resolved = galerkin.with_derivative(z)
            scale = jnp.max(abs(z.reshape(self.size, self.n)), axis=0)
            scale = jnp.tile(select(scale == 0, 1, scale), self.size)
            fine = jnp.all(jnp.isfinite(value))
            result = RESULTS.where(fine, RESULTS.successful, RESULTS.nonfinite)
            return Evaluation(value, jacobian, 2 * jnp.pi * scale, scale, result, is_resolved)

        root = newton(evaluate, guess, self.newton_steps)
        is_fine = galerkin.is_fine & (root.at.aux | (root.result != RESULTS.successful))
        result = RESULTS.where(is_fine, root.result, RESULTS.step_too_long)
        result = period_outcome(galerkin.period, result)
        return root.z, root.at.jacobian, (root.size, result, root.num_steps)

    @eqx.filter_jit
    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """By the integrals with moving zeros."""
        residual = lambda theta: self.galerkin(system_of(theta), z.dtype).residual(z)  # noqa: E731
        return jax.jacfwd(residual)(theta)

    @eqx.filter_jit
    def by_unknowns(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """Newton's matrix."""
        return self.galerkin(system_of(theta), z.dtype).with_derivative(z)[1]
