"""The parameter grid of a sweep: its points in parameter space and the shape of its result."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jax.typing import DTypeLike

from jaxfil.model import check
from jaxfil.model.parameter import are_different, scalar_parameter
from jaxfil.model.system import System
from jaxfil.model.types import SweptValues


@dataclasses.dataclass(frozen=True)
class ParameterGrid:
    """p points in the space of k parameters, on a line, on a product grid, or one by one."""

    names: tuple[str, ...]
    """Names of the k parameters."""
    values: np.ndarray | tuple[np.ndarray, ...]
    """The values as passed: shape (p,) for one name, k arrays for a product grid, shape (p, k) for
    single points."""
    rows: np.ndarray
    """One point per row, shape (p, k); the last parameter of a product grid varies fastest."""
    shape: tuple[int, ...]
    """Shape of the result: (p,), or a dimension for each parameter of a product grid."""


def parameter_grid(
    system: System, parameter: str | Sequence[str], values: SweptValues, dtype: DTypeLike
) -> ParameterGrid:
    """The grid of the arguments `parameter` and `values`, in a float precision."""
    if isinstance(parameter, str):
        scalar_parameter(system, parameter)
        axis = _axis(values, dtype, "(p,) with p ≥ 1")
        return ParameterGrid((parameter,), axis, axis[:, None], axis.shape)
    names = tuple(parameter) if isinstance(parameter, Sequence | np.ndarray) else ()
    several = len(names) > 1 and all(isinstance(name, str) for name in names)
    if not several or not are_different(system, names):
        raise ValueError(
            "`parameter` must be a string, or two or more different ones, got "
            f"{check.told(parameter)}."
        )
    # An array means single points, any other value a product grid, because k arrays of one length
    # could mean either.
    if hasattr(values, "ndim"):
        return _one_by_one(names, np.asarray(values), dtype)
    if not isinstance(values, Sequence) or len(values) != len(names):
        raise ValueError(
            f"`values` must be {len(names)} arrays, one for each name, for their product grid, or "
            f"one array of shape (p, {len(names)}) for single points, got {_told(values)}."
        )
    axes = tuple(_axis(v, dtype, "(p,) with p ≥ 1 for each name") for v in values)
    # "ij": the first parameter is the first dimension of the result.
    mesh = np.meshgrid(*axes, indexing="ij")
    rows = np.stack([m.ravel() for m in mesh], axis=1)
    return ParameterGrid(names, axes, rows, mesh[0].shape)


def _one_by_one(names: tuple[str, ...], rows: np.ndarray, dtype: DTypeLike) -> ParameterGrid:
    if rows.ndim != 2 or rows.shape[1] != len(names):
        raise ValueError(
            f"`values` must be of shape (p, {len(names)}), a column for each name, or a tuple of "
            f"{len(names)} arrays for their product grid, got shape {rows.shape}."
        )
    _axis(rows[:, 0], dtype, f"(p, {len(names)}) with p ≥ 1")
    rows = rows.astype(dtype)
    return ParameterGrid(names, rows, rows, rows.shape[:1])


def _axis(values: object, dtype: DTypeLike, shape: str) -> np.ndarray:
    array = check.known_numbers("values", values, f"real numbers of shape {shape}")
    # Values that are not finite are allowed: such a lane fails without affecting others.
    if array.ndim != 1 or array.shape[0] == 0:
        raise ValueError(
            f"`values` must be real numbers of shape {shape}, got shape {array.shape} of dtype "
            f"{array.dtype}."
        )
    return array.astype(dtype)


def _told(values: object) -> str:
    return f"{len(values)} of them" if isinstance(values, Sequence) else check.told(values)
