"""Polynomials in extended precision: Taylor series of linear motions, and where they first vanish.

A matrix and a state enter as a series, a polynomial and a length as numbers; zeros leave. Between
the zeros of its derivative a polynomial is monotone, so that none of its own is missed; the first
one is bisected. What the sign of a number decided is noted by a `Margin`.
"""

import numpy as np

REAL = np.longdouble
TERMS = 30


def shifted(p, at):
    """The coefficients of p(at + ·)."""
    p = p.copy()
    for i in range(len(p) - 1):
        for k in range(len(p) - 2, i - 1, -1):
            p[k] += at * p[k + 1]
    return p


def turning_points(p, length):
    """Where the derivative of a polynomial vanishes in [0, length], by bisection with bounds."""
    slope = p[1:] * np.arange(1, len(p))
    powers = REAL(length) ** np.arange(len(p))
    if (abs(slope) * powers[1:]).sum() <= 64 * np.finfo(REAL).eps * (abs(p) * powers).sum():
        return []  # constant to rounding
    found, todo = [], [(REAL(0), REAL(length))]
    while todo:
        lo, hi = todo.pop()
        middle, radius = (lo + hi) / 2, (hi - lo) / 2
        q = shifted(slope, middle)
        bounds = abs(q) * radius ** np.arange(len(q))
        if bounds[0] > bounds[1:].sum():
            continue
        if bounds[1] > 2 * (bounds[2:] * np.arange(2, len(q))).sum() or radius < 1e-13 * length:
            # The slope is monotone here: one zero, or none.
            ends = np.polyval(q[::-1], [-radius, radius])
            if ends[0] * ends[1] <= 0:
                found.append(bisected(slope, lo, hi))
            continue
        todo += [(middle, hi), (lo, middle)]
    return sorted(found)


def bisected(p, lo, hi):
    """The zero between lo and hi, where p changes sign: bisection until Newton takes over."""
    backwards = p[::-1]
    rising = np.polyval(backwards, hi) > 0
    for _ in range(70):
        middle = (lo + hi) / 2
        if (np.polyval(backwards, middle) > 0) == rising:
            hi = middle
        else:
            lo = middle
    return (lo + hi) / 2


class Margin:
    """The least of what was asked of it: of rates, and of distances piece by piece."""

    def __init__(self):
        self.rates, self.distances = np.inf, [np.inf]

    def __call__(self, value, scale):
        self.rates = min(self.rates, self._relative(value, scale))
        return value

    def near(self, value, scale):
        """How far from a surface that the motion does not meet."""
        self.distances[-1] = min(self.distances[-1], self._relative(value, scale))

    def next_piece(self):
        """A contact has been met."""
        self.distances.append(np.inf)

    def forget(self, first):
        """Distances that shrink to nothing since contact number `first`."""
        self.distances[first + 1 :] = [np.inf] * (len(self.distances) - first - 1)

    @property
    def least(self):
        """The margin of the motion."""
        return min(self.rates, *self.distances)

    @staticmethod
    def _relative(value, scale):
        return float(abs(value) / scale) if scale > 0 else 0.0


def first_fall(p, length, scale, margin: Margin):
    """Where p first falls through zero in [0, length], None if it does not."""
    rest = (abs(p[1:]) * length ** np.arange(1, len(p))).sum()
    if p[0] - rest > 1e-3 * scale:
        return None
    points = [REAL(0), *turning_points(p, length), REAL(length)]
    values = [np.polyval(p[::-1], at) for at in points]
    for i in range(1, len(points)):
        if i < len(points) - 1:
            margin.near(values[i], scale)
        if values[i] < 0:
            return bisected(p, points[i - 1], points[i]) if values[i - 1] > 0 else points[i - 1]
    return None


def series(z_matrix, z):
    """The terms Z^i z / i!, (TERMS, n + 1)."""
    terms = [z]
    for i in range(1, TERMS):
        terms.append(z_matrix @ terms[-1] / i)
    return np.asarray(terms)
