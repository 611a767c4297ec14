"""Parameters that have a default.

A number enters; the field of a system leaves whose value is always an array, so that a new value
compiles nothing.
"""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.model.types import Scalar


def default(value: float) -> Any:
    """A parameter of that value if none is given."""
    return eqx.field(converter=jnp.asarray, default=value)


def none_if_zero(value: Scalar | None) -> Array | None:
    """The parameter, or None where it is known to be zero."""
    # A traced zero is a parameter like any other: what it is at run time cannot choose a program.
    known = not isinstance(value, jax.core.Tracer)
    zero = value is None or (known and np.all(np.asarray(value) == 0))
    return None if zero else jnp.asarray(value)
