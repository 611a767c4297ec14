"""Special points on a branch of orbits between two neighbours.

They are zeros of test functions (a fold, a period doubling, a Neimark–Sacker point, a branch point)
and changes of the sequence of contacts.
"""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from jaxfil.orbits.chattering import differ_by_chattering, rests_in
from jaxfil.orbits.corrector import OrbitPoint
from jaxfil.orbits.curve import Curve, Special
from jaxfil.orbits.locating import count_on_curve, ends_between, is_corner, zero_on_curve


def _fold(point: OrbitPoint) -> float:
    # At a fold the curve runs at right angles to the parameter's axis.
    return float(point.tangent[-1])


def crossing(a: OrbitPoint, b: OrbitPoint) -> Callable[[OrbitPoint], float]:
    """The test function of points between two neighbours that is zero where branches cross: the
    determinant of the equations with the tangent appended."""
    # A row that itself vanishes at the crossing turns at once there, if it has length one at each
    # point. One of the neighbours has a length for it.
    lengths = [np.linalg.norm(point.rows, axis=1, keepdims=True) for point in (a, b)]
    length = np.maximum(*lengths)
    length = np.where(length == 0, 1, length)
    # With the tangent appended, the determinant does not vanish at a fold of the curve.
    return lambda point: float(np.linalg.det(np.vstack([point.rows / length, point.tangent])))


def period_doubling(monodromy: np.ndarray) -> float:
    """Π (μ + 1), which is smooth where a single multiplier cannot be identified."""
    return float(np.linalg.det(monodromy + np.eye(len(monodromy))))


def neimark_sacker(monodromy: np.ndarray) -> float:
    """Π (|μ| − 1) over the complex pairs of multipliers; NaN without a pair."""
    return pair_on_circle(np.linalg.eigvals(monodromy))


def pair_on_circle(values: np.ndarray) -> float:
    """The same, from multipliers."""
    # A product, so that a pair that crosses the circle shows beside others outside of it.
    pairs = values[np.imag(values) > 0]
    return float(np.prod(abs(pairs) - 1)) if pairs.size else np.nan


# A multiplier at this distance from the unit circle is on it.
_ON_CIRCLE = 1e-7

_TESTS: dict[str, Callable[[OrbitPoint], float]] = {
    "fold": _fold,
    "period-doubling": lambda point: period_doubling(np.asarray(point.shot.monodromy)),
    "neimark-sacker": lambda point: neimark_sacker(np.asarray(point.shot.monodromy)),
}


def kind_of_change(before: tuple, after: tuple) -> str:
    """The kind of a change of contacts: "rest" where the orbit begins or ceases to rest."""
    return "contacts" if rests_in(before) == rests_in(after) else "rest"


def special_orbits(
    curve: Curve[OrbitPoint], a: OrbitPoint, b: OrbitPoint, period: Callable[[OrbitPoint], float]
) -> Iterator[Special[OrbitPoint]]:
    """Special points between two neighbours, in order. Impacts that die out count as infinitely
    many."""
    # Test functions jump where the contacts change, so pieces between changes are searched.
    while a.sequence != b.sequence:
        before, after = ends_between(curve, a, b)
        yield from _zeros(curve, a, before)
        if not differ_by_chattering(before.shot.events, after.shot.events, period(after)):
            # The orbit with more contacts is known less exactly where these are impacts: their
            # depth is the square of their velocity, which rounding hides.
            fewer = is_corner(a, b) and len(before.sequence) < len(after.sequence)
            kind = kind_of_change(before.sequence, after.sequence)
            yield Special(kind, before if fewer else after, before.sequence, after.sequence)
        if after is b:
            return
        a = after
    yield from _zeros(curve, a, b)


def _zeros(curve: Curve[OrbitPoint], a: OrbitPoint, b: OrbitPoint) -> Iterator[Special[OrbitPoint]]:
    """Zeros of the test functions between two points with the same contacts."""
    found = set()
    for kind, test in {**_TESTS, "branch-point": crossing(a, b)}.items():
        at_a, at_b = test(a), test(b)
        # Pairs that stay on the circle, as of maps that preserve area, cross it by rounding alone.
        stays = kind == "neimark-sacker" and max(abs(at_a), abs(at_b)) < _ON_CIRCLE
        if at_a * at_b < 0 and not stays:
            point = zero_on_curve(curve, a, b, test)
            if point is not None:
                if kind == "branch-point":
                    point = dataclasses.replace(point, tangent=_tangent_between(a, b, point))
                found.add(kind)
                yield Special(kind, point, point.sequence, point.sequence)
    if not found & {"period-doubling", "neimark-sacker"}:
        yield from _crossed(curve, a, b)


def _crossed(
    curve: Curve[OrbitPoint], a: OrbitPoint, b: OrbitPoint
) -> Iterator[Special[OrbitPoint]]:
    """The point at which multipliers cross the circle without a zero of a test function: several at
    once, as of a symmetric orbit, or a pair that is real at one of two neighbours."""
    point = count_on_curve(curve, a, b, lambda p: abs(_multipliers(p)) - 1, _ON_CIRCLE)
    if point is None:
        return
    # The multiplier along the flow of an autonomous system is 1, the largest real part.
    values = _multipliers(point)
    distances = abs(abs(values) - 1)
    critical = min(values[distances <= np.min(distances) + _ON_CIRCLE], key=np.real)
    if abs(np.imag(critical)) > _ON_CIRCLE**0.5:
        yield Special("neimark-sacker", point, point.sequence, point.sequence)
    elif np.real(critical) < 0:
        yield Special("period-doubling", point, point.sequence, point.sequence)


def _multipliers(point: OrbitPoint) -> np.ndarray:
    return np.linalg.eigvals(np.asarray(point.shot.monodromy))


def _tangent_between(a: OrbitPoint, b: OrbitPoint, point: OrbitPoint) -> np.ndarray:
    """The tangent at a point between two neighbours, from theirs, because the equations have two
    null vectors where branches cross."""
    chord, way, end = ((v / point.scale) for v in (b.u - a.u, point.u - a.u, b.tangent * b.scale))
    part = (chord @ way) / (chord @ chord)
    start = a.tangent * a.scale / point.scale
    tangent = (1 - part) * start / np.linalg.norm(start) + part * end / np.linalg.norm(end)
    return tangent / np.linalg.norm(tangent)
