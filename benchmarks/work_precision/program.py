"""What the programs have in common: what a run gives, and a curve of runs.

An initial state and a number of lanes enter; their initial states leave.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

MOST_CONTACTS = 100
"""A run with more than this fails: none of the problems has a fifth as many."""


class Run(NamedTuple):
    """The state at the end, contacts and steps; an axis of lanes first, where there are several."""

    x: Any
    contacts: Any
    steps: Any


class Curve(NamedTuple):
    """A program at several settings. `build(setting)` gives a function of no arguments that makes a
    run; what is compiled is compiled in `build` or in the first run."""

    program: str
    method: str
    settings: Sequence[float]
    build: Callable
    lanes: int = 1
    unit: str = "rtol"


LANES = 256
"""Lanes of a batch."""


def spread(x0, lanes):
    """Initial states, (lanes, 2), the first of them `x0` and the others within a thousandth of it;
    of shape (2,) for a single lane."""
    if lanes == 1:
        return np.asarray(x0)
    return np.asarray(x0) + 1e-3 * np.linspace(0, 1, lanes)[:, None] * np.array([1.0, 0.0])
