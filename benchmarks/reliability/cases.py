"""Motions on which trusted codes have failed, each with its exact answer.

Nothing enters but the number of systems that other families are asked for, which changes nothing
here; a group of verdicts for each subject leaves. A case is solved at its step, and compared at its
end, or is expected to stop at a certain time with a certain outcome.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.reliability import case_systems as S, special_cases
from benchmarks.reliability.closed_forms import (
    CRADLE_END,
    FALL,
    LARGE,
    at_the_wall,
    ball,
    begun,
    leaves_the_table,
    oscillation,
    pulled,
    slow,
)
from benchmarks.reliability.verdict import Group, Verdict
from jaxfil.model.outcomes import outcome_names


class Case(NamedTuple):
    """`end` is the state at t1, or where the motion stops at `stops` with the outcome `outcome`."""

    subject: str
    name: str
    system: Any
    x0: tuple
    t1: float
    dt: float
    end: Any
    outcome: str = "successful"
    stops: float | None = None
    mode: tuple | None = None
    t0: float = 0.0
    atol: float = 1e-10
    dtype: str = "float64"


STARTS, IMPACTS, REST = "starts and restarts", "resets", "rest after impacts"
UNIQUE, POINT, STEPS = "not unique", "accumulation at a point", "steps and contacts"


def starts():
    """On a surface at t0."""
    wall = jf.systems.ImpactOscillator(
        wall=0.0, amplitude=1.0, omega=2.0, restitution=0.8, damping=0.0, stiffness=1.0
    )
    return [
        Case(STARTS, "on the floor, moving down", ball(0.5), (0, -2), 0.1, 0.01, (0.051, 0.02)),
        Case(STARTS, "on the floor, moving up", ball(0.5), (0, 2), 0.1, 0.01, begun(0.1)),
        Case(STARTS, "1e-15 above the floor, moving up", ball(0.5), (1e-15, 2), 0.1, 0.01,
             begun(0.1)),
        *(
            Case(STARTS, f"wall at the rest position, start {p:g}", wall, (p, 0), 3.0, 0.05, end)
            for p, end in zip((0.0, -1e-9), [at_the_wall(3 - np.pi / 4)] * 2, strict=True)
        ),
        Case(STARTS, "in a corner of two walls", S.CORNER, (0, 0, -1, -1), 1.0, 0.3,
             (0.5, 1, 0.5, 1)),
        *(
            Case(STARTS, f"a block at rest at {at:g} until t = 3", S.PULLED_BLOCK, (at, 0), 10.0,
                 0.05, pulled(7), atol=2e-9)
            for at in (0.0, 1e-9)
        ),
    ]  # fmt: skip


def resets():
    """Thrown back, or let through with another state."""
    return [
        Case(IMPACTS, "a kick", S.KICK, (1, 0), 3.0, 0.1,
             oscillation(np.cos(1), 0.7 - np.sin(1), 2)),
        Case(IMPACTS, "an injection", S.INJECTION, (1,), 3.0, 0.1, (np.exp(-3) + 2 * np.exp(-2),)),
        Case(IMPACTS, "a toggle", S.TOGGLE, (1, 0, 1), 10.0, 0.1, (np.cos(10), -np.sin(10), -1)),
        Case(IMPACTS, "a rocking block", S.Rocking(), (0.5, 0), 3.0, 0.1,
             (0.81 * 0.2 - 0.02, 0.81 - 0.2)),
        *(
            Case(IMPACTS, f"two walls {lag:g} apart in time", S.CORNER, (1, 1 + lag, -1, -1), 3.0,
                 0.3, (1, 2 - lag, 0.5, 1))
            for lag in (0.0, 1e-16, 1e-14, 1e-12, 1e-9)
        ),
        Case(IMPACTS, "Newton's cradle, balls that touch", S.CRADLE, (-1, 0, 0, 0, 1, 0, 0, 0), 3.0,
             0.1, CRADLE_END),
    ]  # fmt: skip


def rests():
    """Infinitely many impacts, and rest."""
    shake, flight = leaves_the_table()
    return [
        *(
            Case(REST, f"a ball, e = {e}", ball(e), (10, 0), 20.0, 0.1, (0, 0), mode=(2,))
            for e in (0.0, 0.5, 0.8)
        ),
        Case(REST, "a ball on a table that starts to shake", S.Shaking(jnp.asarray(1.5)), (-1.5, 0),
             shake, 0.1, flight, t0=-np.pi / 2),
        Case(REST, "a ball on a shaking table", S.Shaking(jnp.asarray(0.5)), (1, 0), 20.0, 0.1,
             (0.5 * np.sin(20), 0.5 * np.cos(20)), mode=(2,)),
    ]  # fmt: skip


def ends():
    """Where several motions go on, and where one does."""
    return [
        *(
            Case(UNIQUE, f"a slide into a two-fold, step {dt}", S.TWO_FOLD, (0, 1, 0.7), 4.0, dt,
                 (0, 0, 0), "nonunique", 1.7)
            for dt in (0.1, 0.01)
        ),
        *(
            Case(UNIQUE, f"a corner that turns repelling, step {dt}", S.TURNING_CORNER, (0.2, 0.1),
                 5.0, dt, (0, 0), "nonunique", 1.0)
            for dt in (0.05, 0.7)
        ),
        Case(UNIQUE, "a corner that attracts by a slide", S.relays([[-1.0, 0.5], [-1.0, 0.2]]),
             (0.1, 1), 8.0, 0.1, (0, 0), mode=(0, 0)),
    ]  # fmt: skip


def points():
    """Infinitely many contacts, and the point where they end."""
    return [
        Case(POINT, "Filippov's spiral", jf.systems.FilippovSpiral(), (0, 1), 1.0, 0.1, (0, 0),
             mode=(0, 0), atol=1e-12),
        *(
            Case(POINT, f"a spiral that shrinks by {part:.0%} a turn", slow(part), (0, 1), 1.0, 0.1,
                 (0, 0), mode=(0, 0), atol=1e-12)
            for part in (0.5, 0.1, 0.01)
        ),
        *(
            Case(POINT, f"the twisting controller (Siconos, Twisting.cpp), step {dt}", S.TWISTING,
                 (10, 10), 13.0, dt, (0, 0), mode=(0, 0), atol=1e-10)
            for dt in (0.1, 1.0)
        ),
    ]  # fmt: skip


def steps():
    """What steps and grids may hide."""
    return [
        *(
            Case(STEPS, f"a large transient from {x:g}, {dtype}", S.DECAY, (x,), np.log(2 * x) + 5,
                 0.05, (LARGE,), atol=100 * float(np.finfo(dtype).eps), dtype=dtype)
            for dtype, sizes in (("float64", (1e9, 1e14)), ("float32", (1e5, 1e8)))
            for x in sizes
        ),
        *(
            Case(STEPS, f"a surface met at a grid point, another at {a}, step {dt}", S.passing(a),
                 (0, 0), 1.0, dt, (1, 1 - 2 * a))
            for a, dt in ((0.3, 0.25), (0.45, 0.25), (0.41, 0.1))
        ),
        *(
            Case(STEPS, f"a ball and a bead that meets its wall {lag:g} later", S.BALL_AND_BEAD,
                 (1, 0, 0, 1 / (FALL + lag)), 1.0, dt,
                 (9 * FALL * (1 - FALL) - 5 * (1 - FALL) ** 2, 9 * FALL - 10 * (1 - FALL),
                  1 - (1 - FALL - lag) / (FALL + lag), -1 / (FALL + lag)))
            for lag, dt in ((1e-3, 0.1), (1e-3, 0.5), (0.03, 1.0))
        ),
    ]  # fmt: skip


SUBJECTS = (starts, resets, rests, ends, points, steps)


def judge(case: Case) -> Verdict:
    """The verdict on one case."""
    x0 = jnp.asarray(case.x0, case.dtype)
    sol = jf.solve(case.system, x0, case.t0, case.t1, case.dt, throw=False)
    name = str(outcome_names(sol.result))
    error = float(np.abs(np.asarray(sol.x_final, float) - np.asarray(case.end)).max())
    if case.stops is not None:
        error = max(error, abs(float(sol.t_final) - case.stops))
    if case.mode is not None and tuple(sol.mode_final.tolist()) != case.mode:
        error = np.inf
    return verdict(case.name, name, error, case.outcome, case.atol)


def verdict(case, outcome, error, expected, atol) -> Verdict:
    """Right, told, refused or wrong."""
    detail = f"{outcome}, error {error:.1e}, allowed {atol:.0e}; expected {expected}"
    within = bool(error <= atol)
    if outcome == "successful":
        fine = expected == "successful" and within
        return Verdict(case, "right" if fine else "wrong", detail, error)
    told = expected == outcome and within
    return Verdict(case, "told" if told else "refused", detail, error)


def groups(systems, seed):
    """All cases, by subject."""
    found: dict[str, list[Verdict]] = {}
    for case in (case for subject in SUBJECTS for case in subject()):
        found.setdefault(case.subject, []).append(judge(case))
    for subject, name, function in special_cases.CASES:
        found.setdefault(subject, []).append(verdict(name, *function()))
    for subject, verdicts in found.items():
        yield Group("cases", subject, verdicts)
