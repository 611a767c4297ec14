"""Random masses with clocks and timers, and neurons, as numbers and as users' systems.

A seed and a kind enter. The numbers that `clocked_mechanics` or `avalanches` moves exactly and a
`System` of the package, with an initial state, leave. The kinds are forces that a clock switches,
kicks at ticks, a force that is sampled and held, one that a timer switches, and neurons.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from tests.oracles.avalanches import Network
from tests.oracles.clocked_mechanics import Jump
from tests.oracles.mechanical_problems import (
    T1,
    MechanicalSystem,
    WalledSystem,
    numbers_of,
    random_machine,
)


class Switched(WalledSystem):
    """A force that a clock switches between + and −."""

    interval: jax.Array
    phase: jax.Array
    amplitude: jax.Array

    def vector_field(self, t, x, side):
        n = len(self.constant)
        count = jnp.floor((t - self.phase) / self.interval)
        sign = jnp.where(jnp.mod(count, 2) == 0, 1.0, -1.0)
        pushed = super().vector_field(t, x, side)
        return pushed.at[n : 2 * n].add(sign * (self.mobility @ self.amplitude))

    @property
    def clocks(self):
        return (jf.Clock(self.interval, self.phase),)


class Kicked(WalledSystem):
    """Two clocks that each kick the velocities."""

    interval: jax.Array
    phase: jax.Array
    kicks: jax.Array

    def tick(self, t, x, clock):
        n = len(self.constant)
        return x.at[n : 2 * n].add(self.kicks[clock])

    @property
    def clocks(self):
        return tuple(jf.Clock(self.interval[c], self.phase[c]) for c in range(2))


class Held(WalledSystem):
    """A controller: the last of the load's states is a force that is sampled and held."""

    interval: jax.Array
    phase: jax.Array
    gains: jax.Array

    def tick(self, t, x, clock):
        return x.at[-1].set(self.gains @ x[: 2 * len(self.constant)])

    @property
    def clocks(self):
        return (jf.Clock(self.interval, self.phase),)


class Timed(WalledSystem):
    """The last two of the load's states are a timer and the sign of a force, which it turns over
    when it has run to its limit. Its surface is the last one."""

    limit: jax.Array

    def switching(self, t, x):
        return jnp.append(super().switching(t, x), self.limit - x[-2])

    def reset(self, t, x, surface):
        last = len(self.limits) + len(self.places)
        turned = x.at[-2].set(0.0).at[-1].multiply(-1.0)
        return jnp.where(
            surface == last, turned, super().reset(t, x, jnp.minimum(surface, last - 1))
        )


class Neurons(jf.System):
    """A `Network`."""

    currents: jax.Array
    leaks: jax.Array
    weights: jax.Array
    interval: jax.Array
    phase: jax.Array
    kicks: jax.Array
    slides = False

    def vector_field(self, t, x, side):
        return self.currents - self.leaks * x

    def switching(self, t, x):
        return 1 - x

    def reset(self, t, x, surface):
        return x.at[surface].set(0.0) + self.weights[surface]

    def tick(self, t, x, clock):
        return x + self.kicks

    @property
    def clocks(self):
        return (jf.Clock(self.interval, self.phase),)


KINDS = {"switched": Switched, "kicked": Kicked, "held": Held, "timed": Timed}


def random_clocked(seed, kind, masses, rubs, walls):
    """The machine, its jumps, the system's own numbers and the initial state."""
    machine, x0 = random_machine(seed, masses, rubs, walls)
    rng = np.random.default_rng([*seed, 7])
    return _MADE[kind](rng, machine, x0)


def _times(period, phase):
    """The ticks within the span; one at the start has been made."""
    times = phase + period * np.arange(np.floor(-phase / period), (T1 - phase) / period + 1)
    return [float(t) for t in times if 0 < t < T1]


def _switched(rng, machine, x0):
    period, phase = rng.uniform(0.3, 1.5, 2)
    amplitude = rng.normal(size=len(machine.mass)) * 1.5
    at = lambda t: 1.0 if np.floor((t - phase) / period) % 2 == 0 else -1.0  # noqa: E731
    same = np.eye(len(x0)), np.zeros(len(x0))
    jumps = [
        Jump(t, *same, machine.constant + at(t + period / 2) * amplitude)
        for t in _times(period, phase)
    ]
    began = machine._replace(constant=machine.constant + at(0.0) * amplitude)
    own = (*numbers_of(machine), np.array(period), np.array(phase), amplitude)
    return began, jumps, own, x0


def _kicked(rng, machine, x0):
    n = len(machine.mass)
    period, phase = rng.uniform(0.3, 1.5, 2), rng.uniform(0.0, 1.5, 2)
    kicks = rng.normal(size=(2, n)) * (rng.random((2, n)) < 0.7)
    jumps = []
    for c in range(2):
        shift = np.zeros(len(x0))
        shift[n : 2 * n] = kicks[c]
        times = _times(period[c], phase[c])
        jumps += [Jump(t, np.eye(len(x0)), shift, machine.constant) for t in times]
    return (
        machine,
        sorted(jumps, key=lambda j: j.t),
        (*numbers_of(machine), period, phase, kicks),
        x0,
    )


def _loaded(machine, x0, columns, drift):
    """The machine with more states in its load."""
    more, old = columns.shape[1], len(machine.drift)
    drive = np.zeros((old + more, old + more))
    drive[:old, :old] = machine.drive
    load = np.hstack([machine.load, columns])
    start = np.concatenate([x0, np.zeros(more)])
    drift = np.concatenate([machine.drift, drift])
    return machine._replace(load=load, drive=drive, drift=drift), start


def _held(rng, machine, x0):
    n, period, phase = len(machine.mass), rng.uniform(0.1, 0.8), rng.uniform(0, 0.8)
    gains = -rng.uniform(0, 1.5, 2 * n)
    machine, x0 = _loaded(machine, x0, rng.normal(size=(n, 1)), np.zeros(1))
    matrix = np.eye(len(x0))
    matrix[-1] = 0
    matrix[-1, : 2 * n] = gains
    zero = np.zeros(len(x0))
    jumps = [Jump(t, matrix, zero, machine.constant) for t in _times(period, phase)]
    return machine, jumps, (*numbers_of(machine), np.array(period), np.array(phase), gains), x0


def _timed(rng, machine, x0):
    n, limit, rate = len(machine.mass), rng.uniform(0.2, 1.0), rng.uniform(0.5, 1.5)
    push = np.stack([np.zeros(n), rng.normal(size=n) * 1.5], axis=1)
    machine, x0 = _loaded(machine, x0, push, np.array([rate, 0.0]))
    x0[-2:] = limit * rng.uniform(0, 0.9), 1.0
    matrix, shift = np.eye(len(x0)), np.zeros(len(x0))
    matrix[-2, -2], matrix[-1, -1] = 0, -1
    times = _times(limit / rate, (limit - x0[-2]) / rate)
    jumps = [Jump(t, matrix, shift, machine.constant) for t in times]
    return machine, jumps, (*numbers_of(machine), np.array(limit)), x0


_MADE = {"switched": _switched, "kicked": _kicked, "held": _held, "timed": _timed}


def random_network(seed, size):
    """Neurons of which most fire by themselves, and a state below their thresholds."""
    rng = np.random.default_rng(seed)
    leaks = rng.uniform(0.3, 1.5, size)
    currents = leaks * rng.uniform(0.9, 2.5, size)
    weights = rng.uniform(0, 0.9, (size, size)) / max(size - 1, 1)
    weights = np.where(rng.random((size, size)) < 0.2, -weights, weights)
    np.fill_diagonal(weights, 0.0)
    kicks = rng.uniform(0, 0.6, size) * (rng.random() < 0.7)
    times = rng.uniform(0.4, 1.5), rng.uniform(0, 1.5)
    return Network(currents, leaks, weights, *map(np.array, times), kicks), rng.uniform(
        -0.2, 0.95, size
    )


__all__ = ["KINDS", "T1", "MechanicalSystem", "Neurons", "random_clocked", "random_network"]
