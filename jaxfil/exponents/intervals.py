"""The intervals of time over which exponents are averaged, their number and their steps."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from jaxfil.integrate.lane.forcing_phase import repeats
from jaxfil.integrate.lane.problem import TimeGrid, grid_of_periods
from jaxfil.integrate.run.step_choice import expected_steps, steps_and_stepper
from jaxfil.integrate.steppers.explicit import Stepper, checked_stepper, tableau_of
from jaxfil.integrate.system.grade import is_compact_sweep
from jaxfil.model import check
from jaxfil.model.system import System
from jaxfil.model.types import Scalar


class Pace(eqx.Module):
    """How long a lane runs, and by what steps. Counts are arrays, so that new ones do not
    recompile."""

    periods: Array
    """Averaged periods."""
    transient: Array
    """Periods before the average."""
    steps: Array
    """Steps per period."""
    stepper: Stepper
    compact: bool = eqx.field(static=True)
    """The grade of the program (see `grade`)."""


class Interval(eqx.Module):
    """The time between two orthonormalisations."""

    length: Array
    forced: bool = eqx.field(static=True)
    """Whether it is the forcing period."""
    repeats: Array | None = None
    """Whether the system repeats after it; None if unknown."""

    def of(self, system: System, x: Array, pace: Pace) -> "Interval":
        """The same, with `repeats` determined for the system near a state."""
        asked, count = self.forced and not system.clocks, pace.transient + pace.periods
        known = repeats(system, self.length, x, count) if asked else None
        return Interval(self.length, self.forced, known)

    def grid(self, count: Array, steps: Array, start: Array | int = 0) -> TimeGrid:
        """The grid of `count` intervals after the first `start`."""
        return grid_of_periods(self.length, count, steps, start, repeats=self.repeats)

    def part(self, steps: Array, start: Array, begin: Array, end: Array) -> TimeGrid:
        """The grid of a part of the interval after the first `start`, from one fraction of it to
        another one, in steps of about the same length."""
        whole = self.grid(jnp.ones_like(steps), steps, start)
        num_steps = jnp.ceil((end - begin) * steps.astype(begin.dtype)).astype(jnp.int32)
        num_steps = jnp.maximum(num_steps, 1)
        length = (end - begin) * whole.length
        return dataclasses.replace(
            whole,
            t0=whole.t0 + begin * whole.length,
            length=length,
            dt=length / num_steps.astype(length.dtype),
            num_steps=num_steps,
            forcing=None,
        )


def pace_of(
    system: System,
    x0: Array,
    lanes: int,
    *,
    periods: int,
    transient: int,
    steps: Any,
    stepper: Any,
    compact: Any,
    tangents: int = 0,
) -> Pace:
    """The pace of `lanes` lanes of a system from states like x0, with so many tangent vectors, from
    the arguments of an exponent."""
    steps, stepper = steps_and_stepper(steps, stepper, system)
    periods = check.count("periods", periods)
    transient = check.count("transient", transient, least=0)
    check.number_of_steps(steps, periods=periods, transient=transient)
    stepper = checked_stepper(stepper)
    grade = is_compact_sweep(
        compact,
        system,
        x0,
        stages=tableau_of(stepper).stages,
        lanes=lanes,
        steps=(transient + periods) * expected_steps(steps, stepper),
        tangents=tangents,
    )
    counts = {"periods": periods, "transient": transient, "steps": steps}
    arrays = {name: jnp.asarray(v, jnp.int32) for name, v in counts.items()}
    return Pace(**arrays, stepper=stepper, compact=grade)


def interval_of(system: System, interval: Scalar | None, dtype: DTypeLike) -> Interval:
    """The requested interval, by default the forcing period."""
    if interval is not None:
        return Interval(check.scalar("interval", interval, dtype, positive=True), False)
    if system.period is None:
        raise ValueError(
            f"`interval` must be a positive number, since {type(system).__name__} has no forcing "
            "period to replace it; got None."
        )
    return Interval(check.period(system, dtype), True)
