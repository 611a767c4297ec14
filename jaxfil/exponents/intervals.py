"""The intervals of time over which exponents are averaged, and their grids of steps."""

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
"""Averaged periods, transient periods, and steps per period."""


class Interval(eqx.Module):
    """The time between two orthonormalisations."""

    length: Array
    forced: bool = eqx.field(static=True)
    """Whether it is the forcing period."""
    repeats: Array | None = None
    """Whether the system repeats after it; None if unknown."""

    def of(self, system: System, x: Array) -> "Interval":
        """The same, with `repeats` determined for the system near a state."""
        asked = self.forced and not system.clocks
        return Interval(
            self.length, self.forced, repeats(system, self.length, x) if asked else None
        )

    def grid(self, count: Array, steps: Array, start: Array | int = 0) -> TimeGrid:
        """The grid of `count` intervals after the first `start`."""
        return grid_of_periods(self.length, count, steps, start, repeats=self.repeats)


def counts_of(periods: int, transient: int, steps: int) -> Counts:
    """Integers as traced values, so that new ones do not recompile."""
    periods = check.count("periods", periods)
    transient = check.count("transient", transient, least=0)
    check.number_of_steps(steps, periods=periods, transient=transient)
    whole = jnp.int32
    return jnp.asarray(periods, whole), jnp.asarray(transient, whole), jnp.asarray(steps, whole)


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
