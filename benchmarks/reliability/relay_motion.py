"""Exact motions of random relay systems, in closed form per piece and in extended precision.

A relay system (`relay_modes`) and an initial state enter; the contacts, the state at the end and a
margin leave. In each mode the field is affine, so that a piece is z(t) = exp(Z t) z with z = (x,
1), summed here as its Taylor series over lengths on which it converges within thirty terms. A guard
(±H_j on a side, 1 ± w_j on a slide) is a polynomial there, whose first zero is found.

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

from benchmarks.reliability.polynomials import REAL, TERMS, Margin, first_fall, series
from benchmarks.reliability.relay_modes import Degenerate, Relays, mode_field, real
from benchmarks.reliability.rivals import appearance, others

LEFT = (-1, 0)


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
