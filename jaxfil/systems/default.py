"""Parameters that have a default.

A number enters; the field of a system leaves whose value is always an array, so that a new value
compiles nothing.
"""

from typing import Any

import equinox as eqx
import jax
import jax.core
import numpy as np

from jaxfil.model.fields import is_no_number
from jaxfil.model.types import Scalar
from jaxfil.xla.known import array_of


def default(value: float) -> Any:
    """A parameter of that value if none is given."""
    return eqx.field(converter=_array, default=value)


def _array(value: Any) -> Any:
    """The parameter as an array. What is no number stays as it is: the system refuses it by name,
    which is not known here."""
    return value if is_no_number(value) else array_of(value)


def check_restitution(system: Any) -> None:
    """An error where the restitution of a system is known to be negative."""
    value = system.restitution
    known = eqx.is_array(value) and not isinstance(value, jax.core.Tracer)
    if known and np.any(np.asarray(value) < 0):
        raise ValueError(
            f"`restitution` of {type(system).__name__} must be 0 or more, got {np.asarray(value)}."
        )


def none_if_zero(value: Scalar | None) -> Any:
    """The parameter, or None where it is known to be zero."""
    if is_no_number(value):
        return value
    # A traced zero is a parameter like any other: what it is at run time cannot choose a program.
    known = not isinstance(value, jax.core.Tracer)
    zero = known and np.all(np.asarray(value) == 0)
    return None if zero else array_of(value)
