"""heyoka: Taylor series of high order with terminal events, an integrator for each mode.

A problem and a tolerance enter; the state at the end leaves. The formulas are put through heyoka's
own expressions and compiled by it; the loop from contact to contact is Python's.
"""

import functools as ft

import numpy as np

from benchmarks import installed
from benchmarks.work_precision.program import MOST_CONTACTS, Curve, Run

NAME = "heyoka"
# A slip begins at a double zero of H, of which rounding makes two simple ones or none: zeros this
# soon after a start are that one. heyoka's own guess of this time is a whole period there.
COOLDOWN = 1e-6


def missing():
    """Why it cannot run; empty where it can."""
    return installed.missing("heyoka")


def curves(problem):
    """The curves that are measured on a problem."""
    yield Curve(
        NAME, "Taylor", (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15), ft.partial(_build, problem)
    )


def _build(problem, tolerance):
    """A function of no arguments for one setting."""
    return ft.partial(follow, problem, integrators(problem, tolerance))


def integrators(problem, tolerance, kind=float):
    """{mode: an integrator that stops where the mode ends}."""
    import heyoka as hy

    x, made = hy.make_vars("x1", "x2"), {}
    for mode in (1, -1) if problem.slide is None else (1, -1, 0):
        rates = [
            hy.expression(r) if isinstance(r, float) else r
            for r in problem.rate(mode, hy.time, x, hy)
        ]
        guard = problem.guard(mode, hy.time, x, hy)
        event = hy.t_event(
            guard, direction=hy.event_direction.negative, cooldown=kind(COOLDOWN), fp_type=kind
        )
        made[mode] = hy.taylor_adaptive(
            list(zip(x, rates, strict=True)),
            [kind(0), kind(0)],
            tol=kind(tolerance),
            t_events=[event],
            fp_type=kind,
        )
    return made


def follow(problem, made, kind=float):
    """From contact to contact until t1."""
    import heyoka as hy

    t, x, mode = kind(0), tuple(map(kind, problem.x0)), problem.first_mode()
    steps = 0
    for contacts in range(MOST_CONTACTS):
        ta = made[mode]
        ta.time, ta.state[:] = t, x
        ta.reset_cooldowns()
        outcome, _, _, count, *_ = ta.propagate_until(kind(problem.t1))
        if int(outcome) == -1 and ta.time - t < COOLDOWN:
            # The contact that it comes from: heyoka knows it now and goes on past it.
            outcome, _, _, count, *_ = ta.propagate_until(kind(problem.t1))
        steps += count
        if outcome == hy.taylor_outcome.time_limit:
            return Run(np.array(ta.state, float), contacts, steps)
        t = ta.time
        mode, x = problem.after(mode, t, tuple(ta.state))
    return Run(np.full(2, np.nan), MOST_CONTACTS, steps)
