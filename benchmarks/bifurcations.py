"""`python -m benchmarks.bifurcations`: the bifurcations of Santhosh et al. (2016).

Prints a table of what the paper prints, what jaxfil finds, an independent reference where there is
one, and why they differ; then a search for the grazing set of the SD oscillator in three parameters
from ten random starts by optax, with its gradient steps and time. Writes
`results/bifurcations.txt`. `python -m benchmarks.paper` draws the figures.
"""

import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxfil as jf
from benchmarks import RESULTS
from benchmarks.table import Column, table

# What the paper prints (Procedia IUTAM 19, 219–227) where it differs, by the value near it.
PRINTED = {
    0.8667: ("0.86672, once 0.86667", "the second is a misprint"),
    1.1171: ("", "not in the paper"),
    0.9170: ("0.92", "rounded"),
    1.3983: ("", "not in the paper"),
    1.4027: ("", "not in the paper"),
    1.5489: ("1.55", "rounded"),
    1.9138: ("", "not in the paper, which draws the motion at 1.95"),
    2.4376: ("", "not in the paper, which draws the motion at 2.44"),
    4.2172: ("", "not in the paper"),
    7.9524: ("7.85", "there the orbit is already past it"),
    10.905: ("10.9", "rounded"),
    4.6526: ("4.565", "where motion from (0, 0) leaves its basin; the orbit stays stable"),
}
# Closed forms, and 60-digit Newton on closed forms per piece or on Taylor series.
REFERENCE = {
    0.8667: 0.866716581971234,
    1.1171: 1.117142393133526,
    0.9170: 0.917012578766336,
    1.5489: 1.548910479930516,
    10.905: 10.904975822090772,
    4.6526: 4.652570419201206,
}
LOCATED = (
    Column("system"),
    Column("kind"),
    Column("jaxfil", "<.14g"),
    Column("− exact", "<+.1e"),
    Column("paper"),
    Column("why they differ"),
)
SEARCHED = (
    Column("start Ω, f0, ζ"),
    Column("end"),
    Column("steps", ">"),
    Column("amplitude − 1", ">.1e"),
    Column("seconds", ">.1f"),
)
# The search is for Ω, f0 and ζ between these.
LOW, HIGH = np.array([0.6, 0.15, 0.005]), np.array([0.85, 0.3, 0.1])


def near(entries, value):
    """The entry whose key is this value."""
    return next((v for key, v in entries.items() if abs(key - value) < 1e-3), None)


def row(system, b):
    """A line of the first table, in the order of `LOCATED`."""
    value = float(b.value)
    printed, why = near(PRINTED, value) or ("", "")
    exact = near(REFERENCE, value)
    return [system, b.kind, value, None if exact is None else value - exact, printed, why]


def sd(omega, guess=(1.5, 0.0)):
    """The SD oscillator's grazing near a frequency."""
    system = jf.systems.SDOscillator(omega=omega)
    orbit = jf.periodic_orbit(system, jnp.array(guess), steps=60)
    return jf.find_bifurcation(system, "omega", orbit, "grazing")


def belt_sequence():
    """The branch of belt case 1 and its bifurcations in ascending order."""
    belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=17.0)
    orbit = jf.periodic_orbit(belt, jnp.array([0.6, 0.02]), steps=60)
    return jf.find_bifurcations(belt, "omega", orbit, stop=(0.5, 20.0))


def cubic_grazing():
    """The grazing of the orbit of belt case 2."""
    cubic = jf.systems.BeltFriction(omega=4.56)
    orbit = jf.periodic_orbit(cubic, jnp.array([0.148, 0.358]), steps=100)
    return jf.find_bifurcation(cubic, "omega", orbit, "grazing-sliding")


def located():
    """The table of all bifurcations."""
    rows = [row("SD", sd(omega)) for omega in (0.84, 1.15)]
    rows += [row("belt case 1", b) for b in belt_sequence()]
    return table(LOCATED, [*rows, row("belt case 2", cubic_grazing())])


def unscaled(u):
    """Ω, f0 and ζ of a point of the unit cube."""
    return LOW + (HIGH - LOW) * u


def descent(solver):
    """A step of the search: optax's solver on half the squared margin, in bounds."""
    system = jf.systems.SDOscillator(omega=0.75, f0=0.2, zeta=0.02)
    orbit = jf.periodic_orbit(system, jnp.array([1.4, 0.0]), steps=60)

    def loss(u):
        omega, f0, zeta = unscaled(u)
        margin = jf.grazing_margin(jf.systems.SDOscillator(omega=omega, f0=f0, zeta=zeta), orbit)
        return 0.5 * margin**2

    @eqx.filter_jit
    def step(u, state):
        value, slope = jax.value_and_grad(loss)(u)
        change, state = solver.update(slope, state, u)
        bounded = optax.projections.projection_box(optax.apply_updates(u, change), 0.0, 1.0)
        return bounded, state, value

    return step


def search(starts=10, steps=2000):
    """The table of searches in (Ω, f0, ζ) by optax's Adam, each from a random start."""
    rng, solver, rows = np.random.default_rng(0), optax.adam(0.02), []
    step = descent(solver)
    for _ in range(starts):
        u = jnp.asarray(rng.uniform(size=3))
        begin, state, count = unscaled(np.asarray(u)), solver.init(u), 0
        begun = time.perf_counter()
        value = jnp.inf
        while value > 1e-18 and count < steps:
            u, state, value = step(u, state)
            count += 1
        spent = time.perf_counter() - begun
        omega, f0, zeta = unscaled(np.asarray(u))
        end = f"[{omega:.6f} {f0:.6f} {zeta:.6f}]"
        amplitude = f0 / np.hypot(1 - omega**2, 2 * zeta * omega)
        rows.append([np.array2string(begin, precision=4), end, count, amplitude - 1, spent])
    return table(SEARCHED, rows)


def main():
    """Print and write both tables."""
    jax.config.update("jax_enable_x64", True)
    texts = []
    for make in (located, search):
        texts.append(make())
        print(texts[-1], end="\n\n", flush=True)
    (RESULTS / "bifurcations.txt").write_text("\n\n".join(texts) + "\n")
    print(f"written to {RESULTS}", file=sys.stderr)


if __name__ == "__main__":
    main()
