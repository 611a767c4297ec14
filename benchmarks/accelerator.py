"""`python -m benchmarks.accelerator`: jaxfil on JAX's default backend, and on the CPU beside it.

Two tables. Problems of the bank, the end of whose motion is known, one run each: errors and times
in float64 and in float32. Sweeps of the belt and of the SD oscillator over 1,000 to 1,000,000
lanes: steps of a lane a second, first calls, and errors after 300 forcing periods on the lanes
whose motion is known. Each row is printed as soon as it is measured, and the tables are written
then to `results/accelerator.txt` or to what `--output` says. After `--minutes` nothing new begins;
what was not reached is left empty.
"""

import argparse
import itertools
import time
from pathlib import Path

from benchmarks import RESULTS
from benchmarks.accelerator_side import SAMPLES, STEPS, TRANSIENT, Side
from benchmarks.scenes import SCENES
from benchmarks.table import Column, table

DTYPES = ("float64", "float32")
# Crossings, turns and a stick; snap-through; friction; impacts; an intersection slid on.
PROBLEMS = (
    "coulomb by everything",
    "sd",
    "belt 1.3",
    "ball by everything",
    "box by everything",
    "den hartog",
)
LANES = (1000, 10_000, 100_000, 1_000_000)


def _columns(heading, form):
    return [Column(f"{heading}, {name}", form) for name in ("device", "CPU")]


# Headings, the keys of answers below them, and the form of each: a column for each side.
CELLS = {
    "problem": (
        ("error", "error", "<.0e"),
        ("s", "seconds", ">.4f"),
        ("first s", "first", ">.1f"),
        ("outcome", "outcome", "<"),
    ),
    "sweep": (
        ("steps/s", "rate", ">,.0f"),
        ("first s", "first", ">.1f"),
        ("error", "error", "<.0e"),
        ("failed", "outcome", ">"),
    ),
}
NAMES = {
    "problem": [Column("problem"), Column("dtype")],
    "sweep": [Column("sweep"), Column("dtype"), Column("lanes", ">,d")],
}
PROBLEM_NOTE = """\
One run of each. s: the median of later calls; first s: of the first, which compiles.
error: the largest of the state at the end."""
SWEEP_NOTE = f"""\
steps/s: lanes times {TRANSIENT + SAMPLES} forcing periods of {STEPS} steps of Dopri8, a second of
later calls; ratio: the device's by the CPU's. error: on lanes whose motion is known, after 300
periods. failed: lanes. One that spends its budget of iterations, 32 for each step and 100,000,
holds up those that share its loop: on a device up to 131,072, on a CPU 64."""


def columns(what):
    """The columns of a table."""
    cells = [c for heading, _, form in CELLS[what] for c in _columns(heading, form)]
    return NAMES[what] + cells + ([Column("ratio", ">.2f")] if what == "sweep" else [])


def arguments():
    """What the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accelerator", description=__doc__)
    parser.add_argument("--lanes", type=int, nargs="+", default=LANES, help="of each sweep")
    parser.add_argument("--problems", nargs="*", default=PROBLEMS, help="names in the bank")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--dtypes", nargs="+", default=DTYPES, choices=DTYPES)
    parser.add_argument("--minutes", type=float, default=6.0, help="for all of it (default 6)")
    parser.add_argument("--row", type=float, default=90.0, help="seconds of a row, at most")
    parser.add_argument("--output", type=Path, default=RESULTS / "accelerator.txt")
    return parser.parse_args()


class Both:
    """The default backend and the CPU, asked the same; where that backend is the CPU, it alone."""

    def __init__(self, minutes, row):
        self._end, self._row = time.perf_counter() + 60 * minutes, row
        self._platforms, self._sides = (None, "cpu"), [Side()]
        self.about = [self._sides[0].ask(self._row, what="about")]
        if self.about[0]["platform"] != "cpu":
            self._sides.append(Side(self._platforms[1]))
            self.about.append(self._sides[1].ask(self._row, what="about"))

    def ask(self, **request):
        """Two answers, the device's and the CPU's; an empty one where there is none."""
        answers = []
        for k, side in enumerate(self._sides):
            left = min(self._row, self._end - time.perf_counter())
            answer = side.ask(left, **request) if left > 1 else {}
            if answer is None:  # it has been ended
                self._sides[k] = Side(self._platforms[k])
            answers.append(answer or {})
        return answers if len(answers) > 1 else [{}, *answers]

    def close(self):
        """End both processes."""
        for side in self._sides:
            side.close()


def requests(args):
    """What is asked, in order: problems and small sweeps first, so that little time says much."""
    for name, dtype in itertools.product(args.problems, args.dtypes):
        yield dict(what="problem", name=name, dtype=dtype)
    for lanes, scene, dtype in itertools.product(args.lanes, args.scenes, args.dtypes):
        yield dict(what="sweep", scene=scene, dtype=dtype, lanes=lanes)


def row(request, answers):
    """The cells of a row."""
    what, *named = request.values()
    pairs = {key: [_cell(answer, key) for answer in answers] for _, key, _ in CELLS[what]}
    cells = [*named, *itertools.chain.from_iterable(pairs.values())]
    if what == "problem":
        return cells
    rates = pairs["rate"]
    return [*cells, None if None in rates else rates[0] / rates[1]]


def _cell(answer, key):
    """A value of an answer; of one that is an error, its first words."""
    if key == "outcome" and "failure" in answer:
        return answer["failure"].partition("\n")[0][:40]
    return answer.get(key)


def line(what, cells):
    """A row for whoever is waiting."""
    pairs = zip(columns(what), cells, strict=True)
    return "; ".join(f"{c.heading} {c.cell(v)}" for c, v in pairs if v is not None)


def text(about, rows):
    """Both tables."""
    names = [f"{side['platform']} ({side['device']})" for side in about]
    title = f"{' beside '.join(names)}, jax {about[0]['jax']}."
    notes = {"problem": PROBLEM_NOTE, "sweep": SWEEP_NOTE}
    parts = [
        table(columns(what), [cells for kind, cells in rows if kind == what], note=note)
        for what, note in notes.items()
    ]
    return "\n\n\n".join([title, *parts]) + "\n"


def main():
    """Ask, print and write."""
    args = arguments()
    both, rows = Both(args.minutes, args.row), []
    try:
        for request in requests(args):
            answers = both.ask(**request)
            if not any(answers):
                continue
            rows.append((request["what"], row(request, answers)))
            print(line(*rows[-1]), flush=True)
            args.output.write_text(text(both.about, rows))
    finally:
        both.close()
    print(args.output.read_text())


if __name__ == "__main__":
    main()
