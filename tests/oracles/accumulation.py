"""Infinitely many contacts in a finite time: where a spiral into an intersection of surfaces ends.

The contacts so far enter; the surfaces of the intersection, the time and the state where contacts
accumulate, and the number of the first contact near there, leave. Contacts shrink as a geometric
series up to parts of the size of the spiral, so that what is left of one of size s is summed with
an error of s².
"""

import numpy as np

from tests.oracles.relay_modes import Relays

CLOSE, NEAR, LONGEST_ROUND, TINY = 1e-9, 1e-3, 8, 1e-300


def accumulation(system: Relays, ts, surfaces, kinds, states):
    """(surfaces, t, x, first contact near), or None while contacts do not yet accumulate."""
    x = states[-1]
    normals = np.sqrt((system.n * system.n).sum(axis=1))
    size = 1 + np.sqrt((x * x).sum())
    close = np.flatnonzero(abs(system.n @ x - system.d) / normals < CLOSE * size)
    if len(close) < 2:
        return None
    signature = list(zip(surfaces, kinds, strict=True))
    for p in range(2, LONGEST_ROUND + 1):
        if repeats(signature, p):
            steps = [ts[-1 - i * p] - ts[-1 - (i + 1) * p] for i in (0, 1)]
            moves = [states[-1 - i * p] - states[-1 - (i + 1) * p] for i in (0, 1)]
            ratio = steps[0] / max(steps[1], TINY)
            # Half a turn of a symmetric spiral turns round: that is no round.
            shrinks = (moves[0] @ moves[1]) / max(moves[1] @ moves[1], TINY)
            if ratio < 0.99 and abs(shrinks - ratio) < 1e-3:
                rest = ratio / (1 - ratio)
                # A surface that the round meets may not be near yet.
                on = sorted({*close.tolist(), *surfaces[-p:]})
                first = near_from(system, states, on, normals, size)
                return on, ts[-1] + rest * steps[0], x + rest * moves[0], first
    return None


def near_from(system: Relays, states, close, normals, size):
    """The first contact from which on all are near the intersection."""
    away = abs(np.asarray(states) @ system.n.T - system.d)[:, close] / normals[close]
    return int(np.flatnonzero(away.max(axis=1) > NEAR * size).max(initial=-1)) + 1


def repeats(signature, p):
    """Whether the last three rounds of p contacts are alike."""
    tail = signature[-3 * p :]
    return len(tail) == 3 * p and tail[:p] == tail[p : 2 * p] == tail[2 * p :]
