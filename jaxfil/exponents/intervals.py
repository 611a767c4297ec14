"""The intervals of time that exponents are taken over.

Counts and the length of an interval, as a user gives them, enter; traced numbers and the grid of
steps over some of the intervals leave.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from jaxfil.integrate.lane.forcing_phase import repeats
from jaxfil.integrate.lane.problem import TimeGrid, grid_of_periods
from jaxfil.model import check
from jaxfil.model.system import System
from jaxfil.model.types import Scalar

Counts = tuple[Array, Array, Array]
"""Periods averaged over, periods before, and steps of a period."""


class Interval(eqx.Module):
    """The time between two orthonormalisations."""

    length: Array
    forced: bool = eqx.field(static=True)
    """Whether it is the period of the forcing."""
    repeats: Array | None = None
    """Whether the system is at its end what it was; None where that is not known."""

    def of(self, system: System, x: Array) -> "Interval":
        """The same, after a look at the system near a state."""
        asked = self.forced and not system.clocks
        return Interval(
            self.length, self.forced, repeats(system, self.length, x) if asked else None
        )

    def grid(self, count: Array, steps: Array, start: Array | int = 0) -> TimeGrid:
        """The grid of `count` of them after the first `start`."""
        return grid_of_periods(self.length, count, steps, start, repeats=self.repeats)


def counts_of(periods: int, transient: int, steps: int) -> Counts:
    """Whole numbers as traced values, so that new ones compile nothing."""
    periods = check.count("periods", periods)
    transient = check.count("transient", transient, least=0)
    check.number_of_steps(steps, periods=periods, transient=transient)
    whole = jnp.int32
    return jnp.asarray(periods, whole), jnp.asarray(transient, whole), jnp.asarray(steps, whole)


def interval_of(system: System, interval: Scalar | None, dtype: DTypeLike) -> Interval:
    """The interval that was asked for, by default the period of the forcing."""
    if interval is not None:
        return Interval(check.scalar("interval", interval, dtype, positive=True), False)
    if system.period is None:
        raise ValueError(
            f"`interval` must be a positive number: {type(system).__name__} has no forcing period "
            "to take its place; got None."
        )
    return Interval(check.period(system, dtype), True)
