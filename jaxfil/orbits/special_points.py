"""What happens on a branch of orbits between two neighbours.

Two points of the branch enter; the points between them where a test function of the orbit is zero
(a fold, a period doubling, a Neimark–Sacker point) or its sequence of contacts changes leave.
"""

from collections.abc import Callable, Iterator

import numpy as np

from jaxfil.orbits.corrector import OrbitPoint
from jaxfil.orbits.curve import Curve, Special
from jaxfil.orbits.locating import change_on_curve, zero_on_curve


def _fold(point: OrbitPoint) -> float:
    # At a fold the curve runs at right angles to the parameter's axis.
    return float(point.tangent[-1])


def period_doubling(monodromy: np.ndarray) -> float:
    """Π (μ + 1): smooth, where a single multiplier would have to be told from the others."""
    return float(np.linalg.det(monodromy + np.eye(len(monodromy))))


def neimark_sacker(monodromy: np.ndarray) -> float:
    """The modulus of a complex pair of multipliers less one; NaN where there is no such pair."""
    values = np.linalg.eigvals(monodromy)
    pair = values[values.imag > 0]
    return float(np.max(abs(pair)) - 1) if pair.size else np.nan


_TESTS: dict[str, Callable[[OrbitPoint], float]] = {
    "fold": _fold,
    "period-doubling": lambda point: period_doubling(np.asarray(point.shot.monodromy)),
    "neimark-sacker": lambda point: neimark_sacker(np.asarray(point.shot.monodromy)),
}


def special_orbits(
    curve: Curve[OrbitPoint], a: OrbitPoint, b: OrbitPoint
) -> Iterator[Special[OrbitPoint]]:
    """Special points between two neighbours, in order."""
    # Test functions jump where the contacts change: they are looked at piece by piece.
    while a.sequence != b.sequence:
        contacts = a.sequence
        before, after = change_on_curve(curve, a, b, lambda p, c=contacts: p.sequence == c)
        yield from _zeros(curve, a, before)
        yield Special("contacts", after, before.sequence, after.sequence)
        if after is b:
            return
        a = after
    yield from _zeros(curve, a, b)


def _zeros(curve: Curve[OrbitPoint], a: OrbitPoint, b: OrbitPoint) -> Iterator[Special[OrbitPoint]]:
    """Zeros of the test functions between two points with the same contacts."""
    for kind, test in _TESTS.items():
        if test(a) * test(b) < 0:
            point = zero_on_curve(curve, a, b, test)
            if point is not None:
                yield Special(kind, point, point.sequence, point.sequence)
