"""Chattering on orbits: infinitely many impacts that end in rest count as one event.

The number of these impacts that are integrated one by one depends on rounding, and is ignored when
the contacts of two neighbouring orbits are compared.
"""

import dataclasses
from collections import Counter

import numpy as np

from jaxfil.integrate.run.solution import Events, switches

# Times of one contact on two neighbours differ by less than this fraction of the period.
_SAME_TIME = 1e-5
# The last impacts of a chattering, whose number is rounding, are nearer to its rest than this
# fraction of the period.
_LAST_IMPACTS = 1e-5

_Contact = tuple[tuple[int, ...], tuple[int, ...]]
"""The surfaces of a contact, and the modes after it, as in `contacts_of`."""


@dataclasses.dataclass(frozen=True)
class _Group:
    """A contact, or a rest with the impacts before it, and the times of all of these."""

    contact: _Contact
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
    starts = [i + 1 for i, (contact, _) in enumerate(first) if _is_rest(contact)]
    if not starts:
        return False
    groups = _groups(first, starts[0], period)
    others = (i + 1 for i, (contact, _) in enumerate(second) if _is_rest(contact))
    return any(_agree(groups, _groups(second, i, period), period) for i in others)


def _contacts(events: Events) -> list[tuple[_Contact, float]]:
    """Each contact that is not a graze, and its time."""
    members, modes, ts = (np.asarray(v) for v in (events.members, events.modes, events.ts))
    return [
        ((tuple(np.flatnonzero(members[i]).tolist()), tuple(modes[i].tolist())), float(ts[i]))
        for i in switches(events)
    ]


def _is_rest(contact: _Contact) -> bool:
    return bool(rests_in((contact,)))


def _groups(contacts: list[tuple[_Contact, float]], start: int, period: float) -> list[_Group]:
    """The contacts of a period from number `start` on, at increasing times, impacts with their
    rest."""
    in_order = contacts[start:] + [(contact, t + period) for contact, t in contacts[:start]]
    groups: list[_Group] = []
    for contact, t in in_order:
        times = [t]
        surfaces, _ = contact
        if _is_rest(contact):
            while groups and not _is_rest(groups[-1].contact):
                surfaces_before, modes_before = groups[-1].contact
                if surfaces_before != surfaces or any(modes_before[j] == 0 for j in surfaces):
                    break  # another surface, or the end of a slide or a rest
                times = groups.pop().times + times
        groups.append(_Group(contact, times))
    return groups


def _agree(a: list[_Group], b: list[_Group], period: float) -> bool:
    """Whether both have the same contacts at the same times."""
    if [group.contact for group in a] != [group.contact for group in b]:
        return False
    return all(_same_times(p.times, q.times, period) for p, q in zip(a, b, strict=True))


def _same_times(a: list[float], b: list[float], period: float) -> bool:
    """Whether times of one contact, or of impacts and their rest, are the same."""
    short, long = sorted((a, b), key=len)
    common = len(short) - 1  # impacts followed in both, before the rest
    # Each list begins after a rest of its own orbit, so that they may be whole periods apart.
    offset = period * round((long[-1] - short[-1]) / period)
    pairs = [*zip(short[:common], long[:common], strict=True), (short[-1], long[-1])]
    apart = max(abs(q - p - offset) for p, q in pairs)
    # Impacts followed in the longer list alone belong to the rest itself in the other one, if they
    # are as near to it as those that are not followed.
    remainder = long[-1] - min(long[common:])
    return apart <= _SAME_TIME * period and remainder <= _LAST_IMPACTS * period
