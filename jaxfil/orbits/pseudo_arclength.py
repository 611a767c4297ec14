"""Pseudo-arclength continuation along a curve of solutions.

The predictor goes along the tangent, the corrector returns to the curve across it. The parameter is
one unknown among others, so that folds need no special treatment.
"""

import dataclasses
from typing import Any, Generic, TypeVar

import numpy as np

from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS
from jaxfil.orbits.curve import SHARP, Curve, CurvePoint, Special, constraint_across
from jaxfil.orbits.locating import away_from_corner

# A corrected point further than this many steps from the last one may be on another curve; the step
# is then halved.
_STRAYED = 2.0

_Point = TypeVar("_Point", bound=CurvePoint)


@dataclasses.dataclass(frozen=True)
class FollowedCurve(Generic[_Point]):
    """Points in order, the special ones, the reasons for the end at either side, and whether the
    last point is the first one again."""

    points: list[_Point]
    special: list[Special[_Point]]
    ended: tuple[str, str]
    closed: bool = False


@dataclasses.dataclass(frozen=True)
class Range:
    """The allowed range of the parameter, and the directions of continuation, ±1."""

    low: float
    high: float
    ways: tuple[float, ...]

    def is_left(self, value: float, rate: float) -> bool:
        """Whether a curve leaves the range from this value with this rate."""
        return (value <= self.low and rate < 0) or (value >= self.high and rate > 0)


def ends_of(stop: Any) -> list[float]:
    """The argument `stop`, a number or a pair, as a list of one or two numbers."""
    must = "a number or a pair (low, high)"
    ends = check.known_numbers("stop", stop, must).astype(float)
    if ends.shape not in ((), (2,)) or not np.isfinite(ends).all():
        raise ValueError(f"`stop` must be {must}, got {check.told(stop)}.")
    return np.atleast_1d(ends).tolist()


def limits_of(stop: Any, max_step: Any, max_points: Any) -> tuple[list[float], tuple[float, int]]:
    """The ends of a curve, its largest step and its largest number of points, from arguments."""
    most = check.count("max_points", max_points)
    longest = float(check.scalar("max_step", max_step, float, positive=True))
    return ends_of(stop), (longest, most)


def range_around(ends: list[float], value: float) -> Range:
    """The range for a curve that starts at a value."""
    if len(ends) == 1:
        (end,) = ends
        if end == value:
            raise ValueError(f"`stop` must differ from the value at the start, got {end}.")
        return Range(min(end, value), max(end, value), (float(np.sign(end - value)),))
    low, high = ends
    ways = tuple(way for way, on in ((-1.0, low < value), (1.0, value < high)) if on)
    if not low <= value <= high or not ways:
        raise ValueError(f"`stop` must be (low, high) around the value {value}, got {low, high}.")
    return Range(low, high, ways)


def range_ahead(ends: list[float], value: float) -> Range:
    """The range for a curve that begins at a value and is followed one way, in any direction; a
    single number bounds one side only."""
    within = range_around(ends, value)
    if len(ends) == 1:
        (way,) = within.ways
        low, high = (-np.inf, ends[0]) if way > 0 else (ends[0], np.inf)
        within = dataclasses.replace(within, low=low, high=high)
    return dataclasses.replace(within, ways=(1.0,))


def follow(
    curve: Curve[_Point], start: _Point, within: Range, max_step: float, max_points: int
) -> FollowedCurve[_Point]:
    """The curve from one point to its ends, starting in the direction of its tangent."""
    path = _both_ways(curve, start, within, max_step, max_points)
    special = [*path.special, *curve.overlooked(path.points, path.special)]
    return dataclasses.replace(path, special=sorted(special, key=lambda s: s.index))


def _both_ways(
    curve: Curve[_Point], start: _Point, within: Range, max_step: float, max_points: int
) -> FollowedCurve[_Point]:
    paths: list[FollowedCurve[_Point]] = []
    for way in within.ways:
        begin = dataclasses.replace(start, tangent=way * start.tangent)
        path = _follow(curve, begin, within, max_step, max_points)
        if path.closed:
            return dataclasses.replace(path, ended=(path.ended[1],) * 2)
        paths.append(path)
    if len(paths) > 1:
        return _joined(*paths)
    (path,) = paths
    return dataclasses.replace(path, ended=(f"start at {curve.told(start)}", path.ended[1]))


def _joined(first: FollowedCurve[_Point], ahead: FollowedCurve[_Point]) -> FollowedCurve[_Point]:
    """Both directions from one point as one path, in the order of the direction ahead."""
    shift = len(first.points) - 1
    turned = [
        Special(s.kind, s.point, s.after, s.before, shift - s.index + 1)
        for s in reversed(first.special)
    ]
    moved = [dataclasses.replace(s, index=s.index + shift) for s in ahead.special]
    points = first.points[:0:-1] + ahead.points
    return FollowedCurve(points, turned + moved, (first.ended[1], ahead.ended[1]))


def _follow(
    curve: Curve[_Point], start: _Point, within: Range, max_step: float, max_points: int
) -> FollowedCurve[_Point]:
    points, special, ds = [start], [], min(curve.steps.first, max_step)

    def end(why: str, closed: bool = False) -> FollowedCurve[_Point]:
        return FollowedCurve(points, special, ("", why), closed)

    while len(points) < max_points:
        here = points[-1]
        ahead, ds = _advance(curve, here, ds, max_step)
        moved = curve.elsewhere(here, start) if ahead is None else None
        if moved is not None:
            curve, here, start = moved
            ahead, ds = _advance(curve, here, min(curve.steps.first, max_step), max_step)
        corner = None
        if ahead is None:
            beyond = curve.beyond_end(here)
            if beyond is None:
                last = curve.special_end(here)
                special.extend(dataclasses.replace(s, index=len(points) - 1) for s in last)
                return end(_lost(curve, here))
            # The curve is unknown in the new direction; steps grow from a small one.
            (ahead, corner), ds = beyond, 0.1 * curve.steps.first
        refusal = curve.refusal(ahead)
        if refusal is not None:
            return end(f"{refusal} beyond {curve.told(here)}")
        ahead, why = _last(curve, start, here, ahead)
        edges = (within.low, within.high)
        edge = next((v for v in edges if _passes(curve.value(here), curve.value(ahead), v)), None)
        if edge is not None:
            last, gone = curve.at_value(here, ahead, edge), _reach(here, ahead)
            if last is None and corner is None and gone > curve.steps.least:
                ds = 0.5 * gone  # too many changes for one step
                continue
            ahead, why = last or ahead, f"{curve.parameter} = {edge:.10g} was reached"
        if corner is not None:
            special.append(dataclasses.replace(corner, index=len(points) - 1))
        else:
            found = curve.special_points(here, ahead)
            special.extend(dataclasses.replace(s, index=len(points)) for s in found)
        points.append(ahead)
        if not why:
            continue
        onward = None if edge is not None or ahead is start else curve.beyond_last(ahead)
        if onward is None:
            return end(why, closed=ahead is start)
        curve, points[-1], passed = onward
        special.append(dataclasses.replace(passed, index=len(points) - 1))
        if within.is_left(curve.value(points[-1]), points[-1].tangent[curve.place]):
            return end(why)
        ds = min(curve.steps.first, max_step)
    return end(f"{max_points} points were made")


def _lost(curve: Curve[_Point], here: _Point) -> str:
    """The reason why no step from a point succeeds, from the shortest step."""
    scale, tangent = _measured(curve, here)
    step = curve.steps.least
    constraint = constraint_across(here.u, scale, tangent, step)
    point, result = curve.begin(here.u + step * tangent * scale, constraint, tangent)
    # It lies in another direction, or on another branch.
    away = "the shortest step leads away from it"
    met = away if point is not None else str(RESULTS.names(result))
    about = "; ".join(v for v in (met, curve.about(here)) if v)
    return f"no {curve.solution} was found beyond {curve.told(here)} ({about})"


def _measured(curve: Curve[_Point], here: _Point) -> tuple[np.ndarray, np.ndarray]:
    """The scales of a step from a point, and its tangent in these scales, which differ from the
    scales of the point itself."""
    scale = curve.metric(here)
    tangent = here.tangent * here.scale / scale
    return scale, tangent / np.linalg.norm(tangent)


def _last(curve: Curve[_Point], start: _Point, here: _Point, ahead: _Point) -> tuple[_Point, str]:
    """The end of a step, and the reason if the curve ends there."""
    if _returns(curve, start, here, ahead):
        return start, f"closed at {curve.told(start)}"
    return curve.last_between(here, ahead) or (ahead, "")


def _returns(curve: Curve[_Point], start: _Point, here: _Point, ahead: _Point) -> bool:
    """Whether a step passes the start again, in the same direction."""
    scale, place = start.scale, curve.place
    reach = np.linalg.norm((ahead.u - here.u) / scale)
    # In the parameter alone first, which must be near, and not be passed.
    towards = (start.u[place] - here.u[place]) / scale[place]
    if here is start or abs(towards) > reach or towards * start.tangent[place] < -(reach**2):
        return False
    a, b = curve.beside(here, start), curve.beside(ahead, start)
    chord, back = (b - a) / scale, (start.u - a) / scale
    part = (chord @ back) / (chord @ chord)
    if not 0 < part <= 1 or chord @ start.tangent <= 0:
        return False
    if np.linalg.norm(back - part * chord) > np.linalg.norm(chord):
        return False
    # Across the step, where the start is.
    constraint = constraint_across(start.u, scale, chord / np.linalg.norm(chord), 0.0)
    point = curve.correct(a + part * (b - a), constraint, here.tangent)
    if point is None:
        return False
    off = np.linalg.norm((point.u - start.u) / scale)
    return bool(off < np.sqrt(np.finfo(start.u.dtype).eps))


def _reach(here: _Point, ahead: _Point) -> float:
    """The length of a step, in scaled unknowns."""
    return float(np.linalg.norm((ahead.u - here.u) / ahead.scale))


def _passes(here: float, ahead: float, edge: float) -> bool:
    return here != edge and (here - edge) * (ahead - edge) <= 0


def _advance(
    curve: Curve[_Point], here: _Point, ds: float, max_step: float
) -> tuple[_Point | None, float]:
    """The next point, and the step to try after it."""
    steps = curve.steps
    scale, tangent = _measured(curve, here)
    while ds >= steps.least:
        # The prediction satisfies the constraint; the corrector moves at right angles to it.
        constraint = constraint_across(here.u, scale, tangent, ds)
        ahead = curve.correct(here.u + ds * tangent * scale, constraint, tangent)
        if ahead is not None:
            cosine = float(ahead.tangent @ tangent)
            strayed = np.linalg.norm((ahead.u - here.u) / scale) > _STRAYED * ds
            # A corner is passed in one short step; a curve is followed in many.
            sharp = cosine <= SHARP
            passes = not strayed and (not sharp or ds < steps.corner)
            if passes and not curve.jumps(here, ahead):
                if sharp and not curve.same(here, ahead):
                    ahead = away_from_corner(curve, here, ahead)
                grows = cosine > steps.straight and ahead.num_steps <= steps.easy
                return ahead, min(max_step, steps.growth * ds) if grows else ds
        ds *= 0.5
    return None, ds
