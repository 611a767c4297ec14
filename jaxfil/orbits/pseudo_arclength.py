"""Pseudo-arclength continuation: along a curve of solutions, step by step.

A `Curve` and a point on it enter; the points on either side leave, in order, with the special ones
among them and why they end. The predictor goes along the tangent, the corrector comes back to the
curve across it: the parameter is one unknown among others, so that a fold is no obstacle.
"""

import dataclasses
from typing import Any, Generic, TypeVar

import numpy as np

from jaxfil.model import check
from jaxfil.orbits.curve import Curve, CurvePoint, Special, constraint_across

# Between two points the tangent may turn by this cosine, and they may be so many steps apart: what
# lies further away is on another curve.
_SHARP, _STRAYED = 0.9, 2.0

_Point = TypeVar("_Point", bound=CurvePoint)


@dataclasses.dataclass(frozen=True)
class Path(Generic[_Point]):
    """Points in order, the special ones, and why they end at either side."""

    points: list[_Point]
    special: list[Special[_Point]]
    ended: tuple[str, str]


@dataclasses.dataclass(frozen=True)
class Range:
    """The range of the parameter in which to stay, and the directions in which to go, ±1."""

    low: float
    high: float
    ways: tuple[float, ...]


def ends_of(stop: Any) -> list[float]:
    """The argument `stop`, a number or a pair, as a list of one or two numbers."""
    must = "a number or a pair (low, high)"
    ends = check.known_numbers("stop", stop, must).astype(float)
    if ends.shape not in ((), (2,)) or not np.isfinite(ends).all():
        raise ValueError(f"`stop` must be {must}, got {check.told(stop)}.")
    return np.atleast_1d(ends).tolist()


def range_around(ends: list[float], value: float) -> Range:
    """What they mean for a curve that starts at a value."""
    if len(ends) == 1:
        (end,) = ends
        if end == value:
            raise ValueError(f"`stop` must differ from the value at the start, got {end}.")
        return Range(min(end, value), max(end, value), (float(np.sign(end - value)),))
    low, high = ends
    ways = (-1.0,) * (low < value) + (1.0,) * (value < high)
    if not low <= value <= high or not ways:
        raise ValueError(f"`stop` must be (low, high) around the value {value}, got {low, high}.")
    return Range(low, high, ways)


def follow(
    curve: Curve[_Point], start: _Point, ends: list[float], max_step: float, max_points: int
) -> Path[_Point]:
    """The curve from one point on to its ends, ahead being where its tangent points."""
    within = range_around(ends, curve.value(start))
    *back, ahead = (
        _follow(
            curve,
            dataclasses.replace(start, tangent=way * start.tangent),
            within,
            max_step,
            max_points,
        )
        for way in within.ways
    )
    if not back:
        begin = f"start at {curve.told(start)}"
        return dataclasses.replace(ahead, ended=(begin, ahead.ended[1]))
    # What was found on the way back is put in the order of the way ahead.
    first, shift = back[0], len(back[0].points) - 1
    turned = [
        Special(s.kind, s.point, s.after, s.before, shift - s.index + 1)
        for s in reversed(first.special)
    ]
    moved = [dataclasses.replace(s, index=s.index + shift) for s in ahead.special]
    points = first.points[:0:-1] + ahead.points
    return Path(points, turned + moved, (first.ended[1], ahead.ended[1]))


def _follow(
    curve: Curve[_Point], start: _Point, within: Range, max_step: float, max_points: int
) -> Path[_Point]:
    points, special, ds = [start], [], min(curve.steps.first, max_step)

    def end(why: str) -> Path[_Point]:
        return Path(points, special, ("", why))

    while len(points) < max_points:
        here = points[-1]
        ahead, ds = _advance(curve, here, ds, max_step)
        corner = None
        if ahead is None:
            beyond = curve.beyond_end(here)
            if beyond is None:
                return end(f"no {curve.solution} was found beyond {curve.told(here)}")
            # In the new direction nothing is known of the curve: steps grow from a small one.
            (ahead, corner), ds = beyond, 0.1 * curve.steps.first
        refusal = curve.refusal(ahead)
        if refusal is not None:
            return end(f"{refusal} beyond {curve.told(here)}")
        edges = (within.low, within.high)
        edge = next((v for v in edges if _passes(curve.value(here), curve.value(ahead), v)), None)
        if edge is not None:
            ahead = curve.at_value(here, ahead, edge) or ahead
        if corner is not None:
            special.append(dataclasses.replace(corner, index=len(points) - 1))
        else:
            found = curve.special_points(here, ahead)
            special.extend(dataclasses.replace(s, index=len(points)) for s in found)
        points.append(ahead)
        if edge is not None:
            return end(f"{curve.parameter} = {edge:.10g} was reached")
    return end(f"{max_points} points were made")


def _passes(here: float, ahead: float, edge: float) -> bool:
    return here != edge and (here - edge) * (ahead - edge) <= 0


def _advance(
    curve: Curve[_Point], here: _Point, ds: float, max_step: float
) -> tuple[_Point | None, float]:
    """The next point, and the step to try after it."""
    # The tangent is known in the scales in which the point was found; a step is measured in the
    # point's own.
    steps, scale = curve.steps, curve.metric(here)
    tangent = here.tangent * here.scale / scale
    tangent = tangent / np.linalg.norm(tangent)
    while ds >= steps.least:
        # The prediction fulfils the constraint already: the corrector moves at right angles to it.
        constraint = constraint_across(here.u, scale, tangent, ds)
        ahead = curve.correct(here.u + ds * tangent * scale, constraint, tangent)
        if ahead is not None:
            cosine = float(ahead.tangent @ tangent)
            strayed = np.linalg.norm((ahead.u - here.u) / scale) > _STRAYED * ds
            # A corner is passed in a short step; a curve is followed in many.
            if not strayed and (cosine > _SHARP or ds < steps.corner):
                grows = cosine > steps.straight and ahead.num_steps <= steps.easy
                return ahead, min(max_step, steps.growth * ds) if grows else ds
        ds *= 0.5
    return None, ds
