"""Names for the types that signatures use more than once.

Nothing enters; what leaves are aliases, which say in one word what an argument may be.
"""

from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Array, Float

Scalar: TypeAlias = Array | np.ndarray | np.generic | float | int
"""A real number: a Python number, or an array of shape ()."""

State: TypeAlias = Float[Array, " n"] | Float[np.ndarray, " n"]
"""A state of n components, shape (n,)."""

Axes: TypeAlias = Any
"""`matplotlib.axes.Axes`. Only `jaxfil.plot` imports matplotlib, so that the name is all that the
other rooms know of it."""
