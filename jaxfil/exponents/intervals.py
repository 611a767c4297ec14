"""The intervals of time that exponents are taken over.

Counts and the length of an interval, as a user gives them, enter; traced numbers and the grid of
steps over some of the intervals leave.
"""

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from jaxfil.model import check
from jaxfil.model.system import System
from jaxfil.model.types import Scalar

Counts = tuple[Array, Array, Array]
"""Periods averaged over, periods before, and steps of a period."""


def counts_of(periods: int, transient: int, steps: int) -> Counts:
    """Whole numbers as traced values, so that new ones compile nothing."""
    periods = check.count("periods", periods)
    transient = check.count("transient", transient, least=0)
    check.number_of_steps(steps, periods=periods, transient=transient)
    whole = jnp.int32
    return jnp.asarray(periods, whole), jnp.asarray(transient, whole), jnp.asarray(steps, whole)


def interval_of(system: System, interval: Scalar | None, dtype: DTypeLike) -> Array:
    """The time between two orthonormalisations."""
    if interval is not None:
        return check.scalar("interval", interval, dtype, positive=True)
    if system.period is None:
        raise ValueError(
            f"`interval` must be a positive number: {type(system).__name__} has no forcing period "
            "to take its place; got None."
        )
    return check.period(system, dtype)
