"""Random masses with dry friction, walls and rest, with clocks and timers, and kicking neurons.

Numbers of systems and a seed enter; a group of verdicts for each shape leaves. Motions are compared
at their end, with `tests.oracles.mechanics` and what is built on it; where an exact motion is
within rounding of another one, or a start that differs by 1e-13 leads elsewhere, it is not judged.
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
from tests.oracles.mechanical_problems import (
    T1,
    numbers_of,
    random_machine,
    random_stopped,
    system_of,
)

DT, ROOM, ALLOWED = 0.02, 2000, 1e-7
# (masses, frictions, walls) and their part of all systems.
SHAPES = {
    (1, 1, 1): 0.16,
    (2, 1, 1): 0.12,
    (2, 2, 1): 0.06,
    (2, 2, 2): 0.08,
    (3, 1, 1): 0.04,
    (3, 2, 2): 0.08,
}
PLAIN = {"plain": random_machine, "stopped": random_stopped}
# (kind, sizes); the sizes of neurons are their number.
OTHERS = {
    ("stopped", (1, 1, 1)): 0.04,
    ("stopped", (2, 1, 1)): 0.03,
    ("switched", (1, 1, 1)): 0.04,
    ("kicked", (1, 1, 1)): 0.04,
    ("held", (2, 1, 1)): 0.03,
    ("timed", (1, 1, 1)): 0.04,
    ("neurons", (3,)): 0.03,
    ("neurons", (6,)): 0.02,
}


def problem(kind, sizes, seed):
    """The numbers of a system with its initial state, and its exact motion as a function of it."""
    if kind == "neurons":
        network, x0 = random_network(seed, *sizes)
        return (tuple(network), x0), lambda x: (avalanches.propagate(network, x, T1)[0], 1.0)
    if kind in PLAIN:
        machine, x0 = PLAIN[kind](seed, *sizes)
        return (numbers_of(machine), x0), lambda x: _end(mechanics.propagate(machine, x, T1))
    machine, jumps, numbers, x0 = random_clocked(seed, kind, *sizes)
    exact = clocked_mechanics.propagate
    return (numbers, x0), lambda x: _end(exact(machine, jumps, x, T1))


def _end(motion):
    return motion.x, motion.size


def verdict(number, exact, x0, name, end):
    """What became of one problem."""
    try:
        x, size = exact(x0)
    except Uncertain as why:
        return Verdict(number, "rounding" if name == "successful" else "told", str(why))
    if name != "successful":
        return Verdict(number, "refused", name)
    error = abs(end - x).max() / (1 + size)
    if error <= ALLOWED:
        return Verdict(number, "right", f"error {error:.1e}", error)
    kind = "rounding" if _is_chaotic(exact, x0, x, size) else "wrong"
    return Verdict(number, kind, f"error {error:.1e}", error)


def _is_chaotic(exact, x0, x, size):
    """Whether a change of the start by a thousand roundings changes the end by more than what is
    allowed, or leads where the motion is undecided."""
    for change in 1e-13 * np.eye(len(x0)) * (1 + abs(x0)):
        try:
            other, _ = exact(x0 + change)
        except Uncertain:
            return True
        if abs(other - x).max() > ALLOWED * (1 + size):
            return True
    return False


def group(kind, sizes, count, seed):
    """The verdicts on `count` systems."""
    made = [problem(kind, sizes, [seed, *sizes, i]) for i in range(count)]
    plain = dict.fromkeys(PLAIN, system_of)
    make = {**plain, "neurons": lambda numbers: Neurons(*numbers)}.get(
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
    found = [verdict(i, exact, x0, str(name), end) for i, (((_, x0), exact), name, end) in lanes]
    return Group("mechanics", f"{kind} {', '.join(map(str, sizes))}", found)


def groups(systems, seed):
    """All shapes."""
    for sizes, count in counts(SHAPES, systems).items():
        yield group("plain", sizes, count, seed)
    for (kind, sizes), count in counts(OTHERS, systems).items():
        yield group(kind, sizes, count, seed)
