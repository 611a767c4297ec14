"""Compilation of each textbook scene and of its Jacobian, and what a call costs.

The scenes of `jaxfil.systems.TEXTBOOK` enter; the text of two tables leaves. Compilation is timed
in processes of its own (`python -m benchmarks.cost_calls`), one with an empty cache on disk and one
with the cache that the first has filled.
"""

import functools
import json
import subprocess
import sys
import tempfile
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.table import Column, table
from benchmarks.timing import timed
from tests.oracles.compilations import Counter

# RK4, with fewer stages, compiles faster than both.
STEPPERS = {"Dopri8": diffrax.Dopri8(), "Tsit5": diffrax.Tsit5()}
# What a scene is allowed to take.
LIMIT = 3.0
SIZES = (1, 64, 1000)
PERIODS, STEPS = 10, 40


def _end(x0, system, stepper):
    """The state that a short run ends in."""
    return jf.solve(system, x0, 0.0, 1.0, 0.1, stepper=stepper, throw=False).xs[-1]


def first_calls(scenes, steppers):
    """{scene: {stepper: [seconds of the first solve, of the first Jacobian]}}."""
    found = {}
    for name in scenes:
        kind, x0 = jf.systems.TEXTBOOK[name]
        for stepper in steppers:
            end = functools.partial(_end, stepper=STEPPERS[stepper])
            for function in (end, jax.jacfwd(end)):
                start = time.perf_counter()
                jax.block_until_ready(jax.jit(function)(jnp.array(x0), kind()))
                seconds = time.perf_counter() - start
                found.setdefault(name, {}).setdefault(stepper, []).append(seconds)
    return found


def in_a_process(folder, scenes, steppers):
    """The same in a new process, with JAX's cache on disk in `folder`."""
    asked = map(json.dumps, (scenes, steppers))
    command = [sys.executable, "-m", "benchmarks.cost_calls", folder, *asked]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def compilation(quick):
    """The second table."""
    scenes = list(jf.systems.TEXTBOOK)[: 1 if quick else None]
    steppers = list(STEPPERS)[: 1 if quick else None]
    with tempfile.TemporaryDirectory() as folder:
        cold = in_a_process(folder, scenes, steppers)
        cached = in_a_process(folder, scenes, steppers[:1])
    heads = [f"{s}{d}" for s in steppers for d in ("", ", Jacobian")]
    heads += [f"{steppers[0]}, cached", "Jacobian, cached"]
    columns = [Column("first call, s"), *(Column(head, ">.1f") for head in heads)]
    body = [
        [name, *(s for found in (*cold[name].values(), *cached[name].values()) for s in found)]
        for name in scenes
    ]
    slow = "\n".join(_slow(cold, scenes, steppers))
    return table(columns, body, note=f"{slow}\n\n{COMPILED}")


def _slow(cold, scenes, steppers):
    """Lines that name the scenes whose first calls took longer than allowed."""
    for i, what in enumerate(("jf.solve", "its Jacobian")):
        for stepper in steppers:
            slow = [n for n in scenes if cold[n][stepper][i] > LIMIT]
            told = f"{len(slow)} of {len(scenes)} scenes" + (f": {', '.join(slow)}" if slow else "")
            yield f"{what}, {stepper}, above {LIMIT:.0f} s: {told}"


def _seconds(function, *args, repeats=20):
    """The median run time of a compiled function."""
    return timed(functools.partial(function, *args), repeats)[1]


def calls(kind, x0):
    """Seconds of one scene: a call of one step, as written and under jit; then of ten periods."""

    def run(omega, x0, periods, dt):
        system = kind(omega=omega)
        span = periods * system.period
        return jf.solve(system, x0, 0.0, span, dt, max_events=None, throw=False).xs[-1]

    x0, omega = jnp.array(x0), jnp.asarray(kind().omega)
    dt = 2 * np.pi / float(omega) / STEPS
    short = 1 / STEPS
    whole = jax.jit(run)
    seconds = [_seconds(run, omega, x0, short, dt), _seconds(whole, omega, x0, short, dt)]
    for lanes in SIZES:
        many = jax.jit(jax.vmap(run, in_axes=(0, None, None, None)))
        omegas = omega * jnp.linspace(0.99, 1.01, lanes)
        seconds.append(_seconds(many, omegas, x0, float(PERIODS), dt, repeats=5))
    return seconds, _new_programs(kind, whole)


def _new_programs(kind, whole):
    """What is traced or compiled where every number is new."""
    systems = [kind(omega=np.float64(w), f0=np.float64(f)) for w, f in ((1.1, 0.3), (1.2, 0.4))]
    starts = [jnp.array([0.3, 0.1]), jnp.array([0.4, 0.2])]
    counter = Counter()
    counter.watch()
    for i, (system, x0) in enumerate(zip(systems, starts, strict=True)):
        before = dict(counter.counts)
        jf.solve(system, x0, 0.1 + i, 1.7 + i, 0.2 - 0.1 * i, max_events=None, throw=False)
        whole(system.omega, x0, 0.1 + i, 0.2 - 0.1 * i)
    after = counter.since(before)
    return after["traces"] + after["compilations"]


def report(quick):
    """The section's text."""
    body = []
    scenes = dict(sd=jf.systems.SDOscillator, belt=jf.systems.BeltFriction)
    for name, kind in list(scenes.items())[: 1 if quick else None]:
        (plain, jitted, *sizes), new = calls(kind, (0.3, 0.1))
        each = sizes[-1] / SIZES[-1] / PERIODS / STEPS
        milliseconds = [seconds * 1e3 for seconds in sizes]
        body.append([name, plain * 1e6, jitted * 1e6, *milliseconds, each * 1e9, new])
    columns = [
        Column("a call"),
        Column("jf.solve, one step, µs", ">,.0f"),
        Column("in jax.jit, one step, µs", ">,.0f"),
        *(Column(f"{size:,} lane{'s' * (size > 1)}, ms", ">,.2f") for size in SIZES),
        Column("ns a lane and step", ">,.0f"),
        Column("traced or compiled for new numbers", ">"),
    ]
    return table(columns, body, TITLE, f"{CALLS}\n\n{compilation(quick)}")


TITLE = "Single runs, small batches and compilation"
CALLS = f"""\
A call of one step is what a call costs beside the integration; the others run {PERIODS} periods of
{STEPS} steps of Dopri8 under jax.jit(jax.vmap(jf.solve)). New numbers are new parameters, initial
states, times and steps."""
COMPILED = """\
First calls of jf.solve under jax.jit: tracing, compilation and the run, the scenes one after the
other in one process. Cached: in a new process, with the first one's programs in JAX's cache on disk
(jax_compilation_cache_dir)."""


def main():
    """Time the first calls that the command line asks for, and print them as JSON."""
    folder, scenes, steppers = sys.argv[1], *map(json.loads, sys.argv[2:])
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.block_until_ready(jax.jit(jnp.cumsum)(jnp.ones(3)))
    print(json.dumps(first_calls(scenes, steppers)))


if __name__ == "__main__":
    main()
