"""Parameters with a default value, stored as arrays so that new values do not recompile."""

from typing import Any

import equinox as eqx
import jax
import jax.core
import numpy as np

from jaxfil.model.argument import parameter
from jaxfil.model.fields import is_no_number
from jaxfil.model.types import Scalar


def default(value: float) -> Any:
    """A parameter with a default value."""
    return eqx.field(converter=_array, default=value)


def _array(value: Any) -> Any:
    """The parameter as an array. Other values are returned unchanged; the system refuses them by
    name, which is unknown here."""
    return value if is_no_number(value) else parameter(value)


def check_restitution(system: Any) -> None:
    """Raise an error if the restitution of a system is negative."""
    value = system.restitution
    known = eqx.is_array(value) and not isinstance(value, jax.core.Tracer)
    if known and np.any(np.asarray(value) < 0):
        raise ValueError(
            f"`restitution` of {type(system).__name__} must be 0 or more, got {np.asarray(value)}."
        )


def none_if_zero(value: Scalar | None) -> Any:
    """The parameter, or None if it is a concrete zero."""
    if is_no_number(value):
        return value
    # A traced zero stays a parameter, because its value at run time cannot choose a program.
    known = not isinstance(value, jax.core.Tracer)
    zero = known and np.all(np.asarray(value) == 0)
    return None if zero else parameter(value)
