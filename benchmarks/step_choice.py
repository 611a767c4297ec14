"""`python -m benchmarks.step_choice`: does a chosen step keep its promise?

The eight problems of `benchmarks.work_precision` enter, with answers from elsewhere;
`results/step_choice.txt` leaves: what `jf.choose_step` chose at each tolerance, the error that it
told, and the true one. `--only NAME` prints the rows of one problem and writes nothing.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks import RESULTS
from benchmarks.table import Column, table
from benchmarks.work_precision.ours import scenes
from benchmarks.work_precision.problems import PROBLEMS

TOLERANCES = (1e-5, 1e-8, 1e-10)
COLUMNS = (
    Column("problem"),
    Column("tolerance", ">.0e"),
    Column("stepper"),
    Column("steps", ">"),
    Column("error told", ">.1e"),
    Column("true error", ">.1e"),
    Column("true / tolerance", ">.2f"),
    Column("µs a lane", ">.0f"),
)
TITLE = "What jf.choose_step chooses of RK4, Tsit5 and Dopri8"
NOTE = """\
Errors: max |x(t1) − reference| relative to max |x(t1)|; the true ones are against the references of
`python -m benchmarks.work_precision`. Steps are those of a forcing period, or of the whole span
where there is none. Run times are those of the machine at hand, and decide between steppers."""


def rows(name):
    """The rows of one problem."""
    problem, (system, _) = PROBLEMS[name], scenes()[name]
    x0, reference = jnp.asarray(problem.x0), np.asarray(problem.reference)
    for tolerance in TOLERANCES:
        choice = jf.choose_step(system, x0, 0.0, problem.t1, tolerance=tolerance)
        sol = jf.solve(system, x0, 0.0, problem.t1, choice, max_events=None)
        true = np.max(abs(sol.x_final - reference)) / np.max(abs(reference))
        stepper, micro = type(choice.stepper).__name__, 1e6 * choice.seconds
        told = name, tolerance, stepper, choice.steps, choice.error, true
        yield *told, true / tolerance, micro


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", choices=PROBLEMS, metavar="NAME")
    only = parser.parse_args().only
    found = [row for name in ([only] if only else PROBLEMS) for row in rows(name)]
    text = table(COLUMNS, found, TITLE, NOTE)
    print(text)
    if only is None:
        (RESULTS / "step_choice.txt").write_text(f"{text}\n")
