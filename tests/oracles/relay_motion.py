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

from tests.oracles.accumulation import accumulation
from tests.oracles.polynomials import REAL, TERMS, Margin, first_fall, series
from tests.oracles.relay_modes import Degenerate, Relays, mode_field, real
from tests.oracles.rivals import appearance, others

LEFT = (-1, 0)


class Motion(NamedTuple):
    """`ts`, `surfaces`, `kinds`, `before`: the contacts. `x`, `mode`: where it ended, at `t`.
    `rate` is the largest norm of the fields' matrices on the way: what a step must resolve.
    `spans`: first and last time of each accumulation of contacts."""

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
    spans: list


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
    """The length of a vector, and not zero."""
    return np.sqrt((f * f).sum()) + REAL(1e-300)


def propagate(system: Relays, x0, t1, most=40, through=False) -> Motion:
    """The motion from x0 at t = 0 to t1, `through` accumulations of contacts or not. Outcomes:
    "successful"; "nonunique", where several modes go on after a contact, or another one can leave
    an intersection slid on; "undecided", where none goes on; "many", after `most` contacts;
    "degenerate"."""
    system = real(system)
    x, t, t1 = np.asarray(x0, REAL), REAL(0), REAL(t1)
    margin = Margin()
    mode = starting_mode(system, x, margin)
    events: tuple[list, list, list, list] = ([], [], [], [])
    zeros = [0] * len(mode)  # the order of the zero that each guard starts from
    outcome, rate, spans = "successful", 0.0, []
    try:
        while outcome == "successful":
            rate = max(rate, float(np.sqrt((mode_field(system, mode)[0] ** 2).sum())))
            t, x, hit = piece(system, x, t, t1, mode, zeros, margin)
            if hit is None:
                break
            if hit is LEFT or len(events[0]) == most:
                outcome = "nonunique" if hit is LEFT else "many"
                break
            after, zeros, kind = switched(system, x, mode, hit, margin)
            if after is None:
                outcome = kind
                break
            # A slide on another surface that this ends is an event of its own.
            ends = [j for j, s in enumerate(mode) if j != hit[0] and s == 0 and after[j] != 0]
            mode = after
            margin.next_piece()
            for event in ((t, hit[0], kind, x), *((t, j, "slip", x) for j in ends[:1])):
                for column, value in zip(events, event, strict=True):
                    column.append(value)
            since = [t > end for _, end in spans[-1:]]
            limit = accumulation(system, *events) if through and all(since) else None
            if limit is not None and limit[1] < t1:
                on, t, x, first = limit
                margin.forget(first)
                spans.append((events[0][first], t))
                after = modes_after(system, x, mode, on, margin)
                if len(after) != 1:
                    outcome = "nonunique" if after else "undecided"
                else:
                    (mode,) = after
                    zeros = [int(j in on and s != 0) for j, s in enumerate(mode)]
    except Degenerate:
        outcome = "degenerate"
    least = 0.0 if outcome == "degenerate" else margin.least
    return Motion(outcome, t, x, mode, *events, least, rate, spans)


def starting_mode(system: Relays, x, margin: Margin):
    """The sides that a motion starts on."""
    h = system.n @ x - system.d
    for normal, value in zip(system.n, h, strict=True):
        margin.near(value, np.linalg.norm(normal) * (speed(x) + 1))
    return tuple(1 if v > 0 else -1 for v in h)


def switched(system: Relays, x, mode, hit, margin: Margin):
    """(mode, orders of the zeros that its guards start from, kind) after a contact; no mode and
    the outcome where none or several go on."""
    j, side = hit
    zeros = [0] * len(mode)
    if mode[j] == 0:
        zeros[j] = 2
        return tuple(side if i == j else s for i, s in enumerate(mode)), zeros, "slip"
    on = [i for i, s in enumerate(mode) if s == 0 or i == j]
    after = modes_after(system, x, mode, on, margin)
    if len(after) != 1:
        return None, zeros, "nonunique" if after else "undecided"
    for i in on:
        zeros[i] = int(after[0][i] != 0)
    now, then = after[0][j], mode[j]
    return after[0], zeros, "stick" if now == 0 else "crossing" if now != then else "graze"


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
                    margin.near(row @ z_at, np.linalg.norm(row) * np.linalg.norm(z_at))
            return t + at, z_at[:-1], (j, side)
        z = (terms * (length ** np.arange(TERMS))[:, None]).sum(axis=0)
        t, first = t + length, False
    return t1, z[:-1], None
