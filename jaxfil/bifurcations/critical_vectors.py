"""The critical vectors of an orbit, and their equations.

The residual of the equations has derivatives by the orbit and by the vectors y. With M the
monodromy matrix, J the derivative of the closure by state and period (with the row of the phase
condition, for an autonomous system), and G_p its derivative by a parameter:
    fold               J v = 0
    period doubling    M v = −v
    Neimark–Sacker     M v = w,  M w = 2κ w − v
    branch point       Jᵀ w = 0,  G_pᵀ w = 0,  and the orbit closes up to β b

κ = cos θ where the multipliers are e^{±iθ}. The pair v, w spans their plane, also where they
coincide at ±1. The unknown β is zero at a branch point, and b is w at a neighbour. On a curve a
symmetry, or an invariant plane, keeps β at zero; else the curve ends (`CriticalCurve.refusal`).
Source: Yu. A. Kuznetsov, Elements of Applied Bifurcation Theory (2004), section 10.3.
"""

import abc
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class Slopes(NamedTuple):
    """Derivatives of the end P of an orbit by s = (state, period of an autonomous system, both
    parameters). Second ones lack the last column, by the second parameter."""

    first: Float[np.ndarray, "n s"]
    second: Float[np.ndarray, "n s_1 s"]
    normal: Float[np.ndarray, "own n"]
    """The row of the phase condition of an autonomous system."""
    unit: Float[np.ndarray, " s"]
    """The scale of each."""
    still: Bool[np.ndarray, " n"]
    """Components of the state that close for every value, and have the neighbour's."""

    @property
    def monodromy(self) -> np.ndarray:
        """The monodromy matrix M."""
        return self.first[:, : len(self.first)]

    @property
    def closing(self) -> np.ndarray:
        """The derivative of P − x by s, where `still` components are constant."""
        unit = np.eye(*self.first.shape)
        still = self.still[:, None] | np.append(self.still, np.zeros(len(unit.T) - len(unit), bool))
        return np.where(still, unit, self.first - unit)

    @property
    def size(self) -> int:
        """The number of unknowns of the closure, state and period."""
        return len(self.first) + len(self.normal)

    @property
    def bordered(self) -> np.ndarray:
        """J: the derivative of closing and phase condition by state and period."""
        own = len(self.normal)
        below = np.hstack([self.normal, np.zeros((own, own))])
        return np.vstack([self.closing[:, : self.size], below])

    @property
    def rows(self) -> np.ndarray:
        """Scales of the rows of J."""
        n = len(self.first)
        return np.append(self.unit[:n], abs(self.normal) @ self.unit[:n])

    def along(self, v: np.ndarray) -> np.ndarray:
        """The derivative by s of the derivative of P along v, in the first unknowns."""
        return np.einsum("ijs,j->is", self.second[:, : v.size], v)


class Block(NamedTuple):
    """The equations of the vectors, with residual, derivatives and scales."""

    residual: np.ndarray
    by_orbit: np.ndarray
    by_vectors: np.ndarray
    scale: np.ndarray


class Vectors(abc.ABC):
    """The vectors of one kind."""

    @abc.abstractmethod
    def dimension(self, count: int, own: int) -> int:
        """The dimension of the state, if state and vectors have `count` numbers together."""

    @abc.abstractmethod
    def scale(self, slopes: Slopes) -> np.ndarray:
        """Scales of the vectors."""

    @abc.abstractmethod
    def start(self, slopes: Slopes) -> np.ndarray:
        """A guess."""

    @abc.abstractmethod
    def equations(self, slopes: Slopes, y: np.ndarray, base: np.ndarray) -> Block:
        """The equations, with normalised lengths relative to `base`, vectors nearby."""

    def unfolding(self, slopes: Slopes, base: np.ndarray) -> np.ndarray:
        """The matrix added to the closure, times the vectors."""
        return np.zeros((len(slopes.first), base.size))


class _Fold(Vectors):
    """J v = 0."""

    def dimension(self, count: int, own: int) -> int:
        return (count - own) // 2

    def scale(self, slopes: Slopes) -> np.ndarray:
        return slopes.unit[: slopes.size]

    def start(self, slopes: Slopes) -> np.ndarray:
        return null_vector(slopes.bordered, slopes.rows, self.scale(slopes))

    def equations(self, slopes: Slopes, y: np.ndarray, base: np.ndarray) -> Block:
        matrix, unit = slopes.bordered, self.scale(slopes)
        along = slopes.along(y)
        still = np.zeros((len(slopes.normal), along.shape[1]))
        return _measured(
            Block(matrix @ y, np.vstack([along, still]), matrix, slopes.rows),
            _length(base, unit) @ y - 1,
            _length(base, unit),
        )


class _Doubling(Vectors):
    """M v + v = 0."""

    def dimension(self, count: int, own: int) -> int:
        return count // 2

    def scale(self, slopes: Slopes) -> np.ndarray:
        return slopes.unit[: len(slopes.first)]

    def start(self, slopes: Slopes) -> np.ndarray:
        unit = self.scale(slopes)
        return null_vector(slopes.monodromy + np.eye(unit.size), unit, unit)

    def equations(self, slopes: Slopes, y: np.ndarray, base: np.ndarray) -> Block:
        unit = self.scale(slopes)
        matrix = slopes.monodromy + np.eye(unit.size)
        return _measured(
            Block(matrix @ y, slopes.along(y), matrix, unit),
            _length(base, unit) @ y - 1,
            _length(base, unit),
        )


class _Pair(Vectors):
    """M v − w = 0, M w − 2κ w + v = 0."""

    def dimension(self, count: int, own: int) -> int:
        return (count - 1) // 3

    def scale(self, slopes: Slopes) -> np.ndarray:
        unit = slopes.unit[: len(slopes.first)]
        return np.concatenate([unit, unit, [1.0]])

    def start(self, slopes: Slopes) -> np.ndarray:
        values, vectors = np.linalg.eig(slopes.monodromy)
        k = np.argmin(np.where(np.imag(values) > 0, abs(abs(values) - 1), np.inf))
        v = np.real(vectors[:, k]) / np.max(abs(vectors[:, k] / self.scale(slopes)[: len(values)]))
        return np.concatenate([v, slopes.monodromy @ v, [np.cos(np.angle(values[k]))]])

    def equations(self, slopes: Slopes, y: np.ndarray, base: np.ndarray) -> Block:
        n, matrix = len(slopes.first), slopes.monodromy
        v, w, kappa = y[:n], y[n : 2 * n], y[-1]
        one, none, column = np.eye(n), np.zeros((n, n)), np.zeros((n, 1))
        by_vectors = np.block(
            [[matrix, -one, column], [one, matrix - 2 * kappa * one, -2 * w[:, None]]]
        )
        # In the plane of v and w, v equals the base except for the part outside of the plane.
        unit = slopes.unit[:n]
        dual = np.linalg.pinv(np.stack([base[:n], base[n : 2 * n]], axis=1) / unit[:, None]) / unit
        return _measured(
            Block(
                np.append(matrix @ v - w, matrix @ w - 2 * kappa * w + v),
                np.vstack([slopes.along(v), slopes.along(w)]),
                by_vectors,
                np.tile(unit, 2),
            ),
            dual @ v - np.array([1.0, 0.0]),
            np.hstack([dual, none[:2], column[:2]]),
        )


class _Branching(Vectors):
    """Jᵀ w = 0, G_pᵀ w = 0; the last unknown is β."""

    def dimension(self, count: int, own: int) -> int:
        return (count - own - 1) // 2

    def scale(self, slopes: Slopes) -> np.ndarray:
        return np.append(1 / slopes.rows, 1.0)

    def start(self, slopes: Slopes) -> np.ndarray:
        columns = slopes.unit[: slopes.size]
        w = null_vector(slopes.bordered.T, 1 / columns, 1 / slopes.rows)
        return np.append(w, 0.0)

    def equations(self, slopes: Slopes, y: np.ndarray, base: np.ndarray) -> Block:
        n, k = len(slopes.first), slopes.size
        # By state, period and the first parameter, one row for each.
        below = np.hstack([slopes.normal, np.zeros((len(slopes.normal), k + 1 - n))])
        matrix = np.vstack([slopes.closing[:, : k + 1], below]).T
        w = y[:-1]
        turned = np.einsum("ijs,i->js", slopes.second, w[:n])
        length = np.append(_length(base[:-1], 1 / slopes.rows), 0.0)
        return _measured(
            Block(
                matrix @ w,
                turned,
                np.hstack([matrix, np.zeros((k + 1, 1))]),
                1 / slopes.unit[: k + 1],
            ),
            length @ y - 1,
            length,
        )

    def unfolding(self, slopes: Slopes, base: np.ndarray) -> np.ndarray:
        n = len(slopes.first)
        towards = np.zeros((n, base.size))
        towards[:, -1] = slopes.unit[:n] ** 2 * base[:n]
        return towards


VECTORS: dict[str, Vectors] = {
    "fold": _Fold(),
    "period-doubling": _Doubling(),
    "neimark-sacker": _Pair(),
    "branch-point": _Branching(),
}
"""The vectors of each kind of smooth bifurcation."""


def null_vector(matrix: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The right singular vector of the least singular value, in units, with length one."""
    return np.linalg.svd(matrix / rows[:, None] * columns)[2][-1] * columns


def _length(base: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """A row that is one times the vector `base`, and zero times orthogonal vectors."""
    scaled = base / unit
    return scaled / unit / (scaled @ scaled)


def _measured(block: Block, gap: np.ndarray | np.floating, rows: np.ndarray) -> Block:
    """The same with equations of the lengths, of size one, which do not depend on the orbit."""
    gap, rows = np.atleast_1d(gap), np.atleast_2d(rows)
    still = np.zeros((gap.size, block.by_orbit.shape[1]))
    return Block(
        np.append(block.residual, gap),
        np.vstack([block.by_orbit, still]),
        np.vstack([block.by_vectors, rows]),
        np.append(block.scale, np.ones(gap.size)),
    )
