"""Special points between two neighbours on a branch of orbits.

Two points of a `OrbitProblem` enter; the points between them where a test function of the orbit is zero
(a fold, a period doubling, a Neimark–Sacker point) or its sequence of contacts changes leave.
"""

from collections.abc import Callable, Iterator

import numpy as np

from jaxfil.orbits.corrector import OrbitProblem, Point, constraint_across, correct

# A special point is located to this part of the parameter's size.
_LOCATED = 1e-12


def _at_part(family: OrbitProblem, a: Point, b: Point, part: float) -> Point | None:
    """The point that lies this part of the way between two."""
    normal = (b.u - a.u) / a.scale
    length = np.linalg.norm(normal)
    base = a.u + part * (b.u - a.u)
    plane = constraint_across(base, a.scale, normal / length, 0.0)
    return correct(family, base, plane, a.tangent)


def _fold(point: Point) -> float:
    return float(point.tangent[-1])


def _period_doubling(point: Point) -> float:
    monodromy = np.asarray(point.shot.monodromy)
    return float(np.linalg.det(monodromy + np.eye(len(monodromy))))


def _neimark_sacker(point: Point) -> float:
    """The product of a complex pair of multipliers less one; NaN where there is no such pair."""
    values = np.linalg.eigvals(np.asarray(point.shot.monodromy))
    pair = values[values.imag > 0]
    return float(np.max(abs(pair)) - 1) if pair.size else np.nan


_TESTS: dict[str, Callable[[Point], float]] = {
    "fold": _fold,
    "period-doubling": _period_doubling,
    "neimark-sacker": _neimark_sacker,
}


def special_points(family: OrbitProblem, a: Point, b: Point) -> Iterator[tuple]:
    """Special points between two neighbours: kind, point, contacts before and after."""
    while a.sequence != b.sequence:
        before, after = _change(family, a, b)
        yield from _smooth(family, a, before)
        yield "contacts", after, before.sequence, after.sequence
        if after is b:
            return
        a = after
    yield from _smooth(family, a, b)


def _change(family: OrbitProblem, a: Point, b: Point) -> tuple[Point, Point]:
    """Two points next to each other, the first with the contacts of a, the second with others."""
    low, high, before, after = 0.0, 1.0, a, b
    while (high - low) * abs(b.value - a.value) > _LOCATED * abs(b.value) and high - low > 1e-13:
        middle = 0.5 * (low + high)
        point = _at_part(family, a, b, middle)
        if point is not None and point.sequence == a.sequence:
            low, before = middle, point
        else:
            high, after = middle, after if point is None else point
    return before, after


def _smooth(family: OrbitProblem, a: Point, b: Point) -> Iterator[tuple]:
    """Zeros of the test functions between two points with the same contacts."""
    for kind, test in _TESTS.items():
        if test(a) * test(b) < 0:
            point = _zero(family, a, b, test)
            if point is not None:
                yield kind, point, point.sequence, point.sequence


def _zero(family: OrbitProblem, a: Point, b: Point, test: Callable[[Point], float]) -> Point | None:
    """The zero of a test function by the Illinois variant of regula falsi."""
    low, high, at_low, at_high = 0.0, 1.0, test(a), test(b)
    best, last = None, 0
    for _ in range(60):
        part = (low * at_high - high * at_low) / (at_high - at_low)
        point = _at_part(family, a, b, part)
        if point is None:
            return best
        value, best = test(point), point
        if value * at_high < 0:
            low, at_low, at_high = part, value, at_high * (0.5 if last == -1 else 1.0)
            last = -1
        else:
            high, at_high, at_low = part, value, at_low * (0.5 if last == 1 else 1.0)
            last = 1
        if value == 0 or abs(high - low) * np.max(abs(b.u - a.u) / a.scale) < _LOCATED:
            break
        if abs(value) <= 1e-13:
            break
    return best
