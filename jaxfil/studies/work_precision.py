"""Error against run time of every stepper at every step, for a given system."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfil.integrate.run.solution import Solution
from jaxfil.integrate.run.solve import solve
from jaxfil.integrate.steppers.explicit import Stepper, checked_steppers, tableau_of
from jaxfil.model import check
from jaxfil.model.card import duration, precision
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import outcome_names
from jaxfil.model.system import System
from jaxfil.model.types import Axes, Scalar, State
from jaxfil.studies.timing import median_seconds

# Steps of the reference, and of coarser runs that test it, in the smallest requested step.
_FINE, _JUDGING = 1 / 4, 1 / 2


class WorkPrecision(eqx.Module):
    """Errors and run times of s steppers at d step lengths.

    An error close to `reference_error` is only known to be small.
    """

    steppers: tuple[str, ...] = eqx.field(static=True)
    """Names of the steppers."""
    dts: Float[np.ndarray, " d"]
    """Step lengths."""
    errors: Float[np.ndarray, "s d"]
    """max |x(t1) − reference| of a stepper at a step; NaN where it did not reach t1."""
    seconds: Float[np.ndarray, "s d"]
    """Median run time of one lane, without compilation."""
    num_events: Int[np.ndarray, "s d"]
    """Number of contacts."""
    outcomes: np.ndarray
    """Names of `RESULTS`, shape (s, d)."""
    reached: Bool[np.ndarray, "s d"]
    """Whether a run reached t1."""
    reference: Float[np.ndarray, " n"]
    """x(t1) of `reference_stepper` at a quarter of the smallest step."""
    reference_stepper: str = eqx.field(static=True)
    """The stepper that changes least when its step is halved."""
    reference_events: int = eqx.field(static=True)
    """Contacts of the reference."""
    reference_error: float = eqx.field(static=True)
    """Change of the reference when its step was last halved; inf without a reference."""
    reference_check: float = eqx.field(static=True)
    """Distance of the best other stepper from it at that step; NaN without one."""
    period: float | None = eqx.field(static=True)
    """The system's forcing period, by which the card counts steps."""

    def recommendation(self, tolerance: float = 1e-8) -> str:
        """The fastest run with an error below `tolerance` times max |x(t1)|, or otherwise the most
        accurate run, in one line."""
        if not np.isfinite(self.errors).any():
            return "No run reached t1."
        wanted = tolerance * max(float(np.max(abs(self.reference))), np.finfo(float).tiny)
        good = self.errors <= wanted
        ranks = self.seconds if good.any() else self.errors
        i, k = np.unravel_index(
            np.nanargmin(np.where(good | ~good.any(), ranks, np.inf)), good.shape
        )
        told = f"{self.steppers[i]}, {self._step(float(self.dts[k]))}: {self.errors[i, k]:.1e} at "
        return (
            told
            + f"{duration(float(self.seconds[i, k]))}{'' if good.any() else ' (the best here)'}"
        )

    def plot(self, ax: Axes = None) -> Axes:
        """Draw the errors against the run times; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        lines = [f"{'stepper':<12} {'dt':>10} {'error':>9} {'time':>9} {'contacts':>9}"]
        for i, name in enumerate(self.steppers):
            for k, dt in enumerate(self.dts):
                reached = self.reached[i, k]
                error = f"{self.errors[i, k]:.1e}" if reached else str(self.outcomes[i, k])
                told = duration(float(self.seconds[i, k]))
                contacts = self.num_events[i, k]
                lines.append(f"{name:<12} {dt:>10.4g} {error:>9} {told:>9} {contacts:>9}")
        return "\n".join([*lines, self._reference_line(), self.recommendation()])

    def _step(self, dt: float) -> str:
        if self.period is None:
            return f"dt = {dt:.4g}"
        return f"{self.period / dt:.4g} steps a period"

    def _reference_line(self) -> str:
        told = precision(self.reference)
        if not np.isfinite(self.reference_error):
            return f"Reference{told}: none, no stepper reached t1 at a finer step."
        line = (
            f"Reference{told}: {self.reference_stepper}, dt = {self.dts.min() * _FINE:.4g}, "
            f"{self.reference_events} contacts; halving its step changed it by "
            f"{self.reference_error:.1e}"
        )
        if np.isfinite(self.reference_check):
            line += f", the next best stepper is {self.reference_check:.1e} away"
        return line + "."


def work_precision(
    system: System,
    x0: State,
    t1: Scalar,
    steppers: Sequence[Stepper],
    dts: Sequence[float] | Array | np.ndarray,
    *,
    t0: Scalar = 0.0,
    lanes: int = 1,
    repeats: int = 5,
) -> WorkPrecision:
    """Measure the error and the run time of every stepper at every step length on one problem.

    Errors are max_i |x_i(t1) − reference_i|, against the best of the steppers at a quarter of the
    smallest step. A motion that amplifies small changes by 1e10 within the span has no
    reference, which shows as a large `reference_error`.

    **Arguments**

    - `system`: a `System`, forced or not.
    - `x0`: the initial state, shape (n,), at `t0`.
    - `t1`: the time at which errors are taken, in the system's unit of time.
    - `steppers`: a list of steppers, as in `solve`, at least one.
    - `dts`: step lengths, positive, at least one, in the unit of time.
    - `t0`: the time at which the runs start.
    - `lanes`: number of copies of the problem in a timed call; times are per copy.
    - `repeats`: number of calls of a compiled program, whose median is the run time.

    **Returns** a `WorkPrecision`, a table with a picture.

    **Outcomes**: as in `solve`, for each run in `WorkPrecision.outcomes`; no error is raised.

    **Source**: work–precision diagrams: Hairer, Nørsett and Wanner, Solving Ordinary Differential
    Equations I, Springer 1993, section II.10.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> scene = jf.systems.CoulombOscillator()
    >>> wp = jf.work_precision(scene, jnp.array([3.0, 0.0]), 2.0, [jf.RK4()], [0.1, 0.05])
    >>> print(wp.errors.round(6).tolist())
    [[4e-06, 0.0]]
    """
    x = check.state("x0", x0)
    steps = _step_lengths(dts)
    several = checked_steppers("steppers", steppers)
    check.count("repeats", repeats)
    check.count("lanes", lanes)
    check.system("system", system)
    start, stop = (check.scalar(n, v, x.dtype) for n, v in (("t0", t0), ("t1", t1)))
    fine = steps.min() * np.asarray([_FINE, _JUDGING])
    rows, fines = [], []
    for stepper in several:
        run = _compiled(system, x, (start, stop), stepper, lanes)
        fines.append([_Run(run, dt, x.dtype, lanes, 0) for dt in fine])
        rows.append([_Run(run, dt, x.dtype, lanes, repeats) for dt in steps])
    best, error, other = _reference(fines)
    reference = fines[best][0]
    ends = np.asarray([[run.x for run in row] for row in rows])
    reached = np.asarray([[run.reached for run in row] for row in rows])
    errors = np.max(abs(ends - reference.x), axis=2)
    return WorkPrecision(
        steppers=tuple(tableau_of(stepper).name for stepper in several),
        dts=steps,
        errors=np.where(reached & np.isfinite(error), errors, np.nan),
        seconds=np.asarray([[run.seconds for run in row] for row in rows]),
        num_events=np.asarray([[run.num_events for run in row] for row in rows]),
        outcomes=np.asarray([[run.outcome for run in row] for row in rows]),
        reached=reached,
        reference=reference.x,
        reference_stepper=tableau_of(several[best]).name,
        reference_events=reference.num_events,
        reference_error=error,
        reference_check=other,
        period=None if system.period is None else float(system.period),
    )


def _step_lengths(dts: Any) -> np.ndarray:
    must = "positive step lengths, at least one"
    steps = check.known_numbers("dts", dts, must).astype(float)
    if steps.ndim != 1 or steps.size == 0 or not np.all(np.isfinite(steps) & (steps > 0)):
        raise ValueError(f"`dts` must be {must}, got {check.told(dts)}.")
    return steps


def _compiled(
    system: System, x0: Array, span: tuple[Array, Array], stepper: Stepper, lanes: int
) -> Callable[[Array], Solution]:
    """A compiled program of `lanes` copies of the problem, called with their step lengths."""
    t0, t1 = span

    def one(dt: Array) -> Solution:
        return solve(system, x0, t0, t1, dt, stepper=stepper, max_events=None, throw=False)

    return jax.jit(jax.vmap(one)).lower(jnp.ones((lanes,), x0.dtype)).compile()


class _Run:
    """The end, outcome and run time of one stepper at one step."""

    def __init__(self, run: Callable, dt: float, dtype: Any, lanes: int, repeats: int):
        steps = jnp.full((lanes,), dt, dtype)
        sol = run(steps)  # the first call warms up
        self.seconds = median_seconds(lambda: run(steps), repeats) / lanes
        self.x = np.asarray(sol.x_final[0])
        self.num_events = int(sol.num_events[0])
        self.outcome = str(outcome_names(sol.result)[0])
        self.reached = self.outcome == "successful"


def _reference(fines: list[list[_Run]]) -> tuple[int, float, float]:
    """The stepper that changes least when its step is halved, its change, and the distance of the
    best other stepper."""
    changes = []
    for finest, judging in fines:
        known = finest.reached and judging.reached
        changes.append(float(np.max(abs(finest.x - judging.x))) if known else np.inf)
    best = int(np.argmin(changes))
    others = [
        float(np.max(abs(finest.x - fines[best][0].x)))
        for i, (finest, _) in enumerate(fines)
        if i != best and finest.reached
    ]
    return best, changes[best], min(others, default=np.nan)
