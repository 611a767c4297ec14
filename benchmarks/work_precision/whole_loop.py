"""One lane of the JAX programs again, their loops compiled whole.

XLA compiles a loop on the CPU as one function if an iteration touches less than a kilobyte; else
each of its kernels is a call of its own, which for one lane costs more than the arithmetic. An
option of XLA moves that limit; it can be set only before JAX starts, hence in a process of its own.
Names of problems enter; rows leave.
"""

import argparse
import json
import os
import subprocess
import sys

FLAG = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000"
NOTE = ", whole loop"


def rows(names, core, quick=False):
    """{name: rows} of a process that runs `main` with the option set."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {FLAG}".strip()
    command = [sys.executable, "-m", __name__, *names, "--core", str(core)]
    done = subprocess.run(
        command + ["--quick"] * quick,
        env={**os.environ, "XLA_FLAGS": flags},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    from benchmarks.work_precision.measure import Row

    found = json.loads(done.stdout)
    return {name: [Row(*row) for row in some] for name, some in found.items()}


def main():
    """Print the rows of the problems named, as JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="+")
    parser.add_argument("--core", type=int)
    parser.add_argument("--quick", action="store_true")
    asked = parser.parse_args()
    from benchmarks.work_precision import diffrax_events, measure, ours
    from benchmarks.work_precision.problems import PROBLEMS

    measure.prepare(asked.core)
    found = {}
    for name in asked.names:
        curves = [
            curve._replace(method=curve.method + NOTE)
            for program, method in ((ours, "Dopri8"), (diffrax_events, "Tsit5"))
            for curve in program.curves(PROBLEMS[name])
            if curve.lanes == 1 and curve.method == method
        ]
        found[name] = [r for c in curves for r in measure.rows(PROBLEMS[name], c, asked.quick)]
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
