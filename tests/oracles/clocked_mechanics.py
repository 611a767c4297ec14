"""Exact motions of masses with friction and walls whose forces and states jump at known times.

A `Machine` and `Jump`s enter; a `Motion` leaves (`mechanics`). Between two of these times the
motion is that of a machine with constant forces.
"""

from typing import NamedTuple

import numpy as np

from tests.oracles.contact_modes import Machine, Modes
from tests.oracles.linear_flow import CLOSE, Uncertain
from tests.oracles.mechanics import Motion, Walk


class Jump(NamedTuple):
    """At a time x becomes A x + b, and the constant force another one."""

    t: float
    matrix: np.ndarray
    shift: np.ndarray
    constant: np.ndarray


def propagate(machine: Machine, jumps: list[Jump], x0, t1) -> Motion:
    """The motion from x0 at t = 0 to t1; the jumps are in the order of their times."""
    times = np.array([0.0, *(jump.t for jump in jumps), t1])
    if np.diff(times).min() < 1e-6:
        raise Uncertain("two jumps at once")
    walk, modes = Walk(machine, x0), {}
    walk.begin()
    for jump in jumps:
        walk.run(jump.t)
        key = jump.constant.tobytes()
        if key not in modes:
            modes[key] = Modes(machine._replace(constant=jump.constant))
        walk.modes = modes[key]
        jumped(walk, jump)
    walk.run(t1)
    return Motion(walk.x, walk.mode, walk.events, walk.size)


def jumped(walk: Walk, jump: Jump):
    """The state after a jump, and the mode that goes on."""
    rubs, before = walk.modes.rubs, walk.mode
    touched = {j for j in range(rubs, len(before)) if before[j] == 2 or j in walk.pinned}
    walk.t = jump.t  # known better than by what the time has been added up from
    walk.z = np.concatenate([jump.matrix @ walk.x + jump.shift, [jump.t, 1.0]])
    gaps = walk.modes.gap @ walk.z
    if any(gaps[j - rubs] < CLOSE for j in range(rubs, len(before)) if j not in touched):
        raise Uncertain("an event with a jump")
    slips = [j for j in range(rubs) if before[j] and j not in walk.pinned]
    if abs(walk.modes.slip[slips] @ walk.z).min(initial=1) < CLOSE:
        raise Uncertain("an event with a jump")
    walk.go_on(touched)
