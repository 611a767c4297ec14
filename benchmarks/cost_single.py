"""float32 beside float64: rate and error of diagrams of both workloads.

The workloads of `scenes` enter; the text of a table leaves. Rates are by the processor's time, so
those of one core; errors are of the judged lanes' section points, as in `throughput`.
"""

import time
from collections import Counter

import numpy as np

import jaxfil as jf
from benchmarks import reference
from benchmarks.peers import jaxfil_sweep
from benchmarks.scenes import SCENES
from benchmarks.table import Column, table
from jaxfil.model.outcomes import outcome_names

SETTINGS = [dict(stepper="Dopri8", steps=n) for n in (16, 25, 40, 64)]
SETTINGS += [dict(stepper="RK4", steps=n) for n in (100, 200)]
LANES, DTYPES = 1000, (np.float64, np.float32)


def run(scene, omegas, setting, dtype):
    """The diagram of all lanes, and the processor's seconds."""
    start = time.process_time()
    diagram = jf.bifurcation_diagram(
        jaxfil_sweep.system(scene),
        "omega",
        omegas,
        np.array(scene.x0, dtype),
        transient=reference.TRANSIENT,
        samples=reference.SAMPLES,
        steps=setting["steps"],
        stepper=jaxfil_sweep.stepper(setting["stepper"]),
        progress=False,
        compact=False,
    )
    return diagram, time.process_time() - start


def measure(scene, setting, dtype, lanes):
    """(rate in lane-periods per second, largest error, outcomes of the lanes that failed)."""
    omegas = scene.omegas(lanes)
    run(scene, omegas * 1.001, setting | dict(steps=2), dtype)  # compiles
    diagram, seconds = run(scene, omegas, setting, dtype)
    picks = [int(np.flatnonzero(omegas == omega)[0]) for omega in scene.judged]
    error = np.abs(np.asarray(diagram.xs)[picks] - reference.load(scene)).max()
    outcomes = Counter(str(name) for name in outcome_names(diagram.results))
    rate = lanes * (reference.TRANSIENT + reference.SAMPLES) / seconds
    return rate, error, outcomes - Counter(successful=lanes)


def report(quick):
    """The section's text."""
    lanes, body = (64, []) if quick else (LANES, [])
    failed = {dtype: Counter() for dtype in DTYPES}
    for scene in SCENES.values():
        for setting in SETTINGS[:: 2 if quick else 1]:
            line, rates = [scene.name, jaxfil_sweep.label(setting)], []
            for dtype in DTYPES:
                rate, error, outcomes = measure(scene, setting, dtype, lanes)
                failed[dtype] += outcomes
                rates.append(rate)
                line += [rate, error, outcomes.total()]
            body.append([*line, rates[1] / rates[0]])
    title = f"float32: lane-periods per second of one core, {lanes:,} lanes"
    told = [
        f"{dtype.__name__}: " + (", ".join(f"{n} {name}" for name, n in found.items()) or "none")
        for dtype, found in failed.items()
    ]
    return table(COLUMNS, body, title, f"{ABOUT}{'; '.join(told)}.")


COLUMNS = (
    Column("scene"),
    Column("stepper, steps"),
    Column("float64", ">,.0f"),
    Column("error", ">.1e"),
    Column("failed", ">"),
    Column("float32", ">,.0f"),
    Column("error", ">.1e"),
    Column("failed", ">"),
    Column("float32 / float64", ">.2f"),
)
ABOUT = """\
float32's frequencies are rounded too, to 6e-8 of their size, and what that does to the motion is
part of its error. Outcomes of the lanes that failed, all rows of each precision together: """
