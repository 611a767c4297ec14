"""`python -m benchmarks.taylor`: sweeps by power series beside Dopri8, at equal error.

Sweeps of systems with contacts, by `jf.Taylor(12)` and by `diffrax.Dopri8()` with several numbers
of steps a period; errors are those of lanes whose motion is known to 1e-9 from two finer runs.
Writes `results/taylor.txt`: processor time of both at equal error, in turns, and first calls.
"""

import math
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks import RESULTS
from benchmarks.report import rate_at
from benchmarks.table import Column, table
from benchmarks.timing import processor_timed

LANES, TRANSIENT, SAMPLES, REPEATS = 512, 100, 20, 5
# Steps of the converged runs; lanes on which they differ by more are not judged.
FINE, CALM = (200, 300), 1e-9
LEVELS = (1e-6, 1e-8, 1e-10, 1e-12)
COLUMNS = (
    Column("sweep"),
    Column("lanes judged", ">d"),
    *(Column(f"at {level:.0e}", ">.2f") for level in LEVELS),
    Column("first call, s: Taylor", ">.1f"),
    Column("Dopri8", ">.1f"),
)
ABOUT = f"""\
Processor time of `jf.Taylor(12)` as a part of that of Dopri8, medians of {REPEATS} in turns,
{LANES} lanes, {TRANSIENT + SAMPLES} periods, at these errors: the median over judged lanes of the
largest error of a sample, or at smaller ones. Between numbers of steps times and errors are
interpolated; what does not get there has no entry. Programs are written out; both belts are one
program, compiled for the first of them.
"""


class TwoBlocks(jf.System):
    """Two blocks, coupled by a cubic spring, each on a belt of its own that rubs."""

    omega: jax.Array

    def vector_field(self, t, x, side):
        a, b, u, v = x
        stretch = b - a
        pull = stretch + 0.5 * stretch**3
        force = jnp.cos(self.omega * t)
        return jnp.stack([u, v, force - a + pull - 0.3 * side[0], -b - pull - 0.3 * side[1]])

    def switching(self, t, x):
        return jnp.stack([x[2] - 0.4, x[3] - 0.4])

    @property
    def period(self):
        return 2 * math.pi / self.omega


class Sweep(NamedTuple):
    """What is swept over ω, and the numbers of steps a period of both."""

    system: jf.System
    low: float
    high: float
    x0: tuple[float, ...]
    taylor: tuple[int, ...]
    dopri8: tuple[int, ...]


SWEEPS = {
    "SD oscillator": Sweep(
        jf.systems.SDOscillator(), 0.6, 1.3, (0.3, 0.1), (6, 8, 11, 16), (8, 12, 18, 26, 40)
    ),
    "impact oscillator": Sweep(
        jf.systems.ImpactOscillator(), 0.7, 1.4, (0.3, 0.1), (6, 8, 10, 14), (6, 9, 14, 20, 30)
    ),
    "belt, cubic spring": Sweep(
        jf.systems.BeltFriction(), 4.2, 4.7, (0.0, 0.0), (32, 44, 60, 84), (26, 40, 60, 84, 120)
    ),
    "belt, linear spring": Sweep(
        jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0),
        1.2,
        1.6,
        (0.0, 0.0),
        (8, 12, 16, 24),
        (12, 18, 26, 40, 60),
    ),
    "two blocks, coupled": Sweep(
        TwoBlocks(jnp.asarray(1.0)), 0.8, 1.3, (0.0,) * 4, (16, 22, 30, 42), (14, 20, 30, 44, 64)
    ),
}


def diagram(sweep, stepper, steps):
    """The samples of a sweep."""
    omegas = np.linspace(sweep.low, sweep.high, LANES)
    found = jf.bifurcation_diagram(
        sweep.system,
        "omega",
        omegas,
        np.array(sweep.x0),
        transient=TRANSIENT,
        samples=SAMPLES,
        steps=steps,
        stepper=stepper,
        progress=False,
        compact=False,
    )
    return np.where(found.successful[:, None, None], found.xs, np.nan)


def seconds(sweep, stepper, steps):
    """Processor time of one run."""
    return processor_timed(lambda: diagram(sweep, stepper, steps))[1]


def curve(sweep, stepper, counts, exact, calm):
    """The median error at each number of steps."""
    errors = [np.abs(diagram(sweep, stepper, n) - exact).max((1, 2))[calm] for n in counts]
    return [float(np.median(error)) for error in errors]


def rates(errors, times):
    """Runs as `report.rate_at` reads them."""
    each = zip(errors, times, strict=True)
    return [{"method": "", "error": error, "rates": {"1": 1 / time}} for error, time in each]


def row(name, sweep):
    """The cells of a sweep."""
    taylor, dopri8, firsts = jf.Taylor(12), diffrax.Dopri8(), []
    for stepper, counts in ((taylor, sweep.taylor), (dopri8, sweep.dopri8)):
        firsts.append(seconds(sweep, stepper, counts[0]))
    exact, other = (diagram(sweep, dopri8, steps) for steps in FINE)
    calm = np.abs(exact - other).max((1, 2)) < CALM
    errors = curve(sweep, taylor, sweep.taylor, exact, calm)
    others = curve(sweep, dopri8, sweep.dopri8, exact, calm)
    runs = [[], []]
    for _ in range(REPEATS):
        runs[0].append([seconds(sweep, taylor, n) for n in sweep.taylor])
        runs[1].append([seconds(sweep, dopri8, n) for n in sweep.dopri8])
    mine, theirs = (np.median(v, axis=0) for v in runs)
    ratios = []
    for level in LEVELS:
        pair = rate_at(rates(errors, mine), level, 1), rate_at(rates(others, theirs), level, 1)
        ratios.append(None if None in pair else pair[1] / pair[0])
    return name, int(calm.sum()), *ratios, *firsts


def main():
    """Measure, print and write."""
    rows = []
    for name, sweep in SWEEPS.items():
        rows.append(row(name, sweep))
        print(*(c.cell(v) or "-" for c, v in zip(COLUMNS, rows[-1], strict=True)), flush=True)
    text = table(COLUMNS, rows, title=ABOUT.rstrip()) + "\n"
    (RESULTS / "taylor.txt").write_text(text)
    print(text)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
