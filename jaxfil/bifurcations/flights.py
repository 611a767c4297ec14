"""The steps of an orbit, its flights between contacts, and candidates of tangencies on them."""

import dataclasses
import functools as ft
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.loop.extremes import cubics_of
from jaxfil.integrate.run.solution import Dense, evaluate, switches
from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.known import array_of, power_of_two


@dataclasses.dataclass(frozen=True)
class Steps:
    """The times ts (k,) and states xs (k, n) of all steps of an orbit, and of the parts of a step
    of a series, which may be as long as the period."""

    orbit: Orbit
    ts: np.ndarray
    xs: np.ndarray

    @property
    def period(self) -> float:
        """The period."""
        return float(self.orbit.period)

    @property
    def sizes(self) -> np.ndarray:
        """The largest size of each component; 1 for one that is zero."""
        sizes = np.max(abs(self.xs), axis=0)
        return np.where(sizes == 0, 1, sizes)


class Candidate(NamedTuple):
    """A tangency of surface j from a side in a mode, at time `middle` of a flight from `left` to
    `right`; `reach` is the time by which the orbit misses it. `struck` as in `Tangency`.
    A minimum of the guard is "smooth", or "abrupt" at a tick or a contact with another surface,
    where it is no tangency."""

    reach: float
    j: int
    side: float
    mode: np.ndarray
    left: float
    middle: float
    right: float
    struck: bool = False
    minimum: str = ""


@dataclasses.dataclass(frozen=True)
class Flight:
    """A stretch of an orbit in one mode, in times that may pass the end of the period."""

    start: float
    stop: float
    mode: np.ndarray
    surfaces: np.ndarray  # the surfaces of the contact at its end
    x: np.ndarray  # the state just before this contact


def flights_of(orbit: Orbit) -> list[Flight]:
    """The orbit cut at its contacts; an orbit without contacts is one endless flight."""
    t0, period = float(orbit.options.t0), float(orbit.period)
    first = np.asarray(orbit.first_mode).astype(float)
    events = orbit.events
    # A graze does not end a flight.
    ends = switches(events)
    count = ends.size
    if events is None or count == 0:
        x = np.full(orbit.x0.shape, np.nan)
        return [Flight(-np.inf, np.inf, first, np.zeros(first.shape, bool), x)]
    ts = np.asarray(events.ts)[ends]
    # An orbit at a bifurcation has the contacts of its neighbour, which may start elsewhere.
    ts = np.where((ts < t0) | (ts > t0 + period), t0 + np.mod(ts - t0, period), ts)
    ends, ts = ends[np.argsort(ts, kind="stable")], np.sort(ts)
    modes = np.asarray(events.modes)[ends].astype(float)
    # The contact at the end of each flight.
    members = np.roll(np.asarray(events.members)[ends], -1, axis=0)
    xs = np.roll(np.asarray(events.xs)[ends], -1, axis=0)
    stops = np.append(ts[1:], ts[0] + period)
    return [Flight(ts[i], stops[i], modes[i], members[i], xs[i]) for i in range(count)]


def steps_of(orbit: Orbit) -> Steps:
    """The steps of an orbit."""
    dense = orbit.dense()
    real = np.isfinite(np.asarray(dense.ts))
    ts, xs = np.asarray(dense.ts)[real], np.asarray(dense.xs)[real]
    count = cubics_of(tableau_of(dense.stepper))
    if count == 1:
        return Steps(orbit, ts, xs)
    lengths = np.diff(ts, append=ts[-1])
    divided = ts[:, None] + lengths[:, None] * (np.arange(count) / count)
    states = np.array(_states(dense, filled(divided.ravel())))[: divided.size]
    states = states.reshape(*divided.shape, -1)
    states[:, 0] = xs
    # A step of length zero, a jump, has no parts.
    parts = (np.arange(count) == 0) | (lengths[:, None] > 0)
    return Steps(orbit, divided[parts], states[parts])


@eqx.filter_jit
def _states(dense: Dense, ts: Array) -> Array:
    """The states at many times."""
    return jax.vmap(ft.partial(evaluate, dense))(ts)


def filled(rows: np.ndarray) -> Array:
    """Rows padded with the last one to a power of two."""
    return array_of(rows[np.minimum(np.arange(power_of_two(len(rows))), len(rows) - 1)])
