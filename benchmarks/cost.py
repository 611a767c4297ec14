"""`python -m benchmarks.cost`: what a scene costs, in operations, time, compilation and memory.

Nothing enters; the sections' texts leave, on standard output and in `results/cost.txt` (with
`--quick`, for a look, or with `--only`, on standard output alone).
"""

import argparse
import time

import jax

from benchmarks import RESULTS, cost_calls, cost_first, cost_ladder, cost_memory, cost_single

SECTIONS = {
    "ladder": cost_ladder,
    "calls": cost_calls,
    "first": cost_first,
    "single": cost_single,
    "memory": cost_memory,
}


def main():
    """Print the sections asked for; write them all unless it is a quick run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cost", description=__doc__)
    parser.add_argument("--only", choices=SECTIONS, help="one section")
    parser.add_argument("--quick", action="store_true", help="fewer repeats")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # Seconds of compilation are those of a first one.
    jax.config.update("jax_enable_compilation_cache", False)
    begun, texts = time.perf_counter(), []
    for name in [args.only] if args.only else SECTIONS:
        started = time.perf_counter()
        texts.append(SECTIONS[name].report(args.quick))
        print(texts[-1], f"[{time.perf_counter() - started:.0f} s]\n", sep="\n", flush=True)
    if not args.quick and not args.only:
        about = "Measured on a CPU."
        (RESULTS / "cost.txt").write_text("\n\n\n".join([about, *texts]) + "\n")
    print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
