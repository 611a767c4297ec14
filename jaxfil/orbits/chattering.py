"""Chattering on orbits: infinitely many impacts that end in rest count as one event.

The number of these impacts that are integrated one by one depends on rounding, and is ignored when
the contacts of two neighbouring orbits are compared.
"""

import dataclasses
from collections import Counter

import numpy as np

from jaxfil.integrate.run.solution import Events, switches

# Tolerance of times of the same contact on two neighbours, and the remainder of a chattering whose
# rest is completed, as fractions of the period.
_SAME = 1e-5


@dataclasses.dataclass(frozen=True)
class _Group:
    """A contact, or a rest with the impacts before it."""

    what: tuple
    times: list[float]


def rests_in(sequence: tuple) -> Counter:
    """How often each surface begins to be rested on, in contacts of the form of `contacts_of`."""
    return Counter(j for surfaces, modes in sequence for j in surfaces if abs(modes[j]) == 2)


def differ_by_chattering(a: Events | None, b: Events | None, period: float) -> bool:
    """Whether contacts of two orbits are the same except for the number of the last impacts before
    rests, whose heights are rounding."""
    if a is None or b is None:
        return False
    first, second = _contacts(a), _contacts(b)
    starts = [i + 1 for i, (what, _) in enumerate(first) if _is_rest(what)]
    if not starts:
        return False
    groups = _groups(first, starts[0], period)
    others = (i + 1 for i, (what, _) in enumerate(second) if _is_rest(what))
    return any(_agree(groups, _groups(second, i, period), period) for i in others)


def _contacts(events: Events) -> list[tuple[tuple, float]]:
    """Surfaces and modes after of each contact, and its time."""
    members, modes, ts = (np.asarray(v) for v in (events.members, events.modes, events.ts))
    return [
        ((tuple(np.flatnonzero(members[i]).tolist()), tuple(modes[i].tolist())), float(ts[i]))
        for i in switches(events)
    ]


def _is_rest(what: tuple) -> bool:
    return bool(rests_in((what,)))


def _groups(contacts: list[tuple[tuple, float]], start: int, period: float) -> list[_Group]:
    """The contacts from number `start` on, at increasing times, impacts with their rest."""
    turned = contacts[start:] + [(what, t + period) for what, t in contacts[:start]]
    groups: list[_Group] = []
    for what, t in turned:
        times = [t]
        if _is_rest(what):
            while groups and groups[-1].what[0] == what[0] and not _is_rest(groups[-1].what):
                if any(groups[-1].what[1][j] == 0 for j in what[0]):
                    break  # the slide or the rest has ended here
                times = groups.pop().times + times
        groups.append(_Group(what, times))
    return groups


def _agree(a: list[_Group], b: list[_Group], period: float) -> bool:
    if [group.what for group in a] != [group.what for group in b]:
        return False
    return all(_same_times(p.times, q.times, period) for p, q in zip(a, b, strict=True))


def _same_times(a: list[float], b: list[float], period: float) -> bool:
    """Whether times are the same; for chattering, as far as both are recorded."""
    short, long = sorted((a, b), key=len)
    common, shift = len(short) - 1, period * round((long[-1] - short[-1]) / period)
    pairs = [*zip(short[:common], long[:common], strict=True), (short[-1], long[-1])]
    apart = [abs(q - p - shift) for p, q in pairs] + [long[-1] - t for t in long[common:]]
    return max(apart) <= _SAME * period
