"""Multipliers on the unit circle, between two neighbours on a curve of orbits.

Their test functions miss several multipliers that cross the circle at once, and see crossings in
the rounding of pairs that stay on it.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TypeVar

import numpy as np

from jaxfil.orbits.curve import Curve, CurvePoint
from jaxfil.orbits.locating import count_on_curve, zero_on_curve

# A multiplier at this distance from the unit circle is on it.
_ON_CIRCLE = 1e-7

DOUBLING, PAIR = "period-doubling", "neimark-sacker"

_Point = TypeVar("_Point", bound=CurvePoint)


def period_doubling(monodromy: np.ndarray) -> float:
    """Π (μ + 1), which is smooth where a single multiplier cannot be identified."""
    return float(np.linalg.det(monodromy + np.eye(len(monodromy))))


def pair_on_circle(values: np.ndarray) -> float:
    """Π (|μ| − 1) over the complex pairs of multipliers; NaN without a pair."""
    # A product, so that a pair that crosses the circle shows beside others outside of it.
    pairs = values[np.imag(values) > 0]
    return float(np.prod(abs(pairs) - 1)) if pairs.size else np.nan


def zeros_between(
    curve: Curve[_Point],
    a: _Point,
    b: _Point,
    tests: Mapping[str, Callable[[_Point], float]],
    multipliers: Callable[[_Point], np.ndarray],
) -> Iterator[tuple[str, _Point]]:
    """The kinds and the points of zeros of test functions between two neighbours with the same
    contacts, and of multipliers that cross the unit circle without one."""
    tests, found = {**tests, PAIR: lambda point: pair_on_circle(multipliers(point))}, set()
    for name, test in tests.items():
        at_a, at_b = test(a), test(b)
        # Pairs that stay on the circle, as of maps that preserve area, cross it by rounding alone.
        stays = name == PAIR and max(abs(at_a), abs(at_b)) < _ON_CIRCLE
        point = zero_on_curve(curve, a, b, test) if at_a * at_b < 0 and not stays else None
        # The search ends elsewhere at a pole of a coefficient, or where a pair becomes real.
        if point is None or not abs(test(point)) <= min(abs(at_a), abs(at_b)):
            continue
        # Two equal real multipliers are a pair by rounding.
        kind = kind_on_circle(multipliers(point)) if name == PAIR else name
        if kind is not None and kind not in found:
            found.add(kind)
            yield kind, point
    if found & {DOUBLING, PAIR}:
        return
    # Several at once, as of a symmetric orbit, or a pair that is real at one of two neighbours.
    point = count_on_curve(curve, a, b, lambda p: abs(multipliers(p)) - 1, _ON_CIRCLE)
    kind = None if point is None else kind_on_circle(multipliers(point))
    if point is not None and kind is not None:
        yield kind, point


def late_crossings(
    heights: np.ndarray, alike: np.ndarray, known: Collection[int]
) -> Iterator[tuple[int, int]]:
    """Where multipliers cross the unit circle in several steps, with points between that are as
    near to it as rounding. Given are |μ| − 1 of all points of a curve, (k, n), in falling order;
    whether each step, (k − 1,), leads to the same contacts in the same unknowns; and the numbers of
    points before which a crossing is known. The numbers of the first point of the step with the
    change of sign, and of the multiplier."""
    sides = np.sign(heights) * (abs(heights) > _ON_CIRCLE)
    known = set(known)
    for rank in range(heights.shape[1]):
        far = np.flatnonzero(sides[:, rank])
        for a, b in zip(far[:-1].tolist(), far[1:].tolist(), strict=True):
            between = set(range(a + 1, b + 1))
            opposite = sides[a, rank] != sides[b, rank]
            if b == a + 1 or not opposite or not np.all(alike[a:b]) or known & between:
                continue
            behind = np.sign(heights[a:b, rank]) == sides[a, rank]
            last = a + int(np.flatnonzero(behind)[-1])
            known.add(last + 1)
            yield last, rank


def kind_on_circle(values: np.ndarray) -> str | None:
    """The kind of a point where one of the multipliers is on the circle; None where it is 1."""
    # The multiplier along the flow of an autonomous system is 1, the largest real part.
    distances = abs(abs(values) - 1)
    critical = min(values[distances <= np.min(distances) + _ON_CIRCLE], key=np.real)
    if abs(np.imag(critical)) > _ON_CIRCLE**0.5:
        return PAIR
    return DOUBLING if np.real(critical) < 0 else None
