"""SciPy: `solve_ivp` with a terminal event, one call for each stay in a mode.

A problem, a method and a tolerance enter; the state at the end leaves.
"""

import functools as ft
import math

import numpy as np

from benchmarks import installed
from benchmarks.work_precision.program import MOST_CONTACTS, Curve, Run

NAME = "SciPy"
METHODS = {
    "RK45": (1e-4, 1e-6, 1e-8, 1e-10),
    "DOP853": (1e-4, 1e-6, 1e-8, 1e-10, 1e-12),
    "Radau": (1e-4, 1e-6),
    "LSODA": (1e-4, 1e-6, 1e-8, 1e-10, 1e-12),
}


def missing():
    """Why it cannot run; empty where it can."""
    return installed.missing("scipy", "SciPy")


def curves(problem):
    """The curves that are measured on a problem."""
    for method, settings in METHODS.items():
        yield Curve(NAME, method, settings, ft.partial(_build, problem, method))


def _build(problem, method, rtol):
    """A function of no arguments for one setting."""
    return ft.partial(follow, problem, method, rtol)


def follow(problem, method, rtol):
    """From contact to contact until t1."""
    from scipy.integrate import solve_ivp

    t, x, mode, steps = 0.0, problem.x0, problem.first_mode(), 0
    for contacts in range(MOST_CONTACTS):

        def rate(t, x, mode=mode):
            return problem.rate(mode, t, x, math)

        def guard(t, x, start=t, mode=mode):
            # What starts on the surface leaves it: that zero is no contact.
            return problem.guard(mode, t, x, math) if t > start else 1.0

        guard.terminal, guard.direction = True, -1
        sol = solve_ivp(
            rate,
            (t, problem.t1),
            x,
            method,
            events=guard,
            rtol=rtol,
            atol=rtol,
            max_step=problem.pace if mode == 0 else np.inf,
        )
        steps += len(sol.t) - 1
        if sol.status != 1:
            return Run(sol.y[:, -1], contacts, steps)
        t = float(sol.t_events[0][0])
        mode, x = problem.after(mode, t, tuple(sol.y_events[0][0].tolist()))
    return Run(np.full(2, np.nan), MOST_CONTACTS, steps)
