"""Location of special points between two neighbours on a curve.

A special point is a zero of a test function, or a change of a property.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
import scipy  # its submodules are imported on first use

from jaxfil.orbits.curve import SHARP, Curve, CurvePoint, constraint_across

# Special points are located to this distance, in scaled unknowns.
_LOCATED = 1e-12
# Where branches cross, the equations are singular at the point itself, to rounding also near it.
# These distances to either side are tried in turn. Four points around it determine a cubic, by
# these weights at as many distances.
_ASIDE = (1e-10, 1e-4, 1e-3)
_WEIGHTS = {1: 2 / 3, -1: 2 / 3, 2: -1 / 6, -2: -1 / 6}
# A test function below this is zero, a determinant of numbers of order one, known to rounding; of
# one that is smaller at both of two neighbours, this part of that.
_ZERO = 1e-13
# A test function at its zero is below this fraction of its values at the neighbours.
_CROSSED = 1e-2

# A corner is searched along a tangent to this multiple of the distance of two points around it.
_PAST = 8.0
# A tangent at this cosine to a chord or more determines how the curve leaves it.
_ALONG = 0.5

_Point = TypeVar("_Point", bound=CurvePoint)


class _Lost(Exception):
    """There is no point, or the test function has no value."""


def zero_on_curve(
    curve: Curve[_Point], a: _Point, b: _Point, test: Callable[[_Point], float]
) -> _Point | None:
    """The zero of a test function between two points; None where its sign changes by a jump. If the
    curve is lost, the last point on it."""
    part, last = _zero(curve, a, b, test)
    if part is None:
        return last
    place = _place_at(curve, a, b, part)
    if place is None:
        return last
    # Moduli of pairs jump where a pair turns real.
    return None if _is_jump(a, b, place, test) else place.point


def count_on_curve(
    curve: Curve[_Point],
    a: _Point,
    b: _Point,
    heights: Callable[[_Point], np.ndarray],
    noise: float,
) -> _Point | None:
    """The point between two at which the number of positive heights changes, where the last one of
    these is zero; None if the number is the same. Heights up to the noise are not positive."""
    ranked = lambda point: np.sort(heights(point))[::-1]  # noqa: E731
    before, after = ranked(a), ranked(b)
    numbers = [int(np.sum(values > noise)) for values in (before, after)]
    last = max(numbers) - 1
    if numbers[0] == numbers[1] or min(before[last], after[last]) >= 0:
        return None
    return zero_on_curve(curve, a, b, lambda point: float(ranked(point)[last]))


def jumps_on_curve(
    curve: Curve[_Point], a: _Point, b: _Point, test: Callable[[_Point], float]
) -> bool:
    """Whether a test function changes its sign between two points without a zero, so that these are
    not on the same curve. If the curve is lost, as where two branches cross, this is unknown, and
    the answer is no."""
    part, _ = _zero(curve, a, b, test)
    place = None if part is None else _place_at(curve, a, b, part)
    return place is not None and _is_jump(a, b, place, test)


def _is_jump(
    a: _Point, b: _Point, place: "_Place[_Point]", test: Callable[[_Point], float]
) -> bool:
    """Whether a change of sign of a test function between a and b, located at a place, is no
    zero."""
    return abs(place.value(test)) > _CROSSED * min(abs(test(a)), abs(test(b)))


def _zero(
    curve: Curve[_Point], a: _Point, b: _Point, test: Callable[[_Point], float]
) -> tuple[float | None, _Point | None]:
    """The fraction of the distance between two points at which a test function changes its sign, by
    Alefeld, Potra and Shi's algorithm 748, or None if the curve is lost, and the last point on
    it."""
    last, ends = None, (test(a), test(b))
    zero = _ZERO * min(1.0, max(map(abs, ends)))

    def value(part: float) -> float:
        nonlocal last
        if part in (0.0, 1.0):
            return ends[int(part)]
        place = _place_at(curve, a, b, part)
        found = np.nan if place is None else place.value(test)
        if place is None or not np.isfinite(found):
            raise _Lost
        last = place.point
        return found if abs(found) > zero else 0.0

    try:
        part: Any = scipy.optimize.toms748(value, 0.0, 1.0, xtol=_LOCATED / _distance(a, b))
    except _Lost:
        return None, last
    return part, last


def change_on_curve(
    curve: Curve[_Point], a: _Point, b: _Point, same: Callable[[_Point], bool]
) -> tuple[_Point, _Point]:
    """Two points next to each other, the first with a property of a, the second without, by
    bisection, because a property has no value for interpolation."""
    low, high, before, after = 0.0, 1.0, a, b
    while (high - low) * _distance(a, b) > _LOCATED:
        middle = 0.5 * (low + high)
        point = _at_part(curve, a, b, middle)
        if point is not None and same(point):
            low, before = middle, point
        else:  # a lost point does not have the property of a
            high, after = middle, after if point is None else point
    return before, after


def is_corner(a: CurvePoint, b: CurvePoint) -> bool:
    """Whether the curve has a corner between two neighbours. Elsewhere no step turns as much."""
    tangent = b.tangent * b.scale / a.scale
    return bool(a.tangent @ tangent <= SHARP * np.linalg.norm(tangent))


def ends_between(curve: Curve[_Point], a: _Point, b: _Point) -> tuple[_Point, _Point]:
    """Two points next to each other where the smooth part of a ends. At a corner they are the last
    points of both parts, since across the chord it is not found where the curve turns back."""
    if not is_corner(a, b):
        return change_on_curve(curve, a, b, lambda point: curve.same(a, point))
    past = _PAST * _distance(a, b)
    return last_along(curve, a, past), last_along(curve, b, -past)


def last_along(curve: Curve[_Point], start: _Point, most: float) -> _Point:
    """The last point of a smooth part along the tangent, up to a distance, by bisection."""
    low, high, last = 0.0, most, start
    while abs(high - low) > _LOCATED:
        middle = 0.5 * (low + high)
        point = curve.along(start, middle)
        if point is not None and curve.same(point, start):
            low, last = middle, point
        else:
            high = middle
    return last


def away_from_corner(curve: Curve[_Point], a: _Point, b: _Point) -> _Point:
    """The point b behind a corner, with its tangent away from that, so that a step along it stays
    on the smooth part of b. Along the tangent before the corner it may turn back to it."""
    past = _PAST * _distance(a, b)
    ahead, back = (curve.along(b, ds) for ds in (past, -past))
    stays, returns = (point is not None and curve.same(point, b) for point in (ahead, back))
    return dataclasses.replace(b, tangent=-b.tangent) if returns and not stays else b


def _distance(a: CurvePoint, b: CurvePoint) -> float:
    return float(np.max(abs(b.u - a.u) / a.scale))


@dataclasses.dataclass(frozen=True)
class _Place(Generic[_Point]):
    """A place on a curve: one point there, or several around it, with their weights."""

    points: list[_Point]
    weights: list[float]

    def value(self, test: Callable[[_Point], float]) -> float:
        """A function of points there."""
        each = zip(self.weights, self.points, strict=True)
        return sum(weight * test(point) for weight, point in each)

    @property
    def point(self) -> _Point:
        """The unknowns there, with the other data of a point next to them."""
        if len(self.points) == 1:
            return self.points[0]
        u = np.tensordot(self.weights, [point.u for point in self.points], axes=1)
        return dataclasses.replace(self.points[0], u=u)


def _place_at(curve: Curve[_Point], a: _Point, b: _Point, part: float) -> _Place[_Point] | None:
    """The place at this fraction of the distance between two points, or a point next to it; None
    where the curve is lost."""
    point = _at_part(curve, a, b, part)
    if point is not None:
        return _Place([point], [1.0])
    single = None
    for aside in _ASIDE:
        points, away = list[_Point](), aside / _distance(a, b)
        for way in _WEIGHTS:
            point = _at_part(curve, a, b, part + way * away)
            if point is None:
                break
            points.append(point)
            single = single or _Place([point], [1.0])
        if len(points) == len(_WEIGHTS):
            return _Place(points, [*_WEIGHTS.values()])
    return single


def _at_part(curve: Curve[_Point], a: _Point, b: _Point, part: float) -> _Point | None:
    """The point at this fraction of the distance between two."""
    # Across the chord, so that a fold between them does not matter.
    chord = (b.u - a.u) / a.scale
    base = a.u + part * (b.u - a.u)
    constraint = constraint_across(base, a.scale, chord / np.linalg.norm(chord), 0.0)
    # Where the curve crosses another one, Newton's method converges only from nearby. The guess is
    # on the cubic with both tangents. How far it is from the chord changes by that.
    at_a = _slope(a.tangent, chord)
    at_b = _slope(b.tangent * b.scale / a.scale, chord)
    off = part * (1 - part) * ((1 - part) * at_a - part * at_b)
    return curve.correct(base + off * a.scale, constraint, a.tangent)


def _slope(tangent: np.ndarray, chord: np.ndarray) -> np.ndarray:
    """The rate at which a curve leaves a chord, per its length; zero for one far from parallel to
    it."""
    length = np.linalg.norm(chord)
    along = tangent @ chord / length
    if along < _ALONG * np.linalg.norm(tangent):
        return np.zeros_like(chord)
    return tangent * length / along - chord
