"""`python -m benchmarks.varying`: fixed steps and a tolerance where steps must vary by orders.

A spiking neuron, a stiff relay, a capsule that bounces on a stiff pad after slow flights, and an
eccentric orbit with a thrust that is switched. Each is run with fixed steps, halved where they
cannot be trusted, and with `jf.Adaptive`; errors are those of independent solutions. Writes
`results/varying.txt`: how many steps, and how long, at equal error.
"""

import functools as ft
import math
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxfil as jf
from benchmarks import RESULTS
from benchmarks.linear_pieces import Mode, follow
from benchmarks.report import rate_at
from benchmarks.stiff_scenes import relay_exact
from benchmarks.table import Column, table
from benchmarks.timing import timed
from tests.oracles.stiff_systems import DampedRelay

TOLERANCES = tuple(10.0**-k for k in range(3, 12))
LEVELS = (1e-4, 1e-6, 1e-8)
REPEATS = 5
COLUMNS = (
    Column("motion"),
    Column("steps"),
    *(Column(f"at {level:.0e}", ">,.0f") for level in LEVELS),
    *(Column(f"ms at {level:.0e}", ">.2g") for level in LEVELS),
)
ABOUT = """\
Iterations of one lane, and its run time, at these errors max |x(t1) − reference|, relative to
max |reference|: interpolated between runs with steps that are halved from one to the next, or
tolerances a tenth of the one before. What does not get there has no entry.
"""


class Neuron(jf.System):
    """An adaptive exponential integrate-and-fire neuron in units of ms and mV: (V, w)."""

    drive, leak, rest, rise, sharp = 500.0, 10.0, -70.0, -50.0, 2.0
    slow, coupling, jump, cut, back, capacity = 30.0, 2.0, 0.0, 0.0, -58.0, 200.0

    def vector_field(self, t, x, side):
        v, w = x
        spike = self.leak * self.sharp * jnp.exp((v - self.rise) / self.sharp)
        current = -self.leak * (v - self.rest) + spike - w + self.drive
        return jnp.stack(
            [current / self.capacity, (self.coupling * (v - self.rest) - w) / self.slow]
        )

    def switching(self, t, x):
        return x[0] - self.cut

    def reset(self, t, x, surface):
        return jnp.stack([jnp.full((), self.back), x[1] + self.jump])


class Capsule(jf.System):
    """y'' = −1 in flight, −1 − k y − c y' in the pad below y = 0."""

    k: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        pad = 0.5 * (1 - side) * (self.k * x[0] + self.c * x[1])
        return jnp.stack([x[1], -1.0 - pad])

    def switching(self, t, x):
        return x[0]


class Tug(jf.System):
    """A planet's satellite that thrusts along its way where it is farther away than `far`."""

    thrust: jax.Array
    far: jax.Array

    def vector_field(self, t, x, side):
        r3 = jnp.sqrt(x[0] ** 2 + x[1] ** 2) ** 3
        speed = jnp.sqrt(x[2] ** 2 + x[3] ** 2)
        push = 0.5 * (1 + side) * self.thrust / speed
        return jnp.stack([x[2], x[3], -x[0] / r3 + push * x[2], -x[1] / r3 + push * x[3]])

    def switching(self, t, x):
        return jnp.sqrt(x[0] ** 2 + x[1] ** 2) - self.far


def _by_pieces(system, x0, t1):
    """The state at t1, by SciPy from contact to contact."""
    h_shape = np.ndim(system.switching(0.0, jnp.asarray(x0)))
    assert h_shape == 0
    field, h = (jax.jit(lambda *at, f=f: f(*at)) for f in (system.vector_field, system.switching))
    t, x, side = 0.0, np.asarray(x0, float), float(np.sign(h(0.0, jnp.asarray(x0))))
    while t < t1:

        def meets(t, x, side=side):
            return float(side * h(t, jnp.asarray(x)))

        meets.terminal, meets.direction = True, -1

        def rate(t, x, side=side):
            return np.asarray(field(t, jnp.asarray(x), side))

        run = solve_ivp(rate, (t, t1), x, "DOP853", events=meets, rtol=3e-14, atol=1e-13)
        t, x = run.t[-1], run.y[:, -1]
        if run.t_events[0].size:
            if system.resets:
                x = np.asarray(system.reset(t, jnp.asarray(x), 0))
            else:
                side = -side
                # Off the surface, so that the next piece does not begin with its event.
                x = x + 1e-15 * rate(t, x, side)
    return x


def _capsule(k, c, t1):
    modes = {
        1: Mode([[0, 1], [0, 0]], [0, -1], [0, 0], lambda t, z: z[0]),
        -1: Mode([[0, 1], [-k, -c]], [0, -1], [0, 0], lambda t, z: -z[0]),
    }
    found = follow(modes, lambda mode, t, z: -mode, 1, (1.0, 0.0), t1)
    return np.array([float(v) for v in found[0]])


class Motion(NamedTuple):
    """A motion whose steps must vary: its steppers, the longest fixed step, and what is right."""

    system: jf.System
    x0: tuple
    t1: float
    longest: float
    stepper: object
    reference: object


def motions():
    """The four of them, by name."""
    neuron, tug = Neuron(), Tug(jnp.array(0.02), jnp.array(1.0))
    relay = DampedRelay(jnp.array(1e5), jnp.array(0.5))
    capsule = Capsule(jnp.array(1e6), jnp.array(200.0))
    start, orbit = (-58.0, 0.0), (0.05, 0.0, 0.0, math.sqrt(1.95 / 0.05))
    return {
        "neuron": Motion(neuron, start, 40.0, 2.0, diffrax.Dopri8(), ft.partial(
            _by_pieces, neuron, start, 40.0)),
        "relay, d = 1e5": Motion(relay, (0.5, 2.0), 12.0, 0.4, jf.Rodas5P(), lambda: np.array(
            [float(v) for v in relay_exact(1e5, 0.5)[0]])),
        "capsule, k = 1e6": Motion(capsule, (1.0, 0.0), 5.0, 0.4, diffrax.Dopri8(), ft.partial(
            _capsule, 1e6, 200, 5)),
        "orbit, e = 0.95": Motion(tug, orbit, 15.0, 0.4, diffrax.Dopri8(), ft.partial(
            _by_pieces, tug, orbit, 15.0)),
    }  # fmt: skip


def measured(motion, right, settings):
    """(error, iterations, seconds) of runs with these steps."""
    x0 = jnp.asarray(motion.x0)

    def run(dt):
        return jf.solve(
            motion.system, x0, 0.0, motion.t1, dt, stepper=motion.stepper, max_events=None,
            throw=False,
        )  # fmt: skip

    rows = []
    for setting in settings:
        fixed = isinstance(setting, float)
        call = jax.jit(run) if fixed else jax.jit(ft.partial(run, setting))
        sol, seconds = timed(ft.partial(call, *([jnp.asarray(setting)] if fixed else [])), REPEATS)
        done = bool(sol.result == jf.RESULTS.successful)
        error = np.max(abs(sol.x_final - right)) / np.max(abs(right)) if done else math.nan
        rows.append((float(error), int(sol.stats["num_iterations"]), seconds))
    return rows


def at(rows, column, level):
    """A column where the error is this level; None where it does not get there."""
    points = [
        {"method": "", "error": row[0], "rates": {"1": 1 / row[column]}}
        for row in rows
        if math.isfinite(row[0]) and row[0] > 0
    ]
    rate = rate_at(points, level, 1) if points else None
    return None if rate is None else 1 / rate


def main():
    """Measure, print and write the table."""
    jax.config.update("jax_enable_x64", True)
    body = []
    for name, motion in motions().items():
        right = motion.reference()
        kinds = {
            "fixed": [motion.longest / 2**k for k in range(14)],
            "tolerance": [jf.Adaptive(rtol, 1e-3 * rtol) for rtol in TOLERANCES],
        }
        for kind, settings in kinds.items():
            rows = measured(motion, right, settings)
            steps = [at(rows, 1, level) for level in LEVELS]
            spent = [at(rows, 2, level) for level in LEVELS]
            spent = [None if v is None else 1e3 * v for v in spent]
            body.append([name, kind, *steps, *spent])
            print(name, kind, *(f"{e:.1e}:{n}" for e, n, _ in rows), flush=True)
    text = table(COLUMNS, body, ABOUT) + "\n"
    (RESULTS / "varying.txt").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
