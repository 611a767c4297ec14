"""`harmonic_balance`: a periodic orbit of a forced system as a Fourier series.

The equations are Galerkin's, ∫ (ẋ − F(t, x, sgn H)) ψ_k dt = 0 for the constant and every cosine
and sine up to harmonic K, alternating between the series and values in time.

sgn H has no useful derivative for Newton's method, and on a grid its jump is known only to a cell.
The zeros of H on the series are therefore located in every cell of the grid, and the integral is
taken from zero to zero with a Gauss rule. The residual is then a smooth function of the
coefficients. Its derivative has two parts, by autodiff at every point and every zero: ∂F/∂x under
the integral, and the jump of F at each zero times the rate at which the zero moves (Leibniz).
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
from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import cast
from jaxfil.model.system import System, field_of
from jaxfil.orbits.fourier import FourierOrbit, equal_phases, project, slope_of, waves_at
from jaxfil.orbits.newton import Evaluation, newton
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.regula_falsi import zero_between
from jaxfil.xla.known import array_of
from jaxfil.xla.select import select

# Cells of the grid per harmonic, and points of the Gauss rule in each part of a cell. They
# integrate a product of two highest harmonics, half a turn in a cell, to 1e-10.
_CELLS, _POINTS = 4, 6
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(_POINTS)


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

    - `system`: a forced `System` whose state does not jump, without `reset` and `tick`.
    - `guess`: an `Orbit`; a function of t, shape (n,); or coefficients as in `FourierOrbit`, of any
      number of harmonics.
    - `harmonics`: K, the number of the highest harmonic.
    - `periods`: forcing periods after which the orbit closes.
    - `newton_steps`: the largest number of evaluations of the residual.
    - `throw`: whether to raise an error unless the outcome is `successful`.

    **Returns** a `FourierOrbit`. For a batch use `equinox.filter_vmap` with `throw=False`.

    **Outcomes**: `successful`; `newton_stalled`, `newton_singular` or `newton_max_steps_reached`
    without an orbit; `nonfinite` if the equations are not finite at the guess; `invalid_period`.

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
    series = _solve(cast(system, first.dtype), first, periods, budget)
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


class _Balance(eqx.Module):
    """Galerkin's equations of a system for size = 2K + 1 coefficients of n components."""

    system: System
    period: Array
    size: int = eqx.field(static=True)
    n: int = eqx.field(static=True)

    def state(self, c: Array, phase: Array) -> Array:
        """x at a phase, shape (n,)."""
        return waves_at(phase, (self.size - 1) // 2) @ c

    def switching(self, phase: Array, x: Array) -> Array:
        """H, shape (m,)."""
        return jnp.atleast_1d(self.system.switching(phase * self.period, x))

    def force(self, phase: Array, x: Array, sides: Array) -> Array:
        """T F, shape (n,)."""
        h_shape = check.shapes(self.system, x)
        side = sides[0] if h_shape == () else sides
        return self.period * field_of(self.system, phase * self.period, x, side)


@eqx.filter_jit
def _solve(system: System, first: Array, periods: int, newton_steps: Array) -> FourierOrbit:
    size, n = first.shape
    period = jnp.asarray(system.period, first.dtype) * periods
    balance = _Balance(system, period, size, n)

    def evaluate(z: Array) -> Evaluation:
        value, jacobian = _equations(balance, z.reshape(size, n))
        scale = jnp.max(abs(z.reshape(size, n)), axis=0)
        scale = jnp.tile(select(scale == 0, 1, scale), size)
        fine = jnp.all(jnp.isfinite(value))
        result = RESULTS.where(fine, RESULTS.successful, RESULTS.nonfinite)
        return Evaluation(value, jacobian, 2 * jnp.pi * scale, scale, result, None)

    root = newton(evaluate, first.ravel(), newton_steps)
    result = period_outcome(period, root.result)
    return FourierOrbit(root.z.reshape(size, n), period, root.size, result, root.num_steps)


def _equations(balance: _Balance, c: Array) -> tuple[Array, Array]:
    """Coefficients of dx/dφ − T F, shape (size · n,), and their derivative."""
    size, n = balance.size, balance.n
    harmonics = (size - 1) // 2
    basis = jax.vmap(ft.partial(waves_at, harmonics=harmonics))
    # The coefficient of a wave is twice its mean with the function.
    norm = select(jnp.arange(size) == 0, 1.0, 2.0).astype(c.dtype)[:, None]
    slope = ft.partial(slope_of, harmonics=harmonics)

    # dx/dφ is a series itself and exact; only the force is integrated.
    phases, weights, sides, zeros = _quadrature(balance, c)
    at_points = basis(phases)
    states = at_points @ c
    force = jax.vmap(balance.force)(phases, states, sides)
    by_state = jax.vmap(jax.jacfwd(balance.force, argnums=1))(phases, states, sides)
    value = slope(c) - norm * (at_points.T @ (weights[:, None] * force))

    weighted = at_points * weights[:, None]
    integral = jnp.einsum("pk,pij,pl->kilj", weighted, by_state, at_points, optimize="optimal")
    if zeros is not None:
        where, jump, moves = zeros
        at_zeros = basis(where)
        integral += jnp.einsum(
            "pk,pi,pj,pl->kilj", at_zeros, jump, moves, at_zeros, optimize="optimal"
        )
    eye = jnp.eye(size * n, dtype=c.dtype).reshape(size * n, size, n)
    linear = jax.vmap(slope)(eye).reshape(size * n, size * n).T
    derivative = linear - (norm[:, :, None, None] * integral).reshape(size * n, size * n)
    return value.ravel(), derivative


def _quadrature(balance: _Balance, c: Array) -> tuple[Array, Array, Array, tuple | None]:
    """Phases (p,), weights (p,) and sides (p, m) of all points; and for every zero of H its phase,
    the jump of T F across it (n,), and the derivative of its phase with respect to x (n,)."""
    cells = _CELLS * ((balance.size - 1) // 2) + 8
    edges = jnp.arange(cells + 1).astype(c.dtype) / cells
    surfaces = lambda p: balance.switching(p, balance.state(c, p))  # noqa: E731
    at_edges = jax.vmap(surfaces)(edges)
    m = at_edges.shape[1]
    cell = ft.partial(_cell, surfaces, m)
    phases, weights, sides, roots, crosses = jax.vmap(cell)(
        edges[:-1], edges[1:], at_edges[:-1], at_edges[1:]
    )
    flat = (phases.ravel(), weights.ravel(), sides.reshape(phases.size, m))
    if m == 0:
        return *flat, None

    def move(phase: Array, j: Array, crosses: Array, h_before: Array) -> tuple[Array, Array]:
        x = balance.state(c, phase)
        # Leibniz: the zero moves by −∇H·δx/(dH/dφ), and the integral by that times the jump.
        rate = jax.jvp(surfaces, (phase,), (jnp.ones_like(phase),))[1][j]
        normal = jax.jacfwd(balance.switching, argnums=1)(phase, x)[j]
        side = select(balance.switching(phase, x) > 0, 1.0, -1.0).astype(c.dtype)
        before = select(h_before[j] > 0, 1.0, -1.0).astype(c.dtype)
        jump = balance.force(phase, x, side.at[j].set(before))
        jump -= balance.force(phase, x, side.at[j].set(-before))
        return select(crosses, jump, 0), -normal / select(rate == 0, 1, rate)

    numbers = jnp.broadcast_to(jnp.arange(m), roots.shape)
    before = jnp.repeat(at_edges[:-1, None], m, axis=1)
    jump, moves = jax.vmap(jax.vmap(move))(roots, numbers, crosses, before)
    return *flat, (roots.ravel(), jump.reshape(-1, balance.n), moves.reshape(-1, balance.n))


def _cell(
    surfaces: Callable, m: int, a: Array, b: Array, h_a: Array, h_b: Array
) -> tuple[Array, ...]:
    """Points, weights and sides of a cell cut at the zeros of H, and the zeros."""
    crosses = (h_a > 0) != (h_b > 0)
    zeros = [
        select(crosses[j], zero_between(lambda p, j=j: surfaces(p)[j], a, b, h_a[j], h_b[j]), b)
        for j in range(m)
    ]
    # A cut without a crossing is at the end of the cell, and the piece beyond it has no weight.
    cuts = jnp.sort(jnp.stack([a, *zeros, b]))
    middle, half = 0.5 * (cuts[:-1] + cuts[1:]), 0.5 * (cuts[1:] - cuts[:-1])
    sides = select(jax.vmap(surfaces)(middle) > 0, 1.0, -1.0).astype(a.dtype)
    points = middle[:, None] + half[:, None] * jnp.asarray(_NODES, a.dtype)
    weights = half[:, None] * jnp.asarray(_WEIGHTS, a.dtype)
    sides = jnp.repeat(sides[:, None], _POINTS, axis=1)
    roots = jnp.stack(zeros) if m else jnp.zeros((0,), a.dtype)
    return points, weights, sides, roots, crosses
