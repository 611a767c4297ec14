"""A solution beside the exact motion of the same problem.

A motion (`relay_motion.Motion`), a solution and a function that makes exact motions of problems a
little aside enter; a verdict leaves. Left out of the comparison are contacts within an
accumulation: of infinitely many each program sees some.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.reliability.verdict import DECIDED, Verdict
from jaxfil import EventKind
from jaxfil.model.outcomes import outcome_names
from tests.oracles.random_problems import random_direction
from tests.oracles.relay_motion import Motion

# Errors allowed, relative to the size of the motion: outright, or times what a change of the
# problem by 1 does to the motion.
ALLOWED, OF_GROWTH = 1e-9, 1e-12
# Rounding, as a change of the problem.
ROUNDED = 1e-14
# After an accumulation: a height of rounding is fallen through in a time of its root.
SLACK = 1e-5


class Lane(NamedTuple):
    """What is compared of a solution."""

    outcome: str
    t: np.ndarray
    x: np.ndarray
    mode: np.ndarray
    count: np.ndarray
    events: Any


def compared(sol):
    """What is compared of a solution, in the order of `Lane`."""
    return sol.result, sol.t_final, sol.x_final, sol.mode_final, sol.num_events, sol.events


def verdicts(exact, problems, motions, sols, room):
    """The verdict on each of a batch of solutions, as `compared`."""
    found = []
    for i, name in enumerate(outcome_names(sols[0])):
        lane = Lane(str(name), *jax.tree.map(lambda v, i=i: v[i], sols[1:]))
        found.append(judge(i, exact, problems[i], motions[i], lane, room))
    return found


def counted(ts, motion: Motion):
    """Which of these times are outside of the accumulations of a motion."""
    spans = [(float(begin), float(end)) for begin, end in motion.spans]
    inside = [(ts > begin - 1e-9) & (ts < end + SLACK) for begin, end in spans]
    return ~np.any([np.zeros(len(ts), bool), *inside], axis=0)


def sure(motion: Motion):
    """Which contacts are compared."""
    return counted(np.asarray(motion.ts, float), motion)


def structure(motion: Motion):
    """What does not change with a small change of the problem."""
    columns = (motion.kinds, motion.surfaces)
    kept = [np.asarray(c)[sure(motion)].tolist() for c in columns]
    return motion.outcome, motion.mode, len(motion.spans), *kept


def values(motion: Motion):
    """The end, and the times of the contacts compared and the states there."""
    before = np.reshape(motion.before, (-1, len(motion.x)))
    return motion.x, np.asarray(motion.ts)[sure(motion)], before[sure(motion)]


def moved(exact, problem, direction, step):
    """The exact motion of everything moved a step along a direction."""
    (system, x0), (by, also) = problem, direction
    bent = type(system)(*(u + np.longdouble(step) * v for u, v in zip(system, by, strict=True)))
    return exact(bent, x0 + np.longdouble(step) * also)


def growth(exact, problem, step=1e-9):
    """What a change of the problem by 1 does to the motion; infinite if a step changes contacts."""
    direction = random_direction(*problem, 0)
    ahead, behind = (moved(exact, problem, direction, s) for s in (step, -step))
    if structure(ahead) != structure(behind):
        return np.inf
    pairs = zip(values(ahead), values(behind), strict=True)
    return 1 + max(float(abs(u - v).max(initial=0)) / (2 * step) for u, v in pairs)


def distance(motion: Motion, lane: Lane):
    """The largest error of the end and of all contacts; infinite where these are others."""
    events, count = lane.events, int(lane.count)
    ts, xs, codes, surfaces = (
        v[:count] for v in (events.ts, events.xs, events.kinds, events.surfaces)
    )
    kept = counted(ts, motion)
    kinds = [EventKind(int(k)).name for k in codes[kept]]
    mode = tuple(lane.mode.tolist())
    if (lane.outcome, mode, len(motion.spans), kinds, surfaces[kept].tolist()) != structure(motion):
        return np.inf
    exact = [np.asarray(v, float) for v in values(motion)]
    size = 1 + max(abs(v).max(initial=0) for v in exact[::2])
    pairs = zip((lane.x, ts[kept], xs[kept]), exact, strict=True)
    return max(abs(u - v).max(initial=0) for u, v in pairs) / size


def judge(number, exact, problem, motion: Motion, lane: Lane, room):
    """The verdict on one solution, whose table had room for so many contacts."""
    decided = motion.margin >= DECIDED
    if lane.outcome == motion.outcome == "successful":
        error = distance(motion, lane)
        if error <= ALLOWED:
            return Verdict(number, "right", error=error)
        grown = growth(exact, problem)
        if error <= OF_GROWTH * grown < 1e-3:
            return Verdict(number, "right", error=error)
        decided &= motion.margin >= ROUNDED * grown
        detail = f"error {error:.1e}, margin {motion.margin:.0e}, growth {grown:.0e}"
        return Verdict(number, "wrong" if decided else "rounding", detail, error)
    detail = f"{lane.outcome} at {float(lane.t):.6g}, exactly {motion.outcome} at "
    detail += f"{float(motion.t):.6g}, margin {motion.margin:.0e}"
    if lane.outcome == "successful":
        return Verdict(number, "wrong" if decided else "rounding", detail)
    crowded = len(motion.ts) > room
    same = motion.outcome != "successful" and abs(float(lane.t) - float(motion.t)) < 1e-7
    told = not decided or crowded or same
    return Verdict(number, "told" if told else "refused", detail)
