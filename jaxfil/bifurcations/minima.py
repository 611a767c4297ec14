"""Minima of the guard of a surface on an orbit.

Most are smooth. Where the state or the field jumps, at a tick or at another surface, a guard may be
least without a tangency.
"""

from typing import TypeAlias

import numpy as np

from jaxfil.bifurcations.closure import least_between
from jaxfil.bifurcations.flights import Candidate, Pieces
from jaxfil.bifurcations.tangency import FAMILIES, SLIDE

# The largest number of cubics by which a minimum is narrowed down. Each reduces its distance by the
# square of the angle that the guard turns by in a step, over twelve at least.
_CUBICS = 12
# A value is that of the cubic within this multiple of the rounding of the guard.
_ROUNDINGS = 8

_Both: TypeAlias = tuple[np.ndarray, np.ndarray]


def minima(pieces: Pieces, j: int, kind: str) -> list[Candidate]:
    """Minima of the guard of surface j, with the time in which it would reach zero."""
    modes = np.array([flight.mode[j] for flight in pieces.flights])
    sliding = FAMILIES[kind] == SLIDE
    flown = (modes == 0)[pieces.number] == sliding
    if not np.any(flown):
        return []
    between = _flights_between(pieces)
    abrupt, arrives = _changes(pieces, j, _goes_on(pieces, modes, j, between))
    guards = pieces.first.guards[:, j], pieces.last.guards[:, j]
    rates = _rates_at_start(pieces, j, sliding, between), arrives
    lengths, found = pieces.stops - pieces.starts, []

    def add(k: int, least: float, at: float, minimum: str) -> None:
        flight, most = pieces.flights[pieces.number[k]], pieces.most
        side = np.sign(pieces.first.weights[k, j]) if sliding else flight.mode[j]
        left = at - min(0.5 * (at - flight.start), most)
        right = at + min(0.5 * (flight.stop - at), most)
        found.append(Candidate(least, j, side, flight.mode, left, at, right, minimum=minimum))

    turns = np.flatnonzero(flown & (rates[0] < 0) & (rates[1] >= 0))
    ends = [(v[0][turns], v[1][turns]) for v in (guards, rates)]
    for k, part, least in zip(turns.tolist(), *_lowest(pieces, j, turns, *ends), strict=True):
        add(k, float(least), float(pieces.starts[k] + part * lengths[k]), "smooth")
    for k in np.flatnonzero(flown & abrupt).tolist():
        least = min(guards[1][k], np.roll(guards[0], -1)[k])
        add(k, float(least), float(pieces.stops[k]), "abrupt")
    height = max(float(np.max(v[flown])) for v in guards)
    height = max(height, float(np.finfo(lengths.dtype).tiny))
    # The time of a sine with the guard's amplitude on the whole orbit. Among the minima of all
    # flights the lowest one is first.
    return [
        one._replace(reach=float(np.sqrt(max(one.reach, 0) / height) * pieces.period / np.pi))
        for one in found
    ]


def _lowest(
    pieces: Pieces, j: int, k: np.ndarray, values: _Both, rates: _Both
) -> tuple[np.ndarray, np.ndarray]:
    """Where on pieces of numbers k the guard of surface j is least, as a part of their lengths, and
    its value there, given its values and rates at both ends. A cubic is not accurate enough to
    compare minima of nearly equal height: each is narrowed down to what the orbit itself has."""
    lengths, (low, high) = (pieces.stops - pieces.starts)[k], (np.zeros(k.size), np.ones(k.size))
    rounding = np.finfo(lengths.dtype).eps * max(np.max(abs(v), initial=0) for v in values)
    part, value = low, values[0]
    for _ in range(_CUBICS if k.size else 0):
        # Numbers that differ by rounding may leave a quotient by zero, whose part of a step is 1.
        with np.errstate(divide="ignore"):
            between, expected = least_between((high - low) * lengths, values, rates)
        part = low + between * (high - low)
        there = pieces.at(k, part)
        value, rate = there.guards[:, j], there.rates[:, j]
        # A minimum that is found stays, and one that is between no other two numbers.
        stays = (abs(value - expected) <= _ROUNDINGS * rounding) | (part == low) | (part == high)
        if np.all(stays):
            break
        falls, rises = ~stays & (rate < 0), ~stays & (rate >= 0)
        low, high = np.where(falls, part, low), np.where(rises, part, high)
        values, rates = (
            (np.where(falls, v, pair[0]), np.where(rises, v, pair[1]))
            for v, pair in ((value, values), (rate, rates))
        )
    return part, value


def _flights_between(pieces: Pieces) -> dict[int, np.ndarray]:
    """The flights that end between a piece and the next one, for each piece with such ones. Several
    contacts at one time have flights without pieces between them."""
    number, count = pieces.number, len(pieces.flights)
    after = np.roll(number, -1)
    ends = after != number
    ends[-1] = np.isfinite(pieces.flights[0].start)
    return {
        k: (number[k] + np.arange((after[k] - number[k] - 1) % count + 1)) % count
        for k in np.flatnonzero(ends).tolist()
    }


def _reaches(pieces: Pieces, j: int, passed: np.ndarray) -> bool:
    """Whether one of these flights ends on surface j."""
    return any(pieces.flights[i].surfaces[j] for i in passed)


def _goes_on(
    pieces: Pieces, modes: np.ndarray, j: int, between: dict[int, np.ndarray]
) -> np.ndarray:
    """Whether each piece is followed by one of the same flight, or there is only a contact with
    another surface between them; given the mode of surface j on each flight."""
    after = np.roll(pieces.number, -1)
    goes_on = np.ones(after.size, bool)
    for k, passed in between.items():
        stays = bool(np.all(modes[passed] == modes[after[k]]))
        goes_on[k] = stays and not _reaches(pieces, j, passed)
    return goes_on


def _rates_at_start(
    pieces: Pieces, j: int, sliding: bool, between: dict[int, np.ndarray]
) -> np.ndarray:
    """The rate of the guard of surface j at the start of each piece. A flight that leaves the
    surface rises from it: where the rate is zero, as at the end of a slide, its sign is
    rounding."""
    rates, guards = pieces.first.rates[:, j], pieces.first.guards[:, j]
    leaves = np.zeros(rates.size, bool)
    for k, passed in between.items():
        leaves[(k + 1) % rates.size] = not sliding and _reaches(pieces, j, passed)
    # A reset may put the motion somewhere else.
    rounding = np.finfo(guards.dtype).eps ** 0.5
    leaves = leaves & (abs(guards) <= rounding * np.max(abs(guards)))
    return np.where(leaves, np.maximum(rates, 0), rates)


def _changes(pieces: Pieces, j: int, goes_on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether a guard is least, without a tangency, where a piece and the next one meet, because it
    jumps there or its rate does; and its rate at the end of each piece, of the next one where
    nothing jumps, so that a zero of it is in one piece."""
    guard, rate = pieces.last.guards[:, j], pieces.last.rates[:, j]
    after, leaves = (np.roll(v[:, j], -1) for v in (pieces.first.guards, pieces.first.rates))
    rounding = np.finfo(guard.dtype).eps ** 0.5
    higher, lower = (
        goes_on & (sign * (after - guard) > rounding * np.max(abs(guard))) for sign in (1, -1)
    )
    bends = abs(leaves - rate) > rounding * np.max(abs(rate))
    jumps = higher | lower | ~goes_on
    falls, rises = rate < 0, leaves >= 0
    abrupt = np.where(higher, falls, np.where(lower, rises, falls & rises & bends))
    return goes_on & abrupt, np.where(jumps | bends, rate, leaves)
