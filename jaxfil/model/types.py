"""Aliases of types that several signatures use."""

import os
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Array, Float

Scalar: TypeAlias = Array | np.ndarray | np.generic | float | int
"""A Python number, or an array of shape ()."""

Times: TypeAlias = Scalar | Float[Array, "*shape"] | Float[np.ndarray, "*shape"] | Sequence[float]
"""One time, or an array of them."""

State: TypeAlias = Float[Array, " n"] | Float[np.ndarray, " n"]
"""A state of n components, shape (n,)."""

States: TypeAlias = Float[Array, "*shape n"] | Float[np.ndarray, "*shape n"]
"""One state, shape (n,), or an array of states, such as one for each lane."""

SweptValues: TypeAlias = (
    Float[Array, " p"]
    | Float[np.ndarray, " p"]
    | Float[Array, "p k"]
    | Float[np.ndarray, "p k"]
    | Sequence[Any]
)
"""Values of one swept parameter, points of k parameters, or an array for each of k."""

PathLike: TypeAlias = str | os.PathLike[str]
"""Path of a file or a folder."""

Axes: TypeAlias = Any
"""`matplotlib.axes.Axes`. Only `jaxfil.plot` imports matplotlib, so the other rooms use its name
alone."""

Dataset: TypeAlias = Any
"""`xarray.Dataset`. xarray is an optional package, imported on first use, so signatures cannot
import its class."""

Widget: TypeAlias = Any
"""`ipywidgets.Widget`, from another optional package."""
