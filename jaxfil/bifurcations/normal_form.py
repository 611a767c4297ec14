"""The coefficient of the normal form of a fold or a period doubling of orbits, times ⟨w, v⟩.

Its zero is a cusp or a generalised period doubling. With v the critical vector, w the adjoint one,
each of length one, B and C second and third derivatives of the orbit's end, and J the derivative of
the closure:

    fold               a = ⟨w, B(v, v)⟩/2
    period doubling    c = ⟨w, C(v, v, v) − 3 B(v, J⁻¹ B(v, v))⟩/6

Without the division by ⟨w, v⟩ there is no pole where two multipliers coincide. B and C are central
differences of exact first derivatives. For an autonomous orbit state and period move together, on
the section of the phase condition.
Source: Yu. A. Kuznetsov, Elements of Applied Bifurcation Theory (2004), sections 5.4, 9.3 and 10.2.
"""

import dataclasses
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from jaxfil.bifurcations.critical_vectors import Slopes, null_vector

# Powers of eps for central differences, of a second derivative alone and of second and third ones.
_SECOND, _THIRD = 1 / 3, 1 / 4

FirstSlopes: TypeAlias = Callable[[np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Degeneracy:
    """A coefficient, and the adjoint vector that determines its sign."""

    value: float
    left: np.ndarray

    def value_beside(self, other: "Degeneracy") -> float:
        """The coefficient with the adjoint vector to the side of another one's."""
        return self.value if self.left @ other.left >= 0 else -self.value


def fold_degeneracy(
    first_slopes: FirstSlopes, s: np.ndarray, v: np.ndarray, slopes: Slopes
) -> Degeneracy:
    """The coefficient of a fold, for a critical vector of any length."""
    unit = slopes.unit[: slopes.size]
    v = v / np.linalg.norm(v / unit)
    left = null_vector(slopes.bordered.T, 1 / unit, 1 / slopes.rows)
    h = np.finfo(s.dtype).eps ** _SECOND
    plus, minus = (_along(first_slopes, s, sign * h * v) @ v for sign in (1, -1))
    n = len(slopes.first)
    # ⟨w, B(v, v)⟩/2, with B(v, v) a difference over 2h.
    return Degeneracy(float(left[:n] @ (plus - minus)) / (4 * h), left * slopes.rows)


def doubling_degeneracy(
    first_slopes: FirstSlopes, s: np.ndarray, v: np.ndarray, slopes: Slopes
) -> Degeneracy:
    """The coefficient of a period doubling."""
    n, k = len(slopes.first), slopes.size
    unit = slopes.unit[:n]
    v = v / np.linalg.norm(v / unit)
    left = null_vector((slopes.monodromy + np.eye(n)).T, 1 / unit, 1 / unit)
    # In the section of the phase, because the flow's direction is another eigenvector, of 1.
    if k > n:
        flow = slopes.first[:, n]
        shift = (slopes.normal[0] @ v) / (slopes.normal[0] @ flow)
        # M (v − shift f) = −(v − shift f) − 2 shift f, which the time compensates.
        v = np.append(v - shift * flow, 2 * shift)
    h = np.finfo(s.dtype).eps ** _THIRD
    here = slopes.first[:, :k] @ v
    plus, minus = (_along(first_slopes, s, sign * h * v) @ v for sign in (1, -1))
    second, third = (plus - minus) / (2 * h), (plus - 2 * here + minus) / h**2
    # J⁻¹ B(v, v), with the row of the phase condition.
    bent = np.linalg.solve(slopes.bordered, np.append(second, np.zeros(k - n)))
    plus, minus = (_along(first_slopes, s, sign * h * bent) @ v for sign in (1, -1))
    mixed = (plus - minus) / (2 * h)
    return Degeneracy(float(left @ (third - 3 * mixed)) / 6, left * unit)


def _along(first_slopes: FirstSlopes, s: np.ndarray, move: np.ndarray) -> np.ndarray:
    """The first derivatives by state and period, after a move of these."""
    moved = s.copy()
    moved[: move.size] += move
    return first_slopes(moved)[:, : move.size]
