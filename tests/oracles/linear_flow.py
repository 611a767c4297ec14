"""The exact motion of a linear system up to the first zero of a guard.

A matrix Z and rows of guards enter, for z' = Z z; the time at which the first guard falls to zero,
its number and the state there leave. States at the samples are products with matrix exponentials,
and between two samples the Taylor series of the exponential: both are exact to rounding. A guard
that touches zero without falling, or two that fall together, are told by `Uncertain`.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

TERMS = 18
# Samples at once; the largest product of a matrix and the time between two of them.
SAMPLES, TURN = 32, 0.4
# Two events, or a graze and none, that are closer than this are not told apart.
CLOSE = 1e-9
# The slope of a guard that small is of a graze.
FLAT = 1e-6
_POINTS = np.linspace(0, 1, 6)


class Uncertain(Exception):
    """The exact motion is within rounding of another one."""


class Hit(NamedTuple):
    """What ends a flight: the guard, None for the end of time, and the state there."""

    guard: int | None
    t: float
    z: np.ndarray


class Flow:
    """The flow of z' = Z z, with its guards g = G z ≥ 0."""

    def __init__(self, matrix, guards):
        self.matrix, self.guards = matrix, guards
        self.step = min(0.05, TURN / (np.linalg.norm(matrix, 2) + 1e-3))
        self._powers = None

    @property
    def powers(self):
        """The exponentials that lead to the samples."""
        if self._powers is None:
            one = scipy.linalg.expm(self.step * self.matrix)
            found = [np.eye(len(one))]
            for _ in range(SAMPLES):
                found.append(found[-1] @ one)
            self._powers = np.array(found)
        return self._powers

    def series(self, z, terms=TERMS):
        """The Taylor series of the motion, a row for each power of the time."""
        rows = [z]
        for k in range(1, terms):
            rows.append(self.matrix @ rows[-1] / k)
        return np.array(rows)

    def fly(self, z, t, t1, orders):
        """From z at t to the first fall of a guard, or to t1. The guards have zeros of these orders
        at the start; one of order None stays zero."""
        length = min(self.step, t1 - t)
        kept = [j for j, order in enumerate(orders) if order is not None]
        hit = self._within(z, t, length, kept, orders)
        while hit.guard is None and hit.t < t1 - 1e-14:
            hit = self._on(hit.z, hit.t, t1, kept)
        return hit

    def _on(self, z, t, t1, kept):
        """As far as samples are taken at once."""
        count = int(min(SAMPLES, (t1 - t) / self.step))
        zs = self.powers[: count + 1] @ z
        guards = self.guards[kept]
        values, slopes = zs @ guards.T, zs @ self.matrix.T @ guards.T
        ends = np.any(values[1:] < CLOSE, axis=1)
        # A low place of a guard is looked at if it can come near to zero.
        lowest = values[:-1] + 1.5 * self.step * slopes[:-1]
        turns = np.any((slopes[:-1] < 0) & (slopes[1:] > 0) & (lowest < CLOSE), axis=1)
        for k in np.flatnonzero(ends | turns):
            hit = self._within(zs[k], t + k * self.step, self.step, kept)
            if hit.guard is not None:
                return hit
        t, z = t + count * self.step, zs[count]
        return Hit(None, t, z) if count == SAMPLES else self._within(z, t, t1 - t, kept)

    def _within(self, z, t, length, kept, orders=None):
        """Within one step, by the Taylor series."""
        terms, found, guards = self.series(z), [], {}
        for j in kept:
            p, order = terms @ self.guards[j], orders[j] if orders is not None else 0
            guards[j] = np.append(p[order:], np.zeros(order))
            at = first_fall(guards[j], length)
            if at is not None:
                found.append((at, j))
        at, hit = min(found) if found else (length, None)
        for j, p in guards.items() if hit is not None else ():
            value, slope = np.polyval(p[::-1], at), np.polyval(derivative(p)[::-1], at)
            if j != hit and value < CLOSE * abs(slope) + 1e-13:
                raise Uncertain("two events at once")
        end = (terms * (at ** np.arange(TERMS))[:, None]).sum(axis=0)
        return Hit(hit, t + at, end)


def derivative(p):
    """That of a polynomial, lowest power first."""
    return p[1:] * np.arange(1, len(p))


def first_fall(p, length):
    """The first zero of a polynomial that starts above zero, in (0, length], or None."""
    if p[0] <= 0:
        if p[0] < -1e-10:
            raise Uncertain("a guard starts below zero")
        p = np.append(0.0, p[1:])
    ts, dp = length * _POINTS, derivative(p)
    values, slopes = np.polyval(p[::-1], ts), np.polyval(dp[::-1], ts)
    for k in range(len(ts) - 1):
        low, high = ts[k], ts[k + 1]
        if abs(values[k + 1]) < CLOSE and abs(slopes[k + 1]) < FLAT:
            raise Uncertain("a graze")
        if values[k + 1] < 0:
            return _root(p, dp, low, high)
        if slopes[k] < 0 < slopes[k + 1]:
            least = _root(dp, derivative(dp), low, high)
            value = np.polyval(p[::-1], least)
            if abs(value) < CLOSE:
                raise Uncertain("a graze")
            if value < 0:
                return _root(p, dp, low, least)
    return None


def _root(p, dp, low, high):
    """The zero between two points at which a polynomial has different signs."""
    rises = np.polyval(p[::-1], high) > 0
    p, dp = p[::-1], dp[::-1]
    at = 0.5 * (low + high)
    for _ in range(100):
        value, slope = np.polyval(p, at), np.polyval(dp, at)
        low, high = (low, at) if (value > 0) == rises else (at, high)
        step = value / slope if slope else np.inf
        before, at = at, at - step
        if not low <= at <= high:
            at = 0.5 * (low + high)
        if abs(at - before) <= 1e-16 * (1 + abs(at)):
            break
    return at
