"""The end of a sweep on the command line, finished or interrupted."""

import argparse
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from jaxfil.command.interruption import INTERRUPTED
from jaxfil.command.picture import written
from jaxfil.model.outcomes import RESULTS, outcome_names
from jaxfil.sweep.interrupt import Interrupts


@contextmanager
def told_here() -> Iterator[None]:
    """Suppress the warning of an interrupted sweep, which `ended` reports instead."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The sweep was interrupted", RuntimeWarning)
        yield


def ended(
    args: argparse.Namespace,
    results: RESULTS,
    interrupts: Interrupts,
    keep: Callable[[], None],
    summary: Callable[[], str],
) -> int:
    """Draw and save the finished lanes by `keep`, print a summary, and return the exit code."""
    outcomes = outcome_names(results)
    finished = int((outcomes != "interrupted").sum())
    if not finished:
        print("jaxfil: interrupted before a lane was finished", file=sys.stderr)
        return INTERRUPTED
    keep()
    if finished < outcomes.size:
        lanes = f"{finished} of {outcomes.size} lanes are finished"
        print(f"jaxfil: interrupted: {lanes}; {written(args)}", file=sys.stderr)
        return INTERRUPTED
    if not args.quiet:
        print(summary())
    if interrupts.count:  # during drawing
        return INTERRUPTED
    return 0 if (outcomes == "successful").any() else 1
