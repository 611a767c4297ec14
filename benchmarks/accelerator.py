"""`python -m benchmarks.accelerator`: jaxfil on JAX's default backend, and on the CPU beside it.

Two tables. Problems of the bank, the end of whose motion is known, one run each: errors and times
in float64 and in float32. Sweeps of the belt and of the SD oscillator over 1,000 to 1,000,000
lanes: steps of a lane a second, first calls, and errors after 300 forcing periods on the lanes
whose motion is known. Each row is printed as soon as it is measured, and the tables are written
then to `results/accelerator.txt` or to what `--output` says. After `--minutes` nothing new begins;
what was not reached is left empty.
"""

import argparse
import functools
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
# Of two sides, the device's first.
_SIDES = ("device", "CPU")


def _columns(names, form, heading):
    return [Column(f"{heading}, {name}", form) for name in names]


COLUMNS = {
    "problem": [
        Column("problem"),
        Column("dtype"),
        *_columns(_SIDES, "<.0e", "error"),
        *_columns(_SIDES, ">.4f", "s"),
        *_columns(_SIDES, ">.1f", "first s"),
        Column("outcome"),
    ],
    "sweep": [
        Column("sweep"),
        Column("dtype"),
        Column("lanes", ">,d"),
        *_columns(_SIDES, ">,.0f", "steps/s"),
        Column("ratio", ">.2f"),
        *_columns(_SIDES, ">.1f", "first s"),
        *_columns(_SIDES, "<.0e", "error"),
        Column("outcome"),
    ],
}


def arguments():
    """What the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accelerator", description=__doc__)
    parser.add_argument("--lanes", type=int, nargs="+", default=LANES, help="of each sweep")
    parser.add_argument("--problems", nargs="*", default=PROBLEMS, help="names in the bank")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--dtypes", nargs="+", default=DTYPES, choices=DTYPES)
    parser.add_argument("--minutes", type=float, default=5.0, help="for all of it (default 5)")
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
    each = functools.partial(_each, answers)
    outcome = ", ".join(dict.fromkeys(_outcome(a) for a in answers if a))
    if request["what"] == "problem":
        name = [request["name"], request["dtype"]]
        return [*name, *each("error"), *each("seconds"), *each("first"), outcome]
    rates = each("rate")
    ratio = rates[0] / rates[1] if None not in rates else None
    name = [request["scene"], request["dtype"], request["lanes"]]
    return [*name, *rates, ratio, *each("first"), *each("error"), outcome]


def _each(answers, key):
    return [answer.get(key) for answer in answers]


def _outcome(answer):
    return answer.get("outcome") or answer["failure"].partition("\n")[0][:60]


def text(about, rows):
    """Both tables."""
    names = [f"{side['platform']} ({side['device']})" for side in about]
    title = f"{' beside '.join(names)}, jax {about[0]['jax']}."
    notes = {
        "problem": "One run of each. s: the median of later calls; first s: of the first, which "
        "compiles.\nerror: the largest of the state at the end.",
        "sweep": f"steps/s: lanes times {TRANSIENT + SAMPLES} forcing periods of {STEPS} steps of "
        "Dopri8, a second of later calls.\nerror: on lanes whose motion is known, after 300 "
        "periods.",
    }
    parts = [
        table(COLUMNS[what], [cells for kind, cells in rows if kind == what], note=notes[what])
        for what in COLUMNS
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
            columns = COLUMNS[request["what"]]
            cells = zip(columns, rows[-1][1], strict=True)
            print("; ".join(f"{c.heading} {c.cell(v)}" for c, v in cells if v), flush=True)
            args.output.write_text(text(both.about, rows))
    finally:
        both.close()
    print(args.output.read_text())


if __name__ == "__main__":
    main()
