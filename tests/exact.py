"""Exact motions of random relay systems, in closed form per piece and in extended precision.

    x' = A x + b + Σ_j s_j (c_j + g_j H_j),   s_j = sgn H_j,   H_j = n_j·x - d_j

A relay system and an initial state enter; the contacts, the state at the end and a margin leave.
On every side the field is affine. It is affine too where the motion slides on a set J of surfaces:
there H_J = 0, and the weights w_J that replace s_J solve n_J·x' = 0, which is linear. So each piece
is z(t) = exp(Z t) z with z = (x, 1), summed here as its Taylor series over lengths on which it
converges within thirty terms. A guard (±H_j on a side, 1 ± w_j on a slide) is a polynomial there.
Between the zeros of its derivative it is monotone, so that no contact is missed; the first one is
bisected.

What first-order reasoning cannot decide is told by `Motion.margin` and never by a comparison: it is
the least relative size, over the whole motion, of every number whose sign was used to go on (guards
at their minima and at the contacts of others, rates at contacts and departures, and the conditions
on the mode after a contact). A motion with a margin of rounding size is a graze, a corner, or a
tangency to within rounding.

Nothing of the library is used.
"""

import itertools
from typing import NamedTuple

import numpy as np

REAL = np.longdouble
LEFT = (-1, 0)
TERMS = 30


class Relays(NamedTuple):
    """The arrays of a system with n states and m surfaces, a row each."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    g: np.ndarray
    n: np.ndarray
    d: np.ndarray


class Motion(NamedTuple):
    """`ts`, `surfaces`, `kinds`, `before`: the contacts. `x`, `mode`: where it ended, at `t`.
    `rate` is the largest norm of the fields' matrices on the way: what a step must resolve."""

    outcome: str
    t: float
    x: np.ndarray
    mode: tuple[int, ...]
    ts: list
    surfaces: list[int]
    kinds: list[str]
    before: list[np.ndarray]
    margin: float
    rate: float


def real(system: Relays) -> Relays:
    return Relays(*(np.asarray(v, REAL) for v in system))


def side_field(system: Relays, mode):
    """(A, b) of the affine field with the terms of the surfaces slid on left out."""
    a, b = system.a.copy(), system.b.copy()
    for s, c, g, n, d in zip(mode, system.c, system.g, system.n, system.d, strict=True):
        if s != 0:
            a += s * np.outer(g, n)
            b += s * (c - g * d)
    return a, b


def inverse(matrix):
    """The inverse of a 1×1 or 2×2 matrix that is regular relative to its entries."""
    if matrix.shape == (1, 1):
        det, adjugate = matrix[0, 0], np.ones((1, 1), REAL)
    else:
        (p, q), (r, s) = matrix
        det, adjugate = p * s - q * r, np.asarray([[s, -q], [-r, p]])
    if abs(det) <= 1e-9 * abs(matrix).max() ** len(matrix) or abs(det) < 1e-9:
        raise Degenerate
    return adjugate / det


def mode_field(system: Relays, mode):
    """(Z, W): z' = Z z, and the rows of W z are the weights of the surfaces slid on, in order."""
    a, b = side_field(system, mode)
    z = np.zeros((len(b) + 1,) * 2, REAL)
    z[:-1, :-1], z[:-1, -1] = a, b
    slid = [j for j, s in enumerate(mode) if s == 0]
    if not slid:
        return z, np.zeros((0, len(b) + 1), REAL)
    weights = -inverse(system.n[slid] @ system.c[slid].T) @ system.n[slid] @ z[:-1]
    z[:-1] += system.c[slid].T @ weights
    return z, weights


class Degenerate(Exception):
    """A sliding motion that is not defined: its weights have no single solution."""


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
    """The least of what was asked of it."""

    def __init__(self):
        self.least = np.inf

    def __call__(self, value, scale):
        self.least = min(self.least, float(abs(value) / scale) if scale > 0 else 0.0)
        return value


def first_fall(p, length, scale, margin: Margin):
    """Where p first falls through zero in [0, length], None if it does not."""
    rest = (abs(p[1:]) * length ** np.arange(1, len(p))).sum()
    if p[0] - rest > 1e-3 * scale:
        return None
    points = [REAL(0), *turning_points(p, length), REAL(length)]
    values = [np.polyval(p[::-1], at) for at in points]
    for i in range(1, len(points)):
        if i < len(points) - 1:
            margin(values[i], scale)
        if values[i] < 0:
            return bisected(p, points[i - 1], points[i]) if values[i - 1] > 0 else points[i - 1]
    return None


def series(z_matrix, z):
    """The terms Z^i z / i!, (TERMS, n + 1)."""
    terms = [z]
    for i in range(1, TERMS):
        terms.append(z_matrix @ terms[-1] / i)
    return np.asarray(terms)


def modes_after(system: Relays, x, mode, on, margin: Margin):
    """Every mode that goes on from x, on the surfaces `on`; the other surfaces keep theirs."""
    admissible = []
    for choice in itertools.product((1, -1, 0), repeat=len(on)):
        candidate = list(mode)
        for j, s in zip(on, choice, strict=True):
            candidate[j] = s
        z_matrix, weights = mode_field(system, candidate)
        z = np.append(x, REAL(1))
        f = (z_matrix @ z)[:-1]
        w = iter(weights @ z)
        ok = True
        for j in range(len(mode)):
            if candidate[j] == 0:
                value = next(w)
                margin(1 - abs(value), 1 + abs(value))
                ok &= bool(abs(value) < 1)
            elif j in on:
                rate = system.n[j] @ f
                margin(rate, np.linalg.norm(system.n[j]) * speed(f))
                ok &= bool(candidate[j] * rate > 0)
        if ok:
            admissible.append(tuple(candidate))
    return admissible


def speed(f):
    return np.sqrt((f * f).sum()) + REAL(1e-300)


def propagate(system: Relays, x0, t1, most=40) -> Motion:
    """The motion from x0 at t = 0 to t1. Outcomes: "successful"; "nonunique", where
    several modes go on after a contact, or another one can leave an intersection slid on;
    "undecided", where none goes on; "many", after `most` contacts; "degenerate"."""
    system = real(system)
    x, t, t1 = np.asarray(x0, REAL), REAL(0), REAL(t1)
    margin = Margin()
    h = system.n @ x - system.d
    for j, value in enumerate(h):
        margin(value, np.linalg.norm(system.n[j]) * (speed(x) + 1))
    mode = tuple(1 if v > 0 else -1 for v in h)
    events: tuple[list, list, list, list] = ([], [], [], [])
    zeros = [0] * len(mode)  # the order of the zero that each guard starts from
    outcome, rate = "successful", 0.0
    try:
        while True:
            rate = max(rate, float(np.sqrt((mode_field(system, mode)[0] ** 2).sum())))
            t, x, hit = piece(system, x, t, t1, mode, zeros, margin)
            if hit is None:
                break
            if hit is LEFT:
                outcome = "nonunique"
                break
            if len(events[0]) == most:
                outcome = "many"
                break
            before = mode
            zeros = [0] * len(mode)
            if mode[hit[0]] == 0:
                mode = tuple(hit[1] if j == hit[0] else s for j, s in enumerate(mode))
                zeros[hit[0]], kind = 2, "slip"
            else:
                on = [j for j, s in enumerate(mode) if s == 0 or j == hit[0]]
                after = modes_after(system, x, mode, on, margin)
                if len(after) != 1:
                    outcome = "nonunique" if after else "undecided"
                    break
                (mode,) = after
                for j in on:
                    zeros[j] = int(mode[j] != 0)
                now, then = mode[hit[0]], before[hit[0]]
                kind = "stick" if now == 0 else "crossing" if now != then else "graze"
            for column, value in zip(events, (t, hit[0], kind, x), strict=True):
                column.append(value)
    except Degenerate:
        outcome, margin.least = "degenerate", 0.0
    return Motion(outcome, t, x, mode, *events, margin.least, rate)


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


def piece(system: Relays, x, t, t1, mode, zeros, margin: Margin):
    """On in one mode to the first contact, (surface, side it leaves a slide to), to t1, or to where
    another mode could leave the intersection slid on (`LEFT`)."""
    z_matrix, weights = mode_field(system, mode)
    z = np.append(x, REAL(1))
    size = np.sqrt((z_matrix * z_matrix).sum())
    longest = 1 / (size + REAL(1e-3))
    guards = []
    rows = iter(weights)
    one = np.append(np.zeros_like(x), REAL(1))
    for j, s in enumerate(mode):
        if s == 0:
            row = next(rows)
            guards += [(j, 1, one - row, 0), (j, -1, one + row, 0)]
        else:
            guards.append((j, s, s * np.append(system.n[j], -system.d[j]), zeros[j]))
    first, rivals = True, others(system, mode)
    while t < t1:
        length = min(longest, t1 - t)
        terms = series(z_matrix, z)
        found = []
        for j, side, row, order in guards:
            p, scale = terms @ row, np.linalg.norm(row) * np.linalg.norm(z)
            if first and order:
                # Starts from a zero of this order, by construction: that much is divided out.
                p = p[order:]
                scale = np.linalg.norm(row) * np.linalg.norm(terms[order]) + REAL(1e-300)
                if margin(p[0], scale) < 0:
                    raise Degenerate
            at = first_fall(p, length, scale, margin)
            if at is not None:
                found.append((at, j, side))
        # A slide ends where another begins.
        before = min(found)[0] - 1e-6 * length if found else length
        appear = [appearance(rows, terms, before, margin) for rows in rivals if before > 0]
        appear = [at for at in appear if at is not None]
        if appear:
            at = min(appear)
            return t + at, (terms * (at ** np.arange(TERMS))[:, None]).sum(axis=0)[:-1], LEFT
        if found:
            at, j, side = min(found)
            z_at = (terms * (at ** np.arange(TERMS))[:, None]).sum(axis=0)
            f = z_matrix @ z_at
            for k, other, row, _ in guards:
                if (k, other) == (j, side):
                    margin(row @ f, np.linalg.norm(row) * np.linalg.norm(f))
                elif not (first and zeros[k]) or at > 1e-6:
                    margin(row @ z_at, np.linalg.norm(row) * np.linalg.norm(z_at))
            return t + at, z_at[:-1], (j, side)
        z = (terms * (length ** np.arange(TERMS))[:, None]).sum(axis=0)
        t, first = t + length, False
    return t1, z[:-1], None
