"""`python -m benchmarks.paper [FIGURE ...]`: Santhosh, Narayanan and Padmanabhan (2016), anew.

*Discontinuity induced bifurcations in nonlinear systems*, Procedia IUTAM 19 (2016) 219–227. Makes
the figures named, all by default: for each a picture and a table of what the paper prints, what
jaxfil finds, an independent reference, and why they differ. Writes `results/FIGURE.png` and
`results/FIGURE.txt` (or into `--out`), and prints the tables and the seconds each took. Figures are
made side by side, one for each core.
"""

import argparse
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from benchmarks import RESULTS
from benchmarks.paper.figure import FIGURES, make

# The longest ones first, so that no core is left with one of them at the end.
SLOWEST = ("fig10", "fig11", "fig8", "fig5", "fig6", "fig9", "fig4", "section5")


def main():
    """Make the figures asked for, side by side."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=__doc__)
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help=", ".join(FIGURES))
    parser.add_argument("--out", type=Path, default=RESULTS, help="default: benchmarks/results")
    args = parser.parse_args()
    unknown = set(args.figures) - set(FIGURES)
    if unknown:
        parser.error(f"no figure {', '.join(sorted(unknown))}: choose from {', '.join(FIGURES)}")
    args.out.mkdir(parents=True, exist_ok=True)
    begun = time.perf_counter()
    names = sorted(args.figures or FIGURES, key=SLOWEST.index)
    workers = min(len(names), os.cpu_count() or 1)
    # Spawned, not forked: XLA has threads. Much of the time is compilation, which uses one core.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for job in as_completed([pool.submit(make, name, args.out) for name in names]):
            print(job.result(), flush=True)
    print(f"all: {time.perf_counter() - begun:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
