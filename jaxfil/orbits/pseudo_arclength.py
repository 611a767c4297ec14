"""Along a branch of orbits, step by step, from one point on.

A point of a `OrbitProblem` with the direction in which to go enters; the points ahead leave, with the
special ones among them and why they end.

Where the period map has a square root (an orbit that grazes a discontinuity) the branch has a
corner: it goes on in another direction, perhaps back. The step cannot get round it; the points of
the branch in planes of many directions close by can, and the one that does not lead back goes on.
"""

import dataclasses

import numpy as np

from jaxfil.orbits.corrector import (
    OrbitProblem,
    Point,
    constraint_across,
    correct,
    correct_many,
    metric,
)
from jaxfil.orbits.special_points import special_points

# Steps, in scaled unknowns: a state by its largest value on the orbit, the parameter by its size.
_FIRST, _LEAST = 0.005, 1e-9
# The tangent may turn by this cosine in a step; below the other the step may grow.
_SHARP, _STRAIGHT = 0.9, 0.995
# Directions in which the way round a corner is searched, and how far from it.
_DIRECTIONS, _RADIUS = 48, 1e-3
# A point further away than so many of these distances is on another branch, one at this cosine to
# the tangent where the branch has come from.
_REACH, _BACK = 20, -0.95


def follow(
    family: OrbitProblem, start: Point, low: float, high: float, max_step: float, max_points: int
) -> tuple[list[Point], list[tuple], str]:
    """Points from `start` on, the special ones among them, and why they end."""
    points, special, ds = [start], [], min(_FIRST, max_step)
    while len(points) < max_points:
        here = points[-1]
        ahead, ds = _advance(family, here, ds, max_step)
        corner = None
        if ahead is None:
            corner = here
            ahead = _round_corner(family, here)
            if ahead is None:
                return points, special, f"no orbit was found beyond {here.value:.10g}"
            ds = _FIRST * 0.1
        end = next((edge for edge in (low, high) if _passes(here, ahead, edge)), None)
        if end is not None:
            last = _at_value(family, here, ahead, end)
            ahead = last or ahead
        if corner is not None:
            special.append(("contacts", here, here.sequence, ahead.sequence, len(points) - 1))
        else:
            special.extend((*found, len(points)) for found in special_points(family, here, ahead))
        points.append(ahead)
        if end is not None:
            return points, special, f"{family.parameter} = {end:.10g} was reached"
    return points, special, f"{max_points} points were made"


def _passes(here: Point, ahead: Point, edge: float) -> bool:
    a, b = here.value - edge, ahead.value - edge
    return a != 0 and a * b <= 0


def _advance(
    family: OrbitProblem, here: Point, ds: float, max_step: float
) -> tuple[Point | None, float]:
    """The next point, and the step to try after it."""
    scale = metric(family, here)
    tangent = here.tangent * here.scale / scale
    tangent = tangent / np.linalg.norm(tangent)
    while ds >= _LEAST:
        plane = constraint_across(here.u, scale, tangent, ds)
        ahead = correct(family, here.u + ds * tangent * scale, plane, tangent)
        if ahead is not None:
            cosine = float(ahead.tangent @ tangent)
            strayed = np.linalg.norm((ahead.u - here.u) / scale) > 2 * ds
            # A corner is passed in a short step; a curve is followed in many.
            if not strayed and (cosine > _SHARP or ds < 1e-5):
                grows = cosine > _STRAIGHT and ahead.num_steps <= 5
                return ahead, min(max_step, ds * 1.6) if grows else ds
        ds *= 0.5
    return None, ds


def _round_corner(family: OrbitProblem, here: Point) -> Point | None:
    """The nearest way on from a point where the branch ahead ends: in planes close by, of random
    directions, the nearest point with other contacts that does not lie where the branch has come
    from."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(_DIRECTIONS, here.u.size))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    scale = metric(family, here)
    guesses = here.u + _RADIUS * normals * scale
    base = np.broadcast_to(here.u, guesses.shape)
    offsets = np.full(_DIRECTIONS, _RADIUS)
    planes = constraint_across(base, np.broadcast_to(scale, guesses.shape), normals, offsets)  # pyright: ignore
    best, least = None, _REACH * _RADIUS
    for point in correct_many(family, guesses, planes, here.tangent):
        away = (point.u - here.u) / scale
        distance = np.linalg.norm(away)
        forward = float(away @ here.tangent / distance)
        if point.sequence != here.sequence and forward > _BACK and distance < least:
            sign = 1.0 if point.tangent @ away >= 0 else -1.0
            best, least = dataclasses.replace(point, tangent=sign * point.tangent), distance
    return best


def _at_value(family: OrbitProblem, a: Point, b: Point, value: float) -> Point | None:
    """The point between two where the parameter has a value."""
    normal = np.zeros_like(a.u)
    normal[-1] = 1.0
    part = (value - a.value) / (b.value - a.value)
    base = a.u + part * (b.u - a.u)
    base[-1] = value
    return correct(family, base, constraint_across(base, a.scale, normal, 0.0), b.tangent)
