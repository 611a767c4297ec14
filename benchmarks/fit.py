"""`python -m benchmarks.fit`: friction and restitution of a block from noisy measurements.

The block of `tests.oracles.block` slides on a spring beside a wall. Nothing enters;
`results/fit.txt` leaves: what `jf.fit` finds from four guesses, and SciPy's `least_squares` over
`solve_ivp` with located contacts, each against the best fit of the motion in closed form, with
processor times.
"""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import jaxfil as jf
from benchmarks import RESULTS
from benchmarks.table import Column, table
from benchmarks.timing import processor_timed
from tests.oracles.block import GUESSES, NAMES, TRUE, TS, X0, Block, data, motion, seen, stepped

COLUMNS = (
    Column("program"),
    Column("guess"),
    Column("friction", "<.12f"),
    Column("restitution", "<.12f"),
    Column("off the best fit", ">.1e"),
    Column("sum of squares", ">.3e"),
    Column("first s", ">.2f"),
    Column("then s", ">.3f"),
)
TITLE = "Friction and restitution from 45 measurements with noise of 1e-3 (0.12 and 0.7 in truth)"
NOTE = """\
off the best fit: largest distance from that of the motion in closed form by least_squares at 1e-15.
Times are processor times, of all four guesses for jaxfil, which searches from all of them in one
call, and compiles in the first. solve_ivp: DOP853 at rtol = 1e-9, stopped at every turn and impact;
least_squares takes its derivatives by differences, as it does by itself. A guess with an impact too
few ends in another best fit, which has an impact too few as well: in both programs. Where there is
no impact at all nothing says what the restitution is, and it stays what it was."""


def measure():
    """The rows of the table."""
    measured = data()
    best = scipy.optimize.least_squares(
        lambda v: motion(v) - measured, TRUE, x_scale=TRUE, xtol=1e-15, ftol=1e-15
    ).x

    def fit():
        start = Block(0.1, 0.8)
        given = {"observe": seen, "guesses": GUESSES, "throw": False}
        return jf.fit(start, NAMES, TS, measured, jnp.asarray(X0), 0.05, **given)

    (found, first), (_, then) = processor_timed(fit), processor_timed(fit)
    for i, guess in enumerate(GUESSES):
        values = np.asarray(found.all_values[i])
        times = (first, then) if i == 0 else (None, None)
        off = np.max(abs(values - best))
        yield "jaxfil", str(guess), *values, off, 2 * float(found.costs[i]), *times
    for guess in GUESSES:
        ended, seconds = processor_timed(
            lambda guess=guess: scipy.optimize.least_squares(lambda v: stepped(v) - measured, guess)
        )
        off = np.max(abs(ended.x - best))
        yield "SciPy", str(guess), *ended.x, off, 2 * ended.cost, None, seconds


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    text = table(COLUMNS, measure(), TITLE, NOTE)
    print(text)
    (RESULTS / "fit.txt").write_text(f"{text}\n")
