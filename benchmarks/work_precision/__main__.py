"""`python -m benchmarks.work_precision`: work against precision on eight problems, side by side.

jaxfil, SciPy, diffrax and heyoka with located contacts, and diffrax on the smoothed problem.
Writes `results/work_precision.txt` and a picture for each problem. `--only NAME` measures one
problem, writes its picture and replaces its table; `--quick` measures fewer settings and writes no
files; `--draw` measures nothing and draws the pictures of the tables that are there.
"""

import argparse
import os
import time

from benchmarks import RESULTS
from benchmarks.table import Column, table
from benchmarks.work_precision import (
    diffrax_events,
    front,
    heyoka_events,
    measure,
    ours,
    picture,
    saved,
    scipy_events,
    smoothed,
    whole_loop,
)
from benchmarks.work_precision.problems import PROBLEMS
from benchmarks.work_precision.program import LANES

TABLES = RESULTS / "work_precision.txt"
BETWEEN = "\n\n\n"  # two tables in it
PROGRAMS = (ours, diffrax_events, heyoka_events, scipy_events, smoothed)
COLUMNS = (
    Column("program"),
    Column("method"),
    Column("setting"),
    Column("error", ">.1e"),
    Column("ms", ">.3g"),
    Column("contacts", ">"),
    Column("steps", ">,"),
    Column("compile s", ">.1f"),
)
ABOUT = f"""\
Error: max |x(t1) − reference| of one trajectory. ms: median run time on one core, compilation left
out; with "/ {LANES}" a lane's share in a batch of {LANES} lanes whose initial states differ by a
thousandth. Contacts that differ from the problem's are marked "!". steps: jaxfil's are iterations,
which include those that a contact takes. compile s: what the first run took more.
jaxfil: jit(solve), jit(vmap(solve)), both with compact=False, in fixed steps and with a tolerance.
diffrax: `Event` in a loop that is compiled too. heyoka and SciPy: terminal events in a Python loop.
They have no batch here (heyoka's own, in which all lanes take events together, was not tried), so
that their single lane stands beside the others' batches.
smoothed: diffrax on tanh(H/width), without events.
"whole loop": one lane of the JAX programs under XLA_FLAGS={whole_loop.FLAG};
by default XLA calls the kernels of a loop that touches more than a kilobyte one by one.
"""


def core():
    """The last core that this process may use; None where the system does not say."""
    return max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None


def measured(name, more, quick):
    """All rows of a problem, and the programs left out."""
    problem, found, skipped = PROBLEMS[name], list(more), []
    for program in PROGRAMS:
        if reason := program.missing():
            skipped.append(f"{program.NAME} skipped: {reason}")
            continue
        for curve in program.curves(problem):
            found += measure.rows(problem, curve, quick)
    return found, skipped


def cells(problem, row):
    """One line of the table of a problem, in the order of `COLUMNS`."""
    mark = "!" if row.contacts != problem.contacts else ""
    return [
        row.program,
        row.method + (f" / {row.lanes}" if row.lanes > 1 else ""),
        f"{row.unit} {row.setting:.2g}",
        row.error,
        1e3 * row.seconds,
        None if row.program == smoothed.NAME else f"{mark}{row.contacts}",
        row.steps,
        row.compiling if row.compiling >= 0.05 else None,
    ]


def text(name, rows, skipped):
    """The table of a problem and who is in front."""
    problem = PROBLEMS[name]
    head = f"{problem.title}: t1 = {problem.t1:.6g}, {problem.contacts} contacts"
    title = f"{head}\nReference: {problem.source}."
    note = "\n".join([*skipped, *front.lines(rows), *front.plateaus(rows)])
    return table(COLUMNS, [cells(problem, row) for row in rows], title, note) + "\n"


def overview(measured):
    """How many times as long as jaxfil the fastest other program takes, at equal error."""
    columns = [Column("problem"), Column("")]
    columns += [Column(f"at {level:.0e}", ">.2g") for level in front.LEVELS]
    body = [
        [name, contest, *(front.ratio(some, level) for level in front.LEVELS)]
        for name, rows in measured.items()
        for contest, some in front.contests(rows).items()
    ]
    title = (
        "Run time of the fastest other program over jaxfil's, at equal error (above 1: in front)"
    )
    return table(columns, body, title) + "\n"


def draw(names):
    """The pictures of the tables that were written."""
    text = TABLES.read_text()
    for name in names:
        picture.draw(PROBLEMS[name], saved.rows(text, name), _path(name))


def write(found, texts):
    """Write the tables of the problems measured, beside those that are there of the others."""
    others = [name for name in PROBLEMS if name not in texts]
    if others:
        there = TABLES.read_text()
        kept = dict(zip(PROBLEMS, there.split(BETWEEN)[2:], strict=True))
        texts = {name: texts.get(name, kept[name].rstrip("\n") + "\n") for name in PROBLEMS}
        found = {name: found.get(name) or saved.rows(there, name) for name in PROBLEMS}
    parts = [ABOUT, overview(found), *(texts[name] for name in PROBLEMS)]
    TABLES.write_text(BETWEEN.join(part.removesuffix("\n") for part in parts) + "\n")


def _path(name):
    """Where the picture of a problem is."""
    return RESULTS / f"work_precision_{name}.png"


def main():
    """Measure the problems asked for; print their tables, and write them unless it is quick."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=PROBLEMS, help="one problem")
    parser.add_argument("--quick", action="store_true", help="fewer settings, no files")
    parser.add_argument("--draw", action="store_true", help="pictures of the tables there are")
    asked = parser.parse_args()
    if asked.draw:
        draw([asked.only] if asked.only else PROBLEMS)
        return
    names, begun = [asked.only] if asked.only else list(PROBLEMS), time.perf_counter()
    chosen = core()
    whole, texts, found = whole_loop.rows(names, chosen, asked.quick), [], {}
    measure.prepare(chosen)
    for name in names:
        started = time.perf_counter()
        rows, skipped = measured(name, whole[name], asked.quick)
        rows.sort(key=lambda r: [p.NAME for p in PROGRAMS].index(r.program))
        found[name] = rows
        texts.append(text(name, rows, skipped))
        print(texts[-1], f"[{time.perf_counter() - started:.0f} s]\n", sep="\n", flush=True)
        if not asked.quick:
            picture.draw(PROBLEMS[name], rows, _path(name))
    if not asked.quick:
        write(found, dict(zip(names, texts, strict=True)))
    print(overview(found), f"{time.perf_counter() - begun:.0f} s", sep="\n")


if __name__ == "__main__":
    main()
