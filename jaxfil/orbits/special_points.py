"""Special points on a branch of orbits between two neighbours.

They are zeros of test functions (a fold, a period doubling, a Neimark–Sacker point, a branch point)
and changes of the sequence of contacts.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from jaxfil.orbits.chattering import differ_by_chattering, rests_in
from jaxfil.orbits.corrector import OrbitPoint
from jaxfil.orbits.curve import Curve, Special
from jaxfil.orbits.locating import ends_between, is_corner, zero_on_curve
from jaxfil.orbits.unit_circle import (
    DOUBLING,
    PAIR,
    kind_on_circle,
    late_crossings,
    period_doubling,
    zeros_between,
)


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


def _heights(point: OrbitPoint) -> np.ndarray:
    """|μ| − 1 of all multipliers, in falling order."""
    return np.sort(abs(_multipliers(point)) - 1)[::-1]


def overlooked(
    curve_at: Callable[[OrbitPoint], Curve[OrbitPoint]],
    points: Sequence[OrbitPoint],
    special: Sequence[Special[OrbitPoint]],
) -> Iterator[Special[OrbitPoint]]:
    """Points at which multipliers cross the unit circle in several steps, given the curve of each
    point and the special points that are known."""
    heights = np.array([_heights(point) for point in points])
    pairs = itertools.pairwise(points)
    alike = np.array([a.sequence == b.sequence and a.t0 == b.t0 for a, b in pairs], bool)
    known = [s.index for s in special if s.kind in (DOUBLING, PAIR)]
    for i, rank in late_crossings(heights, alike, known):
        a, b = points[i : i + 2]

        def height(point: OrbitPoint, rank: int = rank) -> float:
            return float(_heights(point)[rank])

        point = zero_on_curve(curve_at(a), a, b, height)
        kind = None if point is None else kind_on_circle(_multipliers(point))
        if point is not None and kind is not None:
            yield Special(kind, point, point.sequence, point.sequence, i + 1)


def _zeros(curve: Curve[OrbitPoint], a: OrbitPoint, b: OrbitPoint) -> Iterator[Special[OrbitPoint]]:
    """Zeros of the test functions between two points with the same contacts."""
    tests = {
        "fold": _fold,
        "period-doubling": lambda point: period_doubling(np.asarray(point.shot.monodromy)),
        "branch-point": crossing(a, b),
    }
    for kind, point in zeros_between(curve, a, b, tests, _multipliers):
        if kind == "branch-point":
            point = dataclasses.replace(point, tangent=_tangent_between(a, b, point))
        yield Special(kind, point, point.sequence, point.sequence)


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
