"""`Galerkin`: the equations of a Fourier series that balances a system, and their derivative.

sgn H has no useful derivative for Newton's method, and on a grid its jump is known only to a cell.
The zeros of H on the series are therefore located in every cell of the grid, and the integral is
taken from zero to zero, and from tick to tick of clocks, with a Gauss rule. The residual is then a
smooth function of the coefficients. Its derivative has two parts, by autodiff at every point and
every zero: ∂F/∂x under the integral, and the jump of F at each zero times the rate at which it
moves (Leibniz).
"""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from jaxfil.model import check
from jaxfil.model.system import System, field_of
from jaxfil.orbits.fourier import slope_of, waves_at
from jaxfil.orbits.regula_falsi import zero_between
from jaxfil.xla.select import select

# Cells of the grid per harmonic, and points of the Gauss rule in each part of a cell. They
# integrate a product of two highest harmonics, half a turn in a cell, to 1e-10.
CELLS, _POINTS = 4, 6
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(_POINTS)
# Beside ticks, where functions jump, cells are evaluated within their ends by this multiple of eps.
_INSIDE = 8.0
# The end of a cell that is nearer to a tick than this part of the cell becomes the tick.
_NEAR = 1e-2


class _Zeros(NamedTuple):
    """For two brackets of every cell and surface: the zero of H, whether there is one, and H
    before."""

    phases: Float[Array, "*many"]
    crosses: Bool[Array, "*many"]
    before: Float[Array, "*many"]


class Galerkin(eqx.Module):
    """Galerkin's equations of a system for size = 2K + 1 coefficients of n components, with phases
    φ = t/T."""

    system: System
    period: Array
    size: int = eqx.field(static=True)
    n: int = eqx.field(static=True)
    cells: int = eqx.field(static=True)

    @property
    def is_fine(self) -> Array:
        """Whether each clock ticks at most once in a cell."""
        eps = jnp.finfo(self.period.dtype).eps
        lengths = [clock.period * self.cells / self.period for clock in self.system.clocks]
        return jnp.all(jnp.stack([*lengths, jnp.ones_like(self.period)]) >= 1 - _INSIDE * eps)

    def residual(self, z: Array) -> Array:
        """Coefficients of dx/dφ − T F, shape (size · n,), with all derivatives."""
        c = z.reshape(self.size, self.n)
        phases, weights, sides, _ = self._quadrature(c)
        at_points = self._basis(phases)
        force = jax.vmap(self._force)(phases, at_points @ c, sides)
        # dx/dφ is a series itself and exact; only the force is integrated.
        return (self._slope(c) - self._norm(c) * (at_points.T @ (weights[:, None] * force))).ravel()

    def with_derivative(self, z: Array) -> tuple[Array, Array, Array]:
        """The residual, its derivative by z, and whether the grid resolves all crossings."""
        c, size, n = z.reshape(self.size, self.n), self.size, self.n
        phases, weights, sides, zeros = self._quadrature(c)
        at_points = self._basis(phases)
        states = at_points @ c
        force = jax.vmap(self._force)(phases, states, sides)
        by_state = jax.vmap(jax.jacfwd(self._force, argnums=1))(phases, states, sides)
        norm = self._norm(c)
        value = self._slope(c) - norm * (at_points.T @ (weights[:, None] * force))

        weighted = at_points * weights[:, None]
        integral = jnp.einsum("pk,pij,pl->kilj", weighted, by_state, at_points, optimize="optimal")
        if zeros.phases.size:
            numbers = jnp.broadcast_to(
                jnp.arange(zeros.phases.shape[1])[None, :, None], zeros.phases.shape
            )
            flat = (v.ravel() for v in (numbers, *zeros))
            jump, moves = jax.vmap(ft.partial(self._move, c))(*flat)
            at_zeros = self._basis(zeros.phases.ravel())
            integral += jnp.einsum(
                "pk,pi,pj,pl->kilj", at_zeros, jump, moves, at_zeros, optimize="optimal"
            )
        eye = jnp.eye(size * n, dtype=c.dtype).reshape(size * n, size, n)
        linear = jax.vmap(self._slope)(eye).reshape(size * n, size * n).T
        derivative = linear - (norm[:, :, None, None] * integral).reshape(size * n, size * n)
        return value.ravel(), derivative, self._is_resolved(phases, states, sides)

    def _is_resolved(self, phases: Array, states: Array, sides: Array) -> Array:
        """Whether H has the sign of its piece at all points, except beside a zero."""
        h = jax.vmap(self._switching)(phases, states)
        beside = jnp.finfo(h.dtype).eps ** 0.5 * jnp.max(abs(h), axis=0)
        return jnp.all(h * sides >= -beside)

    def _basis(self, phases: Array) -> Array:
        return jax.vmap(ft.partial(waves_at, harmonics=(self.size - 1) // 2))(phases)

    def _slope(self, c: Array) -> Array:
        return slope_of(c, (self.size - 1) // 2)

    def _norm(self, c: Array) -> Array:
        # The coefficient of a wave is twice its mean with the function.
        return select(jnp.arange(self.size) == 0, 1.0, 2.0).astype(c.dtype)[:, None]

    def _state(self, c: Array, phase: Array) -> Array:
        """x at a phase, shape (n,)."""
        return waves_at(phase, (self.size - 1) // 2) @ c

    def _switching(self, phase: Array, x: Array) -> Array:
        """H, shape (m,)."""
        return jnp.atleast_1d(self.system.switching(phase * self.period, x))

    def _force(self, phase: Array, x: Array, sides: Array) -> Array:
        """T F, shape (n,)."""
        h_shape = check.shapes(self.system, x)
        side = sides[0] if h_shape == () else sides
        return self.period * field_of(self.system, phase * self.period, x, side)

    def _edges(self, dtype: np.dtype) -> tuple[Array, Array]:
        """The ends of all cells and the ticks of clocks, in order; and for each the distance at
        which functions are evaluated beside it."""
        inside = _INSIDE * jnp.finfo(dtype).eps
        number = jnp.arange(self.cells).astype(dtype)
        edges, moved, others = number / self.cells, jnp.zeros(self.cells, bool), []
        for clock in self.system.clocks:
            # The ticks of a period, from 0 to 1, and the end of a cell that each is nearest to.
            first, step = clock.phase / self.period, clock.period / self.period
            ticks = first + (number - jnp.floor(stop_gradient(first / step))) * step
            ticks -= jnp.floor(stop_gradient(ticks))
            exist = number < jnp.round(stop_gradient(1 / step))
            nearest = jnp.round(stop_gradient(ticks) * self.cells)
            away, nearest = ticks - nearest / self.cells, nearest.astype(jnp.int32) % self.cells
            # This end becomes the tick. In a cell between both, of no length, the jump of a
            # function at the tick would be lost, which is its derivative as the tick moves.
            meet = exist & (abs(away) * self.cells < _NEAR) & ~moved[nearest]
            place = select(meet, nearest, self.cells)  # no place beyond the last one
            edges = edges.at[place].add(away, mode="drop")
            moved = moved.at[place].set(True, mode="drop")
            others.append((ticks, exist & ~meet))
        start = edges[0]
        several = [edges, start[None] + 1]
        for ticks, exist in others:
            ticks -= jnp.floor(stop_gradient(ticks - start))
            several.append(select(exist, ticks, start))
        edges = jnp.sort(jnp.concatenate(several))
        ticks = jnp.zeros(edges.shape, bool)
        for clock in self.system.clocks:
            part = (edges * self.period - clock.phase) / clock.period
            ticks |= abs(part - jnp.round(part)) * clock.period < inside * self.period
        return edges, stop_gradient(select(ticks, inside, 0).astype(dtype))

    def _quadrature(self, c: Array) -> tuple[Array, Array, Array, _Zeros]:
        """Phases (p,), weights (p,) and sides (p, m) of all points, and the zeros of H."""
        edges, beside = self._edges(c.dtype)
        surfaces = lambda p: self._switching(p, self._state(c, p))  # noqa: E731
        low, high = (stop_gradient(v) for v in (edges[:-1] + beside[:-1], edges[1:] - beside[1:]))
        at_ends = _values_at_ends(surfaces, low, high)
        cell = ft.partial(_cell, surfaces)
        phases, weights, sides, zeros = jax.vmap(cell)(edges[:-1], edges[1:], low, high, *at_ends)
        sides = sides.reshape(phases.size, sides.shape[-1])
        return phases.ravel(), weights.ravel(), sides, zeros

    def _move(
        self, c: Array, j: Array, phase: Array, crosses: Array, before: Array
    ) -> tuple[Array, Array]:
        """The jump of T F across a zero of H_j, and the derivative of its phase with respect to x,
        each of shape (n,)."""
        x = self._state(c, phase)
        surfaces = lambda p: self._switching(p, self._state(c, p))  # noqa: E731
        # Leibniz: the zero moves by −∇H·δx/(dH/dφ), and the integral by that times the jump.
        rate = jax.jvp(surfaces, (phase,), (jnp.ones_like(phase),))[1][j]
        normal = jax.jacfwd(self._switching, argnums=1)(phase, x)[j]
        side = select(self._switching(phase, x) > 0, 1.0, -1.0).astype(c.dtype)
        before = select(before > 0, 1.0, -1.0).astype(c.dtype)
        jump = self._force(phase, x, side.at[j].set(before))
        jump -= self._force(phase, x, side.at[j].set(-before))
        return select(crosses, jump, 0), -normal / select(rate == 0, 1, rate)


def _values_at_ends(
    surfaces: Callable[[Array], Array], low: Array, high: Array
) -> tuple[Array, Array]:
    """H at the beginnings and at the ends of all cells, shape (cells, m), the same at an end as
    where the next cell begins, the last one before the first, unless H jumps there.

    By rounding, each of two cells could else see the sign of the other one at a zero between
    them, and neither a crossing.
    """
    after, before = jax.vmap(surfaces)(low), jax.vmap(surfaces)(high)
    following = jnp.roll(after, -1, axis=0)
    rounding = jnp.finfo(low.dtype).eps ** 0.5 * jnp.max(abs(after), axis=0)
    return after, select(abs(following - before) <= rounding, following, before)


def _cell(
    surfaces: Callable[[Array], Array],
    a: Array,
    b: Array,
    low: Array,
    high: Array,
    at_low: Array,
    at_high: Array,
) -> tuple[Array, Array, Array, _Zeros]:
    """Points, weights and sides of a cell from a to b cut at the zeros of H, and the zeros, which
    are searched from `low` to `high`, given H there."""
    m = at_low.shape[0]
    zeros = [
        _zeros(lambda p, j=j: surfaces(p)[j], low, high, at_low[j], at_high[j]) for j in range(m)
    ]
    # Without a crossing there is no cut, and a piece beyond the end of the cell has no weight.
    phases = [select(one.crosses, one.phases, b) for one in zeros]
    cuts = jnp.sort(jnp.concatenate([a[None], *phases, b[None]]))
    middle, half = 0.5 * (cuts[:-1] + cuts[1:]), 0.5 * (cuts[1:] - cuts[:-1])
    sides = select(jax.vmap(surfaces)(middle) > 0, 1.0, -1.0).astype(a.dtype)
    points = middle[:, None] + half[:, None] * jnp.asarray(_NODES, a.dtype)
    weights = half[:, None] * jnp.asarray(_WEIGHTS, a.dtype)
    sides = jnp.repeat(sides[:, None], _POINTS, axis=1)
    none = jnp.zeros((0, 2), a.dtype)
    both = jax.tree.map(lambda *v: jnp.stack(v), *zeros) if m else _Zeros(none, none > 0, none)
    return points, weights, sides, both


def _zeros(h: Callable[[Array], Array], a: Array, b: Array, h_a: Array, h_b: Array) -> _Zeros:
    """The zeros of one H in a cell, given H at its ends: one where its sign changes, or a pair
    where it turns on the other side."""

    def rate(p: Array) -> Array:
        return jax.jvp(h, (p,), (jnp.ones_like(p),))[1]

    rate_a, rate_b = rate(a), rate(b)
    turns = (rate_a > 0) != (rate_b > 0)
    turn = select(turns, zero_between(rate, a, b, rate_a, rate_b), b)
    h_turn = select(turns, h(turn), h_b)
    ends, values = jnp.stack([a, turn, b]), jnp.stack([h_a, h_turn, h_b])
    # A cell between two ticks at one time has no length.
    crosses = ((values[:-1] > 0) != (values[1:] > 0)) & (b > a)
    found = jax.vmap(ft.partial(zero_between, h))(ends[:-1], ends[1:], values[:-1], values[1:])
    return _Zeros(jax.vmap(ft.partial(_moving, h))(found), crosses, values[:-1])


def _moving(h: Callable[[Array], Array], zero: Array) -> Array:
    """A zero with its first two derivatives by all that h depends on, which two steps of Newton's
    method from there have."""
    there = fixed = stop_gradient(zero)
    for _ in range(2):
        value, rate = jax.jvp(h, (there,), (jnp.ones_like(there),))
        there = there - value / select(rate == 0, 1, rate)
    return fixed + (there - stop_gradient(there))
