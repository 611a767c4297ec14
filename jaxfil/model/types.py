"""Names for the types that signatures use more than once.

Nothing enters; what leaves are aliases, which say in one word what an argument may be.
"""

import os
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Array, Float

Scalar: TypeAlias = Array | np.ndarray | np.generic | float | int
"""A real number: a Python number, or an array of shape ()."""

Times: TypeAlias = Scalar | Float[Array, "*shape"] | Float[np.ndarray, "*shape"] | Sequence[float]
"""One time, or an array of them."""

State: TypeAlias = Float[Array, " n"] | Float[np.ndarray, " n"]
"""A state of n components, shape (n,)."""

States: TypeAlias = Float[Array, "*shape n"] | Float[np.ndarray, "*shape n"]
"""One state, shape (n,), or an array of them, such as one for each lane."""

SweptValues: TypeAlias = (
    Float[Array, " p"]
    | Float[np.ndarray, " p"]
    | Float[Array, "p k"]
    | Float[np.ndarray, "p k"]
    | Sequence[Any]
)
"""What parameters are swept over: values of one, points of k, or an array for each of k."""

PathLike: TypeAlias = str | os.PathLike[str]
"""Where a file or a folder is."""

Axes: TypeAlias = Any
"""`matplotlib.axes.Axes`. Only `jaxfil.plot` imports matplotlib, so that the name is all that the
other rooms know of it."""

Dataset: TypeAlias = Any
"""`xarray.Dataset`. xarray is an optional package and imported with its first use, so that no
signature can name it."""

Widget: TypeAlias = Any
"""`ipywidgets.Widget`, of an optional package too."""
