"""Error and run time of one setting of a program.

A problem and a curve enter; rows leave.
"""

import os
import statistics
import time
from typing import NamedTuple

import jax
import numpy as np


class Row(NamedTuple):
    """`error` is max |x(t1) − reference|, NaN where t1 was not reached; `seconds` a lane's share of
    the median run; `compiling` what the first run took more, with all that was built for it."""

    program: str
    method: str
    lanes: int
    setting: float
    unit: str
    error: float
    seconds: float
    compiling: float
    contacts: int
    steps: int


def prepare(core):
    """Float64, and this process on one core, where the system lets it choose."""
    if core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_platforms", "cpu")


def rows(problem, curve, quick=False):
    """A row for each setting; a quick run has the first and the third."""
    settings = list(curve.settings)[: 3 if quick else None : 2 if quick else 1]
    return [_row(problem, curve, setting, quick) for setting in settings]


def _row(problem, curve, setting, quick):
    """One setting: its first run, and repeated ones."""
    begun = time.perf_counter()
    call = curve.build(setting)
    run = jax.block_until_ready(call())
    first = time.perf_counter() - begun
    spent = _times(call, quick)
    median = statistics.median(spent)
    x, contacts, steps = (np.asarray(v) if curve.lanes == 1 else np.asarray(v)[0] for v in run)
    return Row(
        curve.program,
        curve.method,
        curve.lanes,
        setting,
        curve.unit,
        float(np.abs(x - problem.reference).max()),
        median / curve.lanes,
        max(first - median, 0.0),
        int(contacts),
        int(steps),
    )


def _times(call, quick):
    """Seconds of repeated calls: for a twentieth of a second, at most a hundred and at least three,
    unless they take half a second."""
    spent, enough = [], 0.02 if quick else 0.05
    while sum(spent) < enough or (len(spent) < 3 and sum(spent) < 0.5):
        if len(spent) == 100:
            break
        begun = time.perf_counter()
        jax.block_until_ready(call())
        spent.append(time.perf_counter() - begun)
    return spent
