"""`StepChoice`: a stepper and a number of steps that meet a tolerance.

Verbs accept it in place of a step.
"""

from typing import Any, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxfil.integrate.steppers.adaptive import Adaptive
from jaxfil.integrate.steppers.explicit import Controlled, Stepper, controlled
from jaxfil.model import check
from jaxfil.model.card import duration, outcome, precision
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.model.types import Axes, Scalar

# Expected number of steps of a period under a tolerance.
_EXPECTED = 40


class StepChoice(eqx.Module):
    """The cheapest measured stepper and step that meet a tolerance.

    It replaces both arguments where a verb takes `dt` or `steps`, as in
    `jf.solve(system, x0, t0, t1, choice)` or `jf.bifurcation_diagram(…, steps=choice)`. The table
    is s steppers by d numbers of steps.
    """

    stepper: Stepper = eqx.field(static=True)
    """The stepper."""
    steps: int = eqx.field(static=True)
    """Steps per forcing period; for an autonomous system, in the whole span."""
    dt: float = eqx.field(static=True)
    """Length of a step, for the parameters of the system itself."""
    error: float = eqx.field(static=True)
    """The largest error of a lane: max |x(t1) − reference|, relative to max |x(t1)| of that
    lane."""
    seconds: float = eqx.field(static=True)
    """The run time of a lane."""
    tolerance: float = eqx.field(static=True)
    """The requested bound of the error."""
    result: RESULTS
    """`successful`, or the reason why no choice meets the tolerance; this one is then the most
    accurate."""
    forced: bool = eqx.field(static=True)
    """Whether steps are counted by forcing periods."""
    steppers: tuple[str, ...] = eqx.field(static=True)
    """Names of the steppers that were tried."""
    counts: Int[np.ndarray, "s d"]
    """Numbers of steps that were tried, ascending; 0 is padding."""
    errors: Float[np.ndarray, "s d"]
    """Their errors; NaN where a run did not reach t1."""
    times: Float[np.ndarray, "s d"]
    """Their run times in seconds."""
    reference: Float[np.ndarray, "lanes n"]
    """x(t1) of every lane, to `reference_error`."""
    reference_error: float = eqx.field(static=True)
    """The change of the reference by the last doubling of the steps, as `error`."""

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw all errors against run times; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        a = "a period" if self.forced else "in all"
        lines = [
            f"StepChoice{precision(self.reference)}: {type(self.stepper).__name__}, "
            f"{self.steps} steps {a} (dt = {self.dt:.4g}), {outcome(self.result)}",
            f"  error {self.error:.1e} of a tolerance of {self.tolerance:.0e}, known to "
            f"{self.reference_error:.0e}; {duration(self.seconds)} a lane, of "
            f"{len(self.reference)}",
        ]
        for i, name in enumerate(self.steppers):
            k = self._least(i)
            if k is None:
                told = f"does not meet the tolerance with up to {self.counts[i].max()} steps {a}"
            else:
                told = f"{self.counts[i, k]} steps {a}: {self.errors[i, k]:.1e} in "
                told += duration(float(self.times[i, k]))
            lines.append(f"  {name:<10} {told}")
        return "\n".join(lines)

    def _least(self, i: int) -> int | None:
        """The index of the smallest number of steps from which on all runs of a stepper meet the
        tolerance."""
        real = self.counts[i] > 0
        # Negated, so that a NaN does not meet the tolerance.
        bad = np.flatnonzero(real & ~(self.errors[i] <= self.tolerance))
        # Counted from the last failure, since a few steps may meet the tolerance where more do not.
        k = int(bad.max(initial=-1)) + 1
        return k if k < real.sum() else None


StepLength: TypeAlias = Scalar | Adaptive | StepChoice
"""`dt`: the length of a step, or an object that determines it."""
StepCount: TypeAlias = int | Adaptive | StepChoice
"""`steps`: the number of steps in a period, or an object that determines it."""


def steps_and_stepper(steps: Any, stepper: Any, system: System) -> tuple[int, Any]:
    """`steps`, a whole number, and `stepper`, still unchecked, from the arguments of a verb that
    counts steps by periods, or from a `StepChoice`."""
    if isinstance(steps, Adaptive):
        # A period is one step of the grid, in which the tolerance chooses the lengths.
        return 1, controlled(steps, stepper)
    if not isinstance(steps, StepChoice):
        return check.count("steps", steps), stepper
    if not steps.forced:
        raise ValueError(
            "`steps` must be a number, since a StepChoice for an autonomous system counts the "
            f"steps of its span, not of a period; got one of {steps.steps}."
        )
    if system.period is None:
        raise ValueError(
            "`steps` must be a number, since a StepChoice for a forced system counts the steps of "
            f"a period, and {type(system).__name__} has no period; got one of {steps.steps}."
        )
    return steps.steps, _its_own(steps, stepper)


def dt_and_stepper(dt: Any, stepper: Any) -> tuple[Any, Any]:
    """`dt` and `stepper` as given, still unchecked, or from a `StepChoice`; for an `Adaptive`, None
    in place of a step."""
    if isinstance(dt, Adaptive):
        return None, controlled(dt, stepper)
    return (dt.dt, _its_own(dt, stepper)) if isinstance(dt, StepChoice) else (dt, stepper)


def expected_steps(steps: int, stepper: Stepper) -> int:
    """The number of steps that a period may take, given the argument `steps`."""
    return _EXPECTED * steps if isinstance(stepper, Controlled) else steps


def _its_own(choice: StepChoice, stepper: object) -> Stepper:
    if stepper is not None:
        raise ValueError(
            "`stepper` must be None with a StepChoice, which was made for its own stepper, "
            f"{type(choice.stepper).__name__}; got {check.told(stepper)}."
        )
    return choice.stepper
