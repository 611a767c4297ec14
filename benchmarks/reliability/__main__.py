"""`python -m benchmarks.reliability`: thousands of random problems against independent answers.

`--systems N` (10,000 relays, and other families in proportion), `--seed S` and `--only FAMILY`
enter; `results/reliability.txt` leaves: a line for each group of problems, and below the table one
for each problem that came out wrong or was refused, by its number, which together with the seed
makes it again.
"""

import argparse
import time

import jax

from benchmarks import RESULTS
from benchmarks.reliability import cases, derivatives, faults, mechanics, relays, smooth, walls
from benchmarks.reliability.verdict import COLUMNS, totals
from benchmarks.table import table

FAMILIES = {
    "relays": relays.groups,
    "impacts": walls.groups,
    "mechanics": mechanics.groups,
    "smooth": smooth.groups,
    "derivatives": derivatives.groups,
    "cases": cases.groups,
    "faults": faults.groups,
}


NOTE = """\
RIGHT: successful, with the contacts (kinds, surfaces, times, states) and the end of the answer
within 1e-9 of the motion's size, or within 1e-12 times what a change of the system by 1 does to
the motion (smooth fields: 1e-11, of DOP853 at 1e-13; derivatives: 1e-7 of the largest; cases: what
each states, mostly 1e-10; faults: the same bits). Contacts of an accumulation are left out.
Told rightly: another outcome, where the answer is not unique, undecided or has more contacts than
the table holds, or is within rounding. Within rounding: successful and unlike the answer, whose
least margin (of a graze, a corner, a tangency) is below 1e-7 of its terms, which double precision
cannot decide; of mechanics, whose start changed by 1e-13 leads elsewhere."""


def report(groups, seed):
    """The table and the lines below it."""
    rows = [group.cells() for group in groups]
    title = f"Random problems of seed {seed} against independent answers"
    lines = [line for group in groups for line in group.lines()]
    note = "\n".join(lines) or "Nothing came out wrong or was refused."
    return table(COLUMNS, [*rows, totals(groups)], title, f"{NOTE}\n\n{note}") + "\n"


def main(arguments=None):
    """Run the families asked for; print the table, and write it where all were run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reliability")
    parser.add_argument("--systems", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=FAMILIES)
    parser.add_argument("--output", default=RESULTS / "reliability.txt")
    given = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    groups = []
    for name in [given.only] if given.only else FAMILIES:
        started = time.perf_counter()
        for group in FAMILIES[name](given.systems, given.seed):
            groups.append(group)
            print(*map(str, group.cells()), flush=True)
            print(*group.lines(), sep="\n", flush=True)
        print(f"{name}: {time.perf_counter() - started:.0f} s", flush=True)
    text = report(groups, given.seed)
    print(text)
    if not given.only:
        with open(given.output, "w") as file:
            file.write(text)
    return groups


if __name__ == "__main__":
    main()
