"""Exact motions of linear mechanical systems between impacts, rests and lift-offs.

    q'' = the middle rows of A x + b,   x = (q, v, load),   q_j ≥ d_j for the first m coordinates

A system and an initial state enter; contacts, the state at the end and a margin leave, as of a
relay (`relay_motion.Motion`). An impact sets v_j to -e_j v_j. At rest q_j = d_j and v_j = 0, held
by a reaction on v_j, until the acceleration that it replaces points away from the wall. With an
acceleration a into the wall and the speed v after an impact the flights last 2 v/|a|, e of that, e²
of that: the rest begins after T = 2 v/(|a| (1 - e)), up to T², once T is `SHORT`. Coordinates are
counted from the walls, so that no flight is too low to be told from one of height zero.
"""

from typing import NamedTuple

import numpy as np

from tests.oracles.polynomials import REAL, TERMS, Margin, first_fall, series
from tests.oracles.relay_modes import Degenerate
from tests.oracles.relay_motion import Motion

SHORT, CHATTER = 1e-11, 1e-2


class Walls(NamedTuple):
    """The arrays of a system: x' = a x + b, walls at d with restitutions e."""

    a: np.ndarray
    b: np.ndarray
    d: np.ndarray
    e: np.ndarray


class Flight:
    """A motion under way: where it is, what it rests on, and what has happened."""

    def __init__(self, system: Walls, x0, dof):
        a, b, d, self.e = (np.asarray(v, REAL) for v in system)
        self.m, n = len(d), len(b)
        self.origin = np.append(d, np.zeros(n - self.m, REAL))
        self.free = np.zeros((n + 1, n + 1), REAL)
        self.free[:-1, :-1], self.free[:-1, -1] = a, b + a @ self.origin
        self.velocity = dof + np.arange(self.m)
        self.t, self.z = REAL(0), np.append(np.asarray(x0, REAL) - self.origin, REAL(1))
        self.rests = [False] * self.m
        self.orders = [0] * self.m  # of the zeros that the guards start from
        self.margin, self.spans = Margin(), []
        self.chatters = [None] * self.m  # the contact with which a chattering has begun
        self.events: tuple[list, list, list, list] = ([], [], [], [])

    @property
    def matrix(self):
        """Z of the present mode, z' = Z z."""
        z = self.free.copy()
        z[self.velocity[self.rests]] = 0
        return z

    def push(self, j):
        """The acceleration away from wall j without its reaction."""
        return self.free[self.velocity[j]] @ self.z

    def guards(self):
        """A row for each wall: its distance, or what holds the motion there."""
        one = np.eye(len(self.z), dtype=REAL)
        return [-self.free[self.velocity[j]] if self.rests[j] else one[j] for j in range(self.m)]

    def fly(self, t1):
        """On to the next contact, its wall, or to t1, None."""
        matrix, guards, first = self.matrix, self.guards(), True
        longest = 1 / (np.sqrt((matrix * matrix).sum()) + REAL(1e-3))
        while self.t < t1:
            length, terms, found = min(longest, t1 - self.t), series(matrix, self.z), []
            for j, row in enumerate(guards):
                order = self.orders[j] if first else 0
                p, scale = terms @ row, np.linalg.norm(row) * np.linalg.norm(self.z)
                if order:
                    p = p[order:]
                    scale = np.linalg.norm(row) * np.linalg.norm(terms[order]) + REAL(1e-300)
                    self.margin.near(p[0], scale)
                    if p[0] <= 0:
                        raise Degenerate
                at = first_fall(p, length, scale, self.margin)
                if at is not None:
                    found.append((at, j))
            at, hit = min(found) if found else (length, None)
            self.z = (terms * (at ** np.arange(TERMS))[:, None]).sum(axis=0)
            self.t, first = self.t + at, False
            if hit is not None:
                return hit
        return None

    def note(self, j, kind):
        """A line of the table of contacts."""
        x = self.z[:-1] + self.origin
        for column, value in zip(self.events, (self.t, j, kind, x), strict=True):
            column.append(value)
        self.margin.next_piece()

    def leave(self, j, order):
        """The end of a rest."""
        self.rests[j], self.orders[j] = False, order

    def impact(self, j):
        """The reset at wall j, and what follows from it."""
        v = self.velocity[j]
        others = [i for i in range(self.m) if i != j]
        self.margin.near(self.z[v], np.linalg.norm(self.free[:-1] @ self.z))
        self.note(j, "impact")
        self.z[j], self.z[v] = 0, -self.e[j] * self.z[v]
        self.orders = [int(i == j) for i in range(self.m)]
        for i in others:
            if self.rests[i] and self.signed(i) > 0:
                self.leave(i, 2)
                self.spans.append((self.t, self.t))
        a = self.signed(j)
        if a > 0:
            self.chatters[j] = None
            self.orders[j] = 1 if self.e[j] else 2
            self.spans += [] if self.e[j] else [(self.t, self.t)]
            return
        remaining = 2 * self.z[v] / (-a * (1 - self.e[j]))
        if remaining > CHATTER:
            self.chatters[j] = None
        elif self.chatters[j] is None:
            self.chatters[j] = len(self.events[0]) - 1
        if remaining < SHORT:
            self.come_to_rest(j, remaining)

    def signed(self, j):
        """The push away from wall j, whose sign is about to be used."""
        row = self.free[self.velocity[j]]
        return self.margin(self.push(j), np.linalg.norm(row) * np.linalg.norm(self.z))

    def come_to_rest(self, j, remaining):
        """The impacts that are left, all at once."""
        first = self.chatters[j]
        self.z[self.velocity[j]], self.rests[j], self.orders[j] = 0, True, 0
        terms = series(self.matrix, self.z)
        self.z = (terms * (remaining ** np.arange(TERMS))[:, None]).sum(axis=0)
        self.t += remaining
        self.spans.append((self.events[0][first], self.t))
        # The last approach has a distance of its own before it.
        self.margin.forget(first)
        self.chatters[j] = None


def propagate(system: Walls, x0, dof, t1, most) -> Motion:
    """The motion from x0 at t = 0 to t1, of at most so many contacts."""
    flight, outcome = Flight(system, x0, dof), "successful"
    rate = float(np.sqrt((flight.free**2).sum()))
    try:
        while (hit := flight.fly(REAL(t1))) is not None:
            if len(flight.events[0]) == most:
                outcome = "many"
                break
            if flight.rests[hit]:
                flight.note(hit, "slip")
                flight.orders = [0] * flight.m
                flight.leave(hit, 3)
            else:
                flight.impact(hit)
    except Degenerate:
        outcome = "degenerate"
    mode = tuple(2 if rests else 1 for rests in flight.rests)
    least = 0.0 if outcome == "degenerate" else flight.margin.least
    x = flight.z[:-1] + flight.origin
    return Motion(outcome, flight.t, x, mode, *flight.events, least, rate, flight.spans)
