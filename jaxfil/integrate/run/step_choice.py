"""`StepChoice`: a stepper and a number of steps that meet a tolerance, and where they stand in.

What `choose_step` has measured enters; a card and a picture leave, and for a verb that was given a
choice in place of a step, both the step and the stepper.
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

# Steps of a period where a tolerance says how long they are.
_EXPECTED = 40


class StepChoice(eqx.Module):
    """The cheapest stepper and step that meet a tolerance, of those that were measured.

    It stands for both where a verb takes `dt` or `steps`, `jf.solve(system, x0, t0, t1, choice)` or
    `jf.bifurcation_diagram(…, steps=choice)`. The table is s steppers by d numbers of steps.
    """

    stepper: Stepper = eqx.field(static=True)
    """The stepper."""
    steps: int = eqx.field(static=True)
    """Steps per forcing period; of an autonomous system, in the whole span."""
    dt: float = eqx.field(static=True)
    """Their length, for the parameters of the system itself."""
    error: float = eqx.field(static=True)
    """The largest error of a lane: max |x(t1) − reference|, relative to max |x(t1)| of that
    lane."""
    seconds: float = eqx.field(static=True)
    """The run time of a lane."""
    tolerance: float = eqx.field(static=True)
    """What the error was to be below."""
    result: RESULTS
    """`successful`, or why no choice meets the tolerance: this one then is the most accurate."""
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
    """By how much the last doubling of the steps changed the reference, as `error`."""

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
        """Which of the runs of a stepper has the fewest steps that meet the tolerance, and from
        which on all do."""
        real = self.counts[i] > 0
        bad = np.flatnonzero(real & ~(self.errors[i] <= self.tolerance))
        k = int(bad.max(initial=-1)) + 1
        return k if k < real.sum() else None


StepLength: TypeAlias = Scalar | Adaptive | StepChoice
"""`dt`: the length of a step, or what says it."""
StepCount: TypeAlias = int | Adaptive | StepChoice
"""`steps`: how many there are in a period, or what says it."""


def steps_and_stepper(steps: Any, stepper: Any, system: System) -> tuple[int, Any]:
    """`steps`, a whole number, and `stepper`, still to be checked, as a verb that counts steps by
    periods was given them, or those of a `StepChoice`."""
    if isinstance(steps, Adaptive):
        return 1, controlled(steps, stepper)
    if not isinstance(steps, StepChoice):
        return check.count("steps", steps), stepper
    if not steps.forced or system.period is None:
        raise ValueError(
            "`steps` must be a number: a StepChoice for an autonomous system counts the steps of "
            f"its span, not those of a period; got one of {steps.steps}."
        )
    return steps.steps, _its_own(steps, stepper)


def dt_and_stepper(dt: Any, stepper: Any) -> tuple[Any, Any]:
    """`dt` and `stepper` as they were given, still to be checked, or those of a `StepChoice`; of an
    `Adaptive`, None in place of a step."""
    if isinstance(dt, Adaptive):
        return None, controlled(dt, stepper)
    return (dt.dt, _its_own(dt, stepper)) if isinstance(dt, StepChoice) else (dt, stepper)


def expected_steps(steps: int, stepper: Stepper) -> int:
    """How many steps a period may take, of which so many are given."""
    return _EXPECTED * steps if isinstance(stepper, Controlled) else steps


def _its_own(choice: StepChoice, stepper: object) -> Stepper:
    if stepper is not None:
        raise ValueError(
            "`stepper` must be None with a StepChoice, which was made for its own stepper, "
            f"{type(choice.stepper).__name__}; got {check.told(stepper)}."
        )
    return choice.stepper
