"""Exact motions of masses with dry friction, walls, impacts and rest.

A `Machine` (`contact_modes`), an initial state (q, v, u) and an end of time enter; a `Motion`
leaves, or `Uncertain` is raised where the motion is within rounding of another one. Between events
each mode is a linear system (`linear_flow`). An impact on a wall takes v to

    v − (1 + e) γ M⁻¹a / (aᵀ M⁻¹ a),    γ = a·v < 0;

of several walls the lowest number comes first, until the motion runs into none. Rebounds slower
than `SLOW`, whose height is rounding, are taken away as one impact more would: what a chattering
still does besides is of the order of their square.
"""

from typing import NamedTuple

import numpy as np

from tests.oracles.contact_modes import ORDERS, Machine, Modes
from tests.oracles.linear_flow import CLOSE, Uncertain

SLOW = 5e-8
# What a state on its contacts is off them, at most.
TOUCH = 1e-10
# A relative velocity or gap below this is zero but for rounding.
ROUNDED = 1e-12
MOST = 4000


class Event(NamedTuple):
    """A line of the table of contacts; walls are counted after frictions."""

    t: float
    kind: str
    contact: int


class Motion(NamedTuple):
    """Where it ends, and what happened."""

    x: np.ndarray
    mode: tuple[int, ...]
    events: list[Event]
    size: float
    """The largest component that was seen."""


class Walk:
    """A motion under way."""

    def __init__(self, machine: Machine, x0, slow=SLOW, most=MOST):
        self.modes, self.machine, self.slow, self.most = Modes(machine), machine, slow, most
        self.t, self.z = 0.0, np.concatenate([x0, [0.0, 1.0]])
        self.events, self.size = [], float(abs(self.z).max())
        self.mode, self.orders = (1,) * (self.modes.rubs + self.modes.walls), None
        self.pinned = set()  # contacts whose guards stay zero

    @property
    def x(self):
        """The state."""
        return self.z[:-2]

    def begin(self):
        """The mode at the start."""
        gaps = self.modes.gap @ self.z
        if gaps.min(initial=0) < -ROUNDED:
            raise Uncertain("it starts beyond a wall")
        self.go_on(set(np.flatnonzero(gaps < ROUNDED) + self.modes.rubs))

    def run(self, t1):
        """On to t1."""
        while True:
            if len(self.events) > self.most:
                raise Uncertain("too many events")
            flow, contacts = self.modes.flow(self.mode)
            hit = flow.fly(self.z, self.t, t1, self.orders)
            self.t, self.z = hit.t, hit.z
            self.size = max(self.size, float(abs(self.x).max()))
            if hit.guard is None:
                return
            if t1 - self.t < CLOSE:
                raise Uncertain("an event at the end")
            self.switch(contacts[hit.guard])

    def switch(self, contact):
        """A guard of a contact has fallen to zero."""
        k, rubs = contact - self.modes.rubs, self.modes.rubs
        touched = {j for j in range(rubs, len(self.mode)) if self.mode[j] == 2 or j in self.pinned}
        if k >= 0 and self.mode[contact] == 1:
            touched.add(contact)
        self.go_on(touched | {contact} if k >= 0 else touched, contact if k < 0 else None)

    def go_on(self, touched, rub=None):
        """Impacts on the walls that are touched, and the mode after them; `rub` is a friction whose
        guard has fallen to zero."""
        rubs, before = self.modes.rubs, self.mode
        self.impacts(sorted(j - rubs for j in touched))
        on, mode = self.stilled(touched), list(before)
        for j, w in enumerate(self.modes.slip @ self.z):
            least = TOUCH if j in self.pinned else ROUNDED * (1 + self.size)
            if j == rub or abs(w) < least:
                on.add(j)
            elif abs(w) < CLOSE and before[j] == 0:
                raise Uncertain("a velocity is within rounding")
            else:
                mode[j] = 1 if w > 0 else -1
        for j in touched - on:
            mode[j] = 1
        self.hold(on, touched)
        self.mode, orders = self.modes.decide(self.z, tuple(mode), on)
        _, contacts = self.modes.flow(self.mode)
        # A wall that throws back is left with a velocity.
        thrown = {j for j in touched if j not in on}
        self.orders = [
            1 if j in thrown else None if order == ORDERS else order
            for j, order in zip(contacts, orders, strict=True)
        ]
        self.pinned = {j for j, order in zip(contacts, self.orders, strict=True) if order is None}
        self.note(before)

    def stilled(self, touched):
        """Walls that are left too slowly to be left; their rates are taken away."""
        rubs, n, m = self.modes.rubs, self.modes.n, self.machine
        on = {j for j in touched if self.modes.rate[j - rubs] @ self.z < self.slow}
        if on:
            rows = m.walls[[j - rubs for j in on]]
            rates = self.modes.rate[[j - rubs for j in on]] @ self.z
            gains = rows @ self.modes.mobility @ rows.T
            self.z = self.z.copy()
            push = np.linalg.lstsq(gains, rates, rcond=1e-10)[0]
            self.z[n : 2 * n] -= self.modes.mobility @ rows.T @ push
        return on

    def note(self, before):
        """Lines of the table of contacts."""
        for j, (old, new) in enumerate(zip(before, self.mode, strict=True)):
            if old != new:
                kind = "stick" if new in (0, 2) else "slip" if old in (0, 2) else "crossing"
                self.events.append(Event(self.t, kind, j))

    def impacts(self, walls):
        """Impacts on walls until the motion runs into none of them."""
        n, m, count = self.modes.n, self.machine, 0
        least = 1e-14 * (1 + abs(self.z).max())
        while True:
            rates = self.modes.rate @ self.z
            due = [k for k in walls if rates[k] < -least]
            if not due:
                return
            k, count = due[0], count + 1
            if count > 3000:
                raise Uncertain("impacts without an end")
            direction = self.modes.mobility @ m.walls[k]
            push = (1 + m.restitutions[k]) * rates[k] / (m.walls[k] @ direction)
            self.z = self.z.copy()
            self.z[n : 2 * n] -= push * direction
            self.events.append(Event(self.t, "impact", self.modes.rubs + k))

    def hold(self, on, touched):
        """The state exactly on its contacts: rounding must not add up."""
        n, rubs, modes = self.modes.n, self.modes.rubs, self.modes
        walls, slips = [j - rubs for j in on if j >= rubs], [j for j in on if j < rubs]
        gaps = [j - rubs for j in touched]
        rows = np.vstack([modes.slip[slips], modes.rate[walls]])
        self.z = self.z.copy()
        if len(rows):
            change = np.linalg.pinv(rows[:, n : 2 * n]) @ (rows @ self.z)
            self.small(change)
            self.z[n : 2 * n] -= change
        if gaps:
            change = np.linalg.pinv(modes.gap[gaps, :n]) @ (modes.gap[gaps] @ self.z)
            self.small(change)
            self.z[:n] -= change

    def small(self, change):
        """Only rounding may be taken away."""
        if abs(change).max() > TOUCH:
            raise Uncertain("it is not on its contacts")


def propagate(machine: Machine, x0, t1, slow=SLOW, most=MOST) -> Motion:
    """The motion from x0 at t = 0 to t1."""
    walk = Walk(machine, x0, slow, most)
    walk.begin()
    walk.run(t1)
    return Motion(walk.x, walk.mode, walk.events, walk.size)
