"""Exact motions of integrate-and-fire neurons that kick each other.

A `Network`, an initial state and an end of time enter; the state there and what has fired leave.
Between events v_i' = I_i − g_i v_i. A neuron that reaches 1 is set to 0 and kicks the others by its
row of weights; of all that are beyond 1 the one with the lowest number fires next. At the ticks of
a clock all neurons are kicked at once.
"""

from typing import NamedTuple

import numpy as np

from tests.oracles.linear_flow import CLOSE, Uncertain


class Network(NamedTuple):
    """Currents I, leaks g, weights (how far i kicks j), and a clock with what it kicks by."""

    currents: np.ndarray
    leaks: np.ndarray
    weights: np.ndarray
    period: np.ndarray
    phase: np.ndarray
    kicks: np.ndarray


def propagate(network: Network, v, t1, most=2000):
    """The state at t1 and a list of (time, neuron) of all that has fired."""
    t, fired = 0.0, []
    first, last = ((end - network.phase) / network.period for end in (0, t1))
    ticks = network.phase + network.period * np.arange(np.floor(first), last + 1)
    ticks = [float(tick) for tick in ticks if 0 < tick < t1] + [t1]
    while ticks:
        spans = reached(network, v)
        first = int(np.argmin(spans))
        at = t + spans[first]
        if abs(at - ticks[0]) < CLOSE or np.sum(spans < spans[first] + CLOSE) > 1:
            raise Uncertain("two events at once")
        if at < ticks[0]:
            v = flown(network, v, spans[first])
            v[first], t = 1.0, at
        else:
            v, t = flown(network, v, ticks[0] - t), ticks.pop(0)
            if not ticks:
                return v, fired
            v = v + network.kicks
        v = settled(network, v, t, fired)
        if len(fired) > most:
            raise Uncertain("too many events")
    raise AssertionError


def flown(network, v, span):
    """The state a time later, without events."""
    rest = network.currents / network.leaks
    return rest + (v - rest) * np.exp(-network.leaks * span)


def reached(network, v):
    """The time after which each neuron would reach 1."""
    rest = network.currents / network.leaks
    with np.errstate(divide="ignore", invalid="ignore"):
        spans = np.log((rest - v) / (rest - 1)) / network.leaks
    return np.where(rest > 1, spans, np.inf)


def settled(network, v, t, fired):
    """The state when none is left to fire."""
    v = v.copy()
    for _ in range(1000):
        if np.any((abs(v - 1) < CLOSE) & (v != 1)):
            raise Uncertain("a kick that just reaches")
        beyond = np.flatnonzero(v >= 1)
        if not len(beyond):
            return v
        i = int(beyond[0])
        fired.append((t, i))
        v[i] = 0.0
        v += network.weights[i]
    raise Uncertain("an avalanche without an end")
