"""Memory: what a compiled program holds, and how that grows.

Nothing enters, and nothing is run: XLA says of each program how many bytes its temporaries and
results take. The text of a table of straight lines leaves: bytes for each lane and for each step.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.table import Column, table

# Lanes and steps of the programs: each line varies one of them at the other's first, middle value.
LANES, STEPS = (64, 128, 512), (100, 400, 1600)


def bytes_of(function, *args):
    """Temporaries and results of a compiled function."""
    # They are settled before machine code is made, which need not be good.
    options = {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else None
    found = jax.jit(function).lower(*args).compile(options).memory_analysis()
    return found.temp_size_in_bytes + found.output_size_in_bytes


def solve(x0, steps, system=None, **options):
    """Steps of the midpoint rule, whose stages compile fast and hold little; no events kept."""
    system = jf.systems.CoulombOscillator() if system is None else system
    options = {"max_events": None, "stepper": diffrax.Midpoint(), "throw": False} | options
    return jf.solve(system, x0, 0.0, 0.1 * steps, 0.1, **options)


def forward(lanes, steps, **options):
    """A batch of solves of so many steps."""

    def end(friction):
        system = jf.systems.CoulombOscillator(friction)
        sol = solve(jnp.array([3.0, 0.0]), steps, system, **options)
        return sol.xs, sol.events

    return bytes_of(jax.vmap(end), jnp.linspace(0.3, 0.5, lanes))


def saved(lanes, steps):
    """The same with every step kept."""
    return forward(lanes, steps, saveat=diffrax.SaveAt(steps=True), max_steps=steps)


def recorded(lanes, steps):
    """The same with an event table as long as there are steps."""
    return forward(lanes, steps, max_events=steps)


def jacobian(lanes, steps):
    """The Jacobian by the initial state, forward."""

    def end(x0):
        return solve(x0, steps).xs[-1]

    return bytes_of(jax.vmap(jax.jacfwd(end)), jnp.zeros((lanes, 2)))


def reverse(lanes, steps):
    """The gradient by the initial state, in reverse."""

    def end(x0):
        adjoint = diffrax.RecursiveCheckpointAdjoint()
        return solve(x0, steps, max_steps=steps, adjoint=adjoint).xs[-1, 0]

    return bytes_of(jax.vmap(jax.grad(end)), jnp.zeros((lanes, 2)))


ROWS = (
    ("solve, the end kept", forward),
    ("solve, every step kept", saved),
    ("solve, an event table of as many rows", recorded),
    ("Jacobian, forward", jacobian),
    ("gradient, reverse", reverse),
)


def line(xs, ys):
    """Slope and the largest deviation from the straight line through ys over xs, in parts."""
    slope, start = np.polyfit(xs, ys, 1)
    return slope, float(np.max(np.abs(slope * np.asarray(xs) + start - ys)) / np.max(ys))


def report(quick):
    """The section's text."""
    body = []
    for name, measure in ROWS[: 1 if quick else None]:
        by_steps = [measure(LANES[0], steps) for steps in STEPS]
        by_lanes = [by_steps[1], *(measure(lanes, STEPS[1]) for lanes in LANES[1:])]
        each, bend = line(LANES, by_lanes)
        step, bow = line(STEPS, by_steps)
        body.append([name, each, bend, step / LANES[0], bow])
    return table(COLUMNS, body, TITLE, ABOUT)


COLUMNS = (
    Column("Coulomb oscillator, float64, midpoint"),
    Column("bytes a lane", ">,.0f"),
    Column("off the line", ">.1%"),
    Column("bytes a lane and step", ">,.1f"),
    Column("off the line", ">.1%"),
)
TITLE = "Memory: temporaries and results of the compiled program"
ABOUT = f"""\
Bytes a lane: the slope from {LANES[0]} to {LANES[-1]} lanes at {STEPS[1]} steps. Bytes a lane and
step: the slope from {STEPS[0]} to {STEPS[-1]:,} steps at {LANES[0]} lanes. Off the line: the
largest deviation from it, in parts of the largest number. Reverse mode keeps checkpoints, and
grows with the root of the steps: that is no straight line. A diagram keeps n numbers for each lane
and sample; its periods and steps are traced values, which its program, and so its memory, does not
depend on."""
