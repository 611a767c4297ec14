"""Other motions that leave an intersection of surfaces while one slides on it.

A system, a mode, and the series of a motion in it enter; the rows of z that are positive where
another mode goes on, and the first time that they all are, leave.
"""

import itertools

import numpy as np

from tests.oracles.polynomials import REAL, TERMS, Margin, bisected, turning_points
from tests.oracles.relay_modes import Relays, mode_field


def appearance(rows, terms, length, margin: Margin):
    """When all of these rows of z are positive first in [0, length), None if they never are."""
    polynomials = [terms @ row for row in rows]
    times = {REAL(0)}
    for p in polynomials:
        points = [REAL(0), *turning_points(p, length), REAL(length)]
        signs = [np.polyval(p[::-1], at) > 0 for at in points]
        pairs = zip(points, points[1:], signs, signs[1:], strict=False)
        times |= {bisected(p, a, b) for a, b, u, v in pairs if u != v}
    for at in sorted(times):
        after = at + 1e-9 * length
        powers = length ** np.arange(TERMS)
        least = min(np.polyval(p[::-1], after) / (abs(p) @ powers + 1e-300) for p in polynomials)
        if least > 1e-14:
            return at
        if least > -1e-14:
            margin(0, 1)
    return None


def rows_of(system: Relays, mode, slid):
    """The rows of z that are positive where this mode goes on from the surfaces `slid`."""
    z_matrix, weights = mode_field(system, mode)
    one, w, rows = np.eye(len(z_matrix), dtype=REAL)[-1], iter(weights), []
    for j in slid:
        if mode[j] == 0:
            row = next(w)
            rows += [one - row, one + row]
        else:
            rows.append(mode[j] * system.n[j] @ z_matrix[:-1])
    return rows


def others(system: Relays, mode):
    """The rows of every other mode that may come to leave the intersection slid on."""
    slid = [j for j, s in enumerate(mode) if s == 0]
    if len(slid) < 2:
        return []
    found = []
    for choice in itertools.product((1, -1, 0), repeat=len(slid)):
        candidate = list(mode)
        for j, s in zip(slid, choice, strict=True):
            candidate[j] = s
        if any(choice):
            found.append(rows_of(system, candidate, slid))
    return found
