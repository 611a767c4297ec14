"""The record of a problem and of what is known of its motion."""

import dataclasses
from collections.abc import Callable

import numpy as np

import jaxfil as jf


@dataclasses.dataclass(frozen=True)
class Problem:
    """A system, its start and time span, and what is known of the motion.

    `end` and `mode` are those at `t1`, or where the motion ends by `outcome`. `ts`, `kinds` and
    `before` are the contacts: their times, kinds and the states just before, from the first on.
    `orbit_modes` are the modes of an orbit at t = 0 and after each contact, `highest` its largest
    second component, `digits` the tolerance to which its multipliers are known.
    `flow(system, x0, t0, t1)` is the end in closed form. `dt` is a step that gives `atol`, of
    states (a tuple: of their components), and `t_atol`, of times; it is `atol` if None.
    """

    system: jf.System
    x0: tuple
    t1: float
    dt: float
    tags: str
    source: str = "by hand"
    t0: float = 0.0
    end: tuple | None = None
    mode: tuple | None = None
    ts: tuple | np.ndarray | None = None
    kinds: list | None = None
    before: list | None = None
    outcome: str = "successful"
    ends_at: float | None = None
    atol: float | tuple = 1e-12
    t_atol: float | tuple | None = None
    multipliers: list | None = None
    digits: float | None = None
    highest: float | None = None
    orbit_modes: list | None = None
    flow: Callable | None = None
