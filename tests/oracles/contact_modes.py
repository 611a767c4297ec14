"""Modes of masses with dry friction and walls, each a linear system, and which of them goes on.

A `Machine` enters; for each mode its `Flow`, and for a state on surfaces the mode in which all
conditions hold just afterwards, leave. The state is z = (q, v, u, t, 1), u a load that is linear
itself, as a harmonic is, or a signal that is held.

Of a mode a friction is +1 or −1 (slips, by the sign of its relative velocity) or 0 (sticks), a wall
1 (off) or 2 (rested on). All combinations on the surfaces are tried. The conditions are guards that
must not be negative: |force| ≤ F of what sticks, reaction ≥ 0 of what rests, the relative velocity
of what slips and the gap of what is off. Of a guard that is zero, its first derivative that is not
counts, which settles ties.
"""

import itertools
from typing import NamedTuple

import numpy as np

from tests.oracles.linear_flow import Flow, Uncertain

# Derivatives of a guard that are looked at; below ZERO one is zero, above CLEAR its sign is known.
ORDERS, ZERO, CLEAR = 6, 1e-11, 3e-9


class Machine(NamedTuple):
    """M v' = −K q − C v + p + L u + Σ_j d_j (−F_j s_j + μ_j w_j) + reactions a_k λ_k, with relative
    velocities w = D v − b − b' t of frictions, gaps A q − c ≥ 0 of walls, and u' = S u + r."""

    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    constant: np.ndarray
    load: np.ndarray
    drive: np.ndarray
    """S."""
    drift: np.ndarray
    """r."""
    rubs: np.ndarray
    """D, a row for each friction."""
    limits: np.ndarray
    """F."""
    falls: np.ndarray
    """μ: how fast friction falls with the relative velocity."""
    belts: np.ndarray
    """b and b', a row for each friction."""
    walls: np.ndarray
    """A, a row for each wall."""
    places: np.ndarray
    """c."""
    restitutions: np.ndarray


class Modes:
    """All modes of a machine."""

    def __init__(self, machine: Machine):
        self.machine = m = machine
        n = self.n = len(m.mass)
        self.rubs, self.walls = len(m.rubs), len(m.walls)
        self.size = size = 2 * n + len(m.drift) + 2
        self.mobility = np.linalg.inv(m.mass)
        # Rows over z: relative velocities, gaps, and forces without those of contacts.
        self.slip = np.zeros((self.rubs, size))
        self.slip[:, n : 2 * n], self.slip[:, -1], self.slip[:, -2] = (
            m.rubs,
            -m.belts[:, 0],
            -m.belts[:, 1],
        )
        self.gap = np.zeros((self.walls, size))
        self.gap[:, :n], self.gap[:, -1] = m.walls, -m.places
        self.force = np.zeros((n, size))
        self.force[:, :n], self.force[:, n : 2 * n] = -m.stiffness, -m.damping
        self.force[:, 2 * n : -2], self.force[:, -1] = m.load, m.constant
        self.force += m.rubs.T @ (m.falls[:, None] * self.slip)
        self.rate = np.zeros((self.walls, size))
        self.rate[:, n : 2 * n] = m.walls
        self._flows = {}

    def flow(self, mode) -> tuple[Flow, list[int]] | None:
        """Of a mode, with the contact of each guard (walls are counted after frictions). None where
        its forces are not unique: some of them can then be at their limits in another mode."""
        if mode not in self._flows:
            self._flows[mode] = self._made(mode)
        return self._flows[mode]

    def _made(self, mode):
        m, n, size = self.machine, self.n, self.size
        sticks = [j for j in range(self.rubs) if mode[j] == 0]
        rests = [k for k in range(self.walls) if mode[self.rubs + k] == 2]
        force = self.force.copy()
        for j in range(self.rubs):
            force[:, -1] -= m.rubs[j] * m.limits[j] * mode[j]
        held = np.vstack([m.rubs[sticks], m.walls[rests]])
        wanted = np.zeros((len(held), size))
        wanted[: len(sticks), -1] = m.belts[sticks, 1]
        push = np.zeros((0, size))
        if len(held):
            delassus = held @ self.mobility @ held.T
            if np.linalg.cond(delassus) > 1e8:
                return None
            push = np.linalg.solve(delassus, wanted - held @ self.mobility @ force)
            force = force + held.T @ push
        matrix = np.zeros((size, size))
        matrix[:n, n : 2 * n] = np.eye(n)
        matrix[n : 2 * n] = self.mobility @ force
        matrix[2 * n : -2, 2 * n : -2], matrix[2 * n : -2, -1] = m.drive, m.drift
        matrix[-2, -1] = 1
        guards, contacts = [], []
        for j in range(self.rubs):
            if mode[j]:
                guards.append(mode[j] * self.slip[j])
                contacts.append(j)
                continue
            most = np.zeros(size)
            most[-1] = m.limits[j]
            one = push[sticks.index(j)]
            guards += [most - one, most + one]
            contacts += [j, j]
        for k in range(self.walls):
            resting = mode[self.rubs + k] == 2
            guards.append(push[len(sticks) + rests.index(k)] if resting else self.gap[k])
            contacts.append(self.rubs + k)
        return Flow(matrix, np.array(guards).reshape(-1, size)), contacts

    def decide(self, z, mode, on):
        """The mode that goes on from a state on some contacts (it is that of `mode` on others), and
        the orders of the zeros that its guards start from: `ORDERS` where a guard stays zero, as
        the gap of a mass that friction holds beside a wall."""
        choices = [
            ((0, 1, -1) if j < self.rubs else (2, 1)) if j in on else (mode[j],)
            for j in range(len(mode))
        ]
        held, unclear = [], False
        for candidate in itertools.product(*choices):
            told, orders = self._holds(z, candidate, on)
            unclear |= told is None
            if told:
                held.append((candidate, orders))
        if unclear:
            raise Uncertain("a condition is within rounding")
        if not held:
            raise Uncertain("no mode goes on")
        if len(held) > 1:
            firsts = [self.flow(c)[0].series(z, ORDERS) for c, _ in held]
            if any(abs(s - firsts[0]).max() > 1e-9 * (1 + abs(s).max()) for s in firsts):
                raise Uncertain("several modes go on")
        return held[0]

    def _holds(self, z, mode, on):
        """Whether all guards of contacts in `on` stay positive: None if that is within rounding."""
        if self.flow(mode) is None:
            return False, []
        flow, contacts = self.flow(mode)
        terms = flow.series(z, ORDERS)
        told, orders = True, []
        for row, j in zip(flow.guards, contacts, strict=True):
            if j not in on:
                orders.append(0)
                continue
            known = (1 if j < self.rubs else 2) if abs(mode[j]) == 1 else 0
            values = terms @ row
            size = 1 + (abs(terms) @ abs(row)).max()
            values[:known] = 0
            order = next((k for k, v in enumerate(values) if abs(v) > ZERO * size), ORDERS)
            orders.append(order)
            if order == ORDERS:
                continue
            if abs(values[order]) < CLEAR * size:
                told = None if told is not False else False
            elif values[order] < 0:
                told = False
        return told, orders
