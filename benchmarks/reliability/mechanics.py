"""Random masses with dry friction, walls and rest, with clocks and timers, and kicking neurons.

Numbers of systems and a seed enter; a group of verdicts for each shape leaves. Motions are compared
at their end, with `tests.oracles.mechanics` and what is built on it; where an exact motion is
within rounding of another one, it is not judged.
"""

import equinox as eqx
import jax
import numpy as np

import jaxfil as jf
from benchmarks.reliability.lanes import counts, in_chunks
from benchmarks.reliability.verdict import Group, Verdict
from jaxfil.model.outcomes import outcome_names
from tests.oracles import avalanches, clocked_mechanics, mechanics
from tests.oracles.clocked_problems import KINDS, Neurons, random_clocked, random_network
from tests.oracles.linear_flow import Uncertain
from tests.oracles.mechanical_problems import T1, numbers_of, random_machine, system_of

DT, ROOM, ALLOWED = 0.02, 2000, 1e-7
# (masses, frictions, walls) and their part of all systems.
SHAPES = {(1, 1, 1): 0.16, (2, 1, 1): 0.12, (2, 2, 1): 0.06, (2, 2, 2): 0.08, (3, 2, 2): 0.08}
# (kind, sizes); the sizes of neurons are their number.
CLOCKED = {
    ("switched", (1, 1, 1)): 0.04,
    ("kicked", (1, 1, 1)): 0.04,
    ("held", (2, 1, 1)): 0.03,
    ("timed", (1, 1, 1)): 0.04,
    ("neurons", (3,)): 0.03,
    ("neurons", (6,)): 0.02,
}


def problem(kind, sizes, seed):
    """The numbers of a system with its initial state, and its exact motion as a function."""
    if kind == "neurons":
        network, x0 = random_network(seed, *sizes)
        return (tuple(network), x0), lambda: (avalanches.propagate(network, x0, T1)[0], 1.0)
    if kind == "plain":
        machine, x0 = random_machine(seed, *sizes)
        return (numbers_of(machine), x0), lambda: _end(mechanics.propagate(machine, x0, T1))
    machine, jumps, numbers, x0 = random_clocked(seed, kind, *sizes)
    exact = clocked_mechanics.propagate
    return (numbers, x0), lambda: _end(exact(machine, jumps, x0, T1))


def _end(motion):
    return motion.x, motion.size


def verdict(number, exact, name, end):
    """What became of one problem."""
    try:
        x, size = exact()
    except Uncertain as why:
        return Verdict(number, "rounding" if name == "successful" else "told", str(why))
    if name != "successful":
        return Verdict(number, "refused", name)
    error = abs(end - x).max() / (1 + size)
    return Verdict(number, "right" if error <= ALLOWED else "wrong", f"error {error:.1e}", error)


def group(kind, sizes, count, seed):
    """The verdicts on `count` systems."""
    made = [problem(kind, sizes, [seed, *sizes, i]) for i in range(count)]
    make = {"plain": system_of, "neurons": lambda numbers: Neurons(*numbers)}.get(
        kind, lambda numbers: KINDS[kind](*numbers)
    )

    @eqx.filter_jit
    @eqx.filter_vmap
    def solve(numbers, x0, dt):
        sol = jf.solve(make(numbers), x0, 0.0, T1, dt, max_events=ROOM, throw=False)
        return sol.result, sol.x_final

    results, ends = in_chunks(solve, [p for p, _ in made], np.full(count, DT))
    jax.clear_caches()  # a program for each shape, none of which is used again
    lanes = enumerate(zip(made, outcome_names(results), ends, strict=True))
    found = [verdict(i, exact, str(name), end) for i, ((_, exact), name, end) in lanes]
    return Group("mechanics", f"{kind} {', '.join(map(str, sizes))}", found)


def groups(systems, seed):
    """All shapes."""
    for sizes, count in counts(SHAPES, systems).items():
        yield group("plain", sizes, count, seed)
    for (kind, sizes), count in counts(CLOCKED, systems).items():
        yield group(kind, sizes, count, seed)
