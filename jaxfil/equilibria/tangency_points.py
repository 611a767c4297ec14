"""`tangency_points`: the points at which fields of a planar system are tangent to its surfaces.

Visible and invisible tangencies and two-folds are the ends of sliding regions.
"""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.equilibria.balance import Balance
from jaxfil.equilibria.search import autonomous
from jaxfil.model import check
from jaxfil.model.card import precision
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.xla.select import select

Limits = tuple[tuple[float, float], tuple[float, float]]
"""A window: ((left, right), (bottom, top))."""

# Points along each edge of the window, Newton steps from cells in which there may be a tangency,
# and distances, as fractions of the window, below which two points are one.
_GRID, _STEPS, _ONE = 201, 12, 1e-6


class FieldTangency(eqx.Module):
    """A point of a surface to which a field is tangent."""

    x: Float[np.ndarray, "2"]
    """The state."""
    surface: int = eqx.field(static=True)
    """The number of the surface."""
    side: int = eqx.field(static=True)
    """The side whose field is tangent, 0 for a two-fold, where both fields are."""
    visible: tuple[int, ...] = eqx.field(static=True)
    """The sides on which it is visible, that is, the motion touches the surface and stays on its
    side. At an invisible tangency it would be on the other side."""

    @property
    def kind(self) -> str:
        """Either "visible" or "invisible"; for a two-fold "visible two-fold", "invisible two-fold"
        or "visible-invisible two-fold"."""
        word = "visible" if self.visible else "invisible"
        if self.side != 0:
            return word
        return f"{'visible-invisible' if len(self.visible) == 1 else word} two-fold"

    def __repr__(self) -> str:
        where = np.array2string(self.x, precision=10, separator=", ")
        side = "" if self.side == 0 else f" of side {self.side:+d}"
        word = self.kind if self.side == 0 else f"{self.kind} tangency"
        return f"{word}{side}, surface {self.surface}, x = {where}{precision(self.x)}"


def tangency_points(system: System, limits: Limits) -> list[FieldTangency]:
    r"""Find the tangency points of an autonomous planar system in a window.

    $$H_j(x) = 0, \qquad \dot H_j = \nabla H_j \cdot F_\pm(x) = 0$$

    A tangency on side s is visible where $s\, \ddot H_j > 0$ along $F_s$, and invisible where it is
    negative. A two-fold is one of both sides. Sliding regions end at tangencies.

    **Arguments**

    - `system`: the `System`, of two components, without a period and clocks; taken at t = 0.
    - `limits`: the window, ((left, right), (bottom, top)). It is searched on a grid of 200 cells
      along each edge, and tangencies of one kind in one cell may be missed.

    **Returns** a list of `FieldTangency`, by surface and from left to right.

    **Source**: A. F. Filippov, Differential Equations with Discontinuous Righthand Sides, Kluwer
    (1988), § 19; Yu. Kuznetsov, S. Rinaldi and A. Gragnani, One-parameter bifurcations in planar
    Filippov systems, Int. J. Bifurcation and Chaos 13 (2003), § 2.

    >>> import jax
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> jf.tangency_points(jf.systems.VisibleFold(), ((-2, 0), (-2, 0)))
    [visible tangency of side +1, surface 0, x = [-1., -1.]]
    """
    check.system("system", system)
    autonomous("system", system)
    window = window_of("limits", limits)
    x = jnp.asarray(window.mean(axis=1))
    shape = check.shapes(cast(system, x.dtype), x)
    fields = _Fields(cast(system, x.dtype), m=1 if shape == () else shape[0])
    found: list[FieldTangency] = []
    for j in range(fields.m):
        on_side = [_on_side(fields, window, j, side) for side in (1, -1)]
        found += _merged(on_side, j, window)
    return found


def window_of(name: str, limits: object) -> Float[np.ndarray, "2 2"]:
    """Two ascending pairs of finite numbers."""
    must = "((left, right), (bottom, top)), each pair ascending"
    window = check.known_numbers(name, limits, must).astype(float)
    if window.shape != (2, 2) or not np.isfinite(window).all() or np.any(np.diff(window) <= 0):
        raise ValueError(f"`{name}` must be {must}, got {check.told(limits)}.")
    return window


class _Fields(eqx.Module):
    """H of each surface and its rates along the field of either side, others on their own."""

    system: System
    m: int = eqx.field(static=True)

    def h(self, x: Array, j: Array) -> Array:
        """H_j."""
        return Balance(self.system, jnp.ones((self.m,), x.dtype), affine=False).h(x)[j]

    def force(self, x: Array, j: Array, side: Array) -> Array:
        """F with this side of surface j."""
        plain = Balance(self.system, jnp.ones((self.m,), x.dtype), affine=False)
        sides = select(plain.h(x) < 0, -plain.mode, plain.mode).at[j].set(side)
        return Balance(self.system, sides, affine=False).field(x, sides)

    def rate(self, x: Array, j: Array, side: Array) -> Array:
        """dH_j/dt."""
        along = self.force(x, j, side)
        return jax.jvp(lambda x: self.h(x, j), (x,), (along,))[1]

    def bend(self, x: Array, j: Array, side: Array) -> Array:
        """d²H_j/dt²."""
        along = self.force(x, j, side)
        return jax.jvp(lambda x: self.rate(x, j, side), (x,), (along,))[1]


@eqx.filter_jit
def _both(fields: _Fields, points: Array, j: Array, side: Array) -> Array:
    """H_j and its rate at points (k, 2)."""
    return jax.vmap(lambda x: jnp.stack([fields.h(x, j), fields.rate(x, j, side)]))(points)


@eqx.filter_jit
def _refined(fields: _Fields, points: Array, j: Array, side: Array) -> tuple[Array, Array]:
    """The zeros of both near points, and the bend there."""

    def both(x: Array) -> Array:
        return jnp.stack([fields.h(x, j), fields.rate(x, j, side)])

    def step(_: Array, x: Array) -> Array:
        return x - jnp.linalg.solve(jax.jacfwd(both)(x), both(x))

    zeros = jax.vmap(lambda x: jax.lax.fori_loop(0, _STEPS, step, x))(points)
    return zeros, jax.vmap(lambda x: fields.bend(x, j, side))(zeros)


def _on_side(fields: _Fields, window: np.ndarray, j: int, side: int) -> list[tuple]:
    """Tangencies of one side, each a state and whether it is visible."""
    axes = [np.linspace(low, high, _GRID) for low, high in window]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    at = jnp.asarray(j, jnp.int32), jnp.asarray(float(side))
    values = np.asarray(_both(fields, jnp.asarray(grid.reshape(-1, 2)), *at))
    values = values.reshape(_GRID, _GRID, 2)
    corners = [values[a : _GRID - 1 + a, b : _GRID - 1 + b] for a in (0, 1) for b in (0, 1)]
    least, most = ft.reduce(np.minimum, corners), ft.reduce(np.maximum, corners)
    cells = np.argwhere(np.all((least <= 0) & (most >= 0), axis=-1))
    if not cells.size:
        return []
    middles = grid[tuple(cells.T)] + 0.5 * (grid[1, 1] - grid[0, 0])
    # Padded to a power of two, so that few programs are compiled.
    rows = np.resize(middles, (1 << (len(middles) - 1).bit_length(), 2))
    zeros, bends = map(np.asarray, _refined(fields, jnp.asarray(rows), *at))
    size, found = np.ptp(window, axis=1), []
    for x, bend, middle in zip(zeros, bends, rows, strict=True):
        # A zero two cells away belongs to another cell, or to no cell.
        near = np.all(abs(x - middle) <= 2 * size / (_GRID - 1))
        inside = np.all((window[:, 0] <= x) & (x <= window[:, 1]))
        known = any(np.all(abs(x - other) <= _ONE * size) for other, _ in found)
        if near and inside and np.isfinite(bend) and not known:
            found.append((x, bool(side * bend > 0)))
    return found


def _merged(on_side: list[list[tuple]], j: int, window: np.ndarray) -> list[FieldTangency]:
    """The tangencies of both sides of a surface, with two at one point as a two-fold."""
    size, (above, below) = np.ptp(window, axis=1), on_side
    found, paired = [], set()
    for x, visible in above:
        own = (1,) * visible
        twin = [i for i, v in enumerate(below) if np.all(abs(x - v[0]) <= _ONE * size)]
        if twin:
            paired.add(twin[0])
            own += (-1,) * below[twin[0]][1]
        found.append(FieldTangency(x, j, 0 if twin else 1, own))
    lone = [v for i, v in enumerate(below) if i not in paired]
    found += [FieldTangency(x, j, -1, (-1,) * visible) for x, visible in lone]
    return sorted(found, key=lambda v: tuple(v.x))
