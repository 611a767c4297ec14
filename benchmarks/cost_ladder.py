"""Operations and time per lane and step for scenes that declare more and more.

The rungs of `cost_scenes` enter; the text of a table leaves. Each rung is one compiled program. Its
operations are counted in the program's text (`hlo`), its time is the processor's, the median over
repeats: once with all surfaces out of reach, which is what declaring them costs, and once with
contacts, which are new numbers for the same program.
"""

import statistics
import sys
import time

import diffrax
import jax
import numpy as np

import jaxfil as jf
from benchmarks.table import Column, table
from jaxfil.sweep.execution import compiled
from jaxfil.xla.kernel import BLOCK, kernel_if_it_fits
from tests.oracles import cost_scenes, hlo

LANES, STEPS = 1024, 40
# Where surfaces are met.
NEAR = 0.7
# Name, scene, derivatives, and what is kept on the way.
RUNGS = (
    ("smooth", "Smooth", None, {}),
    ("crossing only", "Crossing", None, {}),
    ("impacts", "Impacts", None, {}),
    ("sliding", "Sliding", None, {}),
    ("two surfaces, sliding, impacts", "BeltAndWall", None, {}),
    ("general: these surfaces coupled", "General", None, {}),
    ("smooth, forward derivatives", "Smooth", "forward", {}),
    ("sliding, forward derivatives", "Sliding", "forward", {}),
    ("smooth, reverse", "Smooth", "reverse", {}),
    ("sliding, reverse", "Sliding", "reverse", {}),
    ("sliding, 64 events kept", "Sliding", None, {"max_events": 64}),
)


def lane(kind, derivative, options, periods):
    """The function of one lane: its last state, or the derivative of that by x0; and what
    `Program.seconds` tells of a lane."""

    def end(x0, omega, place):
        system = getattr(cost_scenes, kind)(omega, place)
        dt = system.period / STEPS
        sol = jf.solve(system, x0, 0.0, periods * system.period, dt, throw=False, **options)
        failed = sol.result != jf.RESULTS.successful
        return sol.xs[-1], (sol.stats["num_iterations"], sol.num_events, failed)

    options = {"max_events": None} | options
    if derivative is None:
        return end
    if derivative == "forward":
        return jax.jacfwd(end, has_aux=True)
    options["adjoint"] = diffrax.RecursiveCheckpointAdjoint()
    options["max_steps"] = 2 * STEPS * periods
    return jax.grad(lambda *a: (lambda x, aux: (x[0], aux))(*end(*a)), has_aux=True)


class Program:
    """A rung compiled: in one kernel for a block of lanes, as a sweep is, or where XLA refuses
    that, for all lanes at once."""

    def __init__(self, kind, derivative, options, periods):
        lanes = jax.vmap(lane(kind, derivative, options, periods))
        start = time.perf_counter()
        self.whole = derivative != "reverse"
        self.lanes = BLOCK if self.whole else LANES
        run = compiled(kernel_if_it_fits(lanes) if self.whole else lanes)
        self.run = run.lower(*arguments(self.lanes, 0.0)).compile()
        self.compile_seconds = time.perf_counter() - start

    def seconds(self, place):
        """Processor time of all lanes; of each the iterations, contacts, and whether it failed."""
        blocks = [arguments(LANES, place, here, self.lanes) for here in range(LANES // self.lanes)]
        jax.block_until_ready(self.run(*blocks[0]))
        start = time.process_time()
        out = [jax.block_until_ready(self.run(*block)) for block in blocks]
        busy = time.process_time() - start
        return busy, *(np.concatenate([told[i] for _, told in out]) for i in range(3))


def arguments(lanes, place, block=0, size=None):
    """States, frequencies and places of one block of lanes."""
    size = lanes if size is None else size
    omegas = np.linspace(0.7, 1.4, lanes)[block * size : (block + 1) * size]
    return np.broadcast_to([0.3, 0.1], (size, 2)).copy(), omegas, np.full(size, place)


def measure(kind, derivative, options, periods, repeats):
    """One row of numbers."""
    program = Program(kind, derivative, options, periods)
    text = program.run.compiled.as_text()
    row = dict(
        operations=hlo.per_turn(text, program.lanes),
        divisions=hlo.per_turn(text, program.lanes, {"divide", "sqrt"}),
        whole=program.whole,
        compile_seconds=program.compile_seconds,
    )
    for name, place in (("idle", cost_scenes.FAR), ("busy", NEAR)):
        runs = [program.seconds(place) for _ in range(repeats)]
        _, turns, contacts, failed = runs[0]
        row[name] = statistics.median(run[0] for run in runs) / (LANES * STEPS * periods) * 1e9
        row[name + " turns"] = turns.mean() / (STEPS * periods)
        row[name + " contacts"] = contacts.mean() / periods
        row[name + " failed"] = int(failed.sum())
    return row


def cells(name, row, general):
    """One line of the table, in the order of `COLUMNS`."""
    parts = [row[key] / general[key] for key in ("operations", "idle")]
    busy = [row[key] if row["busy contacts"] else None for key in BUSY]
    kernels = "one" if row["whole"] else "many"
    line = [name, row["operations"], parts[0], row["divisions"], row["idle"], parts[1]]
    return [*line, *busy, kernels, row["compile_seconds"]]


BUSY = ("busy", "busy turns", "busy contacts")
COLUMNS = (
    Column("scene"),
    Column("operations", ">,.0f"),
    Column("of general", ">.3f"),
    Column("÷ √", ">.0f"),
    Column("ns", ">,.0f"),
    Column("of general", ">.3f"),
    Column("ns, contacts", ">,.0f"),
    Column("turns", ">.2f"),
    Column("contacts", ">.1f"),
    Column("kernels"),
    Column("compile s", ">.1f"),
)
ABOUT = """\
operations: additions, multiplications, divisions, comparisons, selections and logic for each
lane in one turn of the compiled loop, repeats in fusions included (of conditionals the dearest
branch; reverse: both loops; a loop inside a loop turning once). ÷ √: those of them that are
divisions and roots. ns: processor time for each lane and step, the median of runs with all
surfaces out of reach. ns, contacts: the same program with contacts, so many turns of its loop a
step and so many contacts a period. kernels: many where XLA does not make one of the loop.
Derivatives are those by both initial values. Lanes that failed: """


def report(quick):
    """The section's text."""
    repeats, periods = (2, 5) if quick else (5, 10)
    rungs = {}
    for name, *rung in RUNGS:
        rungs[name] = measure(*rung, periods, repeats)
        print(f"ladder: {name}, {rungs[name]['idle']:.0f} ns", file=sys.stderr, flush=True)
    general = next(row for name, row in rungs.items() if name.startswith("general"))
    body = [cells(name, row, general) for name, row in rungs.items()]
    failed = sum(row["idle failed"] + row["busy failed"] for row in rungs.values())
    title = f"Pay for what you use: {LANES:,} lanes, Dopri8, {STEPS} steps a period, float64"
    return table(COLUMNS, body, title, f"{ABOUT}{failed}.")
