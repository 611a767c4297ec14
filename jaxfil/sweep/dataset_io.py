"""Data sets in files: netCDF, Zarr or NumPy's .npz, by the name's end.

One description of the data enters, whatever the file, and the file leaves; or a path enters and the
data set leaves, every number bit for bit. The only file that knows xarray, which is imported with
the first use.
"""

import dataclasses
import importlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from jaxfil.model.types import Dataset, PathLike

Variable: TypeAlias = (
    tuple[str | Sequence[str], np.ndarray]
    | tuple[str | Sequence[str], np.ndarray, Mapping[str, str]]
)
"""The dimensions of an array, the array, and its own attributes."""

Attribute: TypeAlias = str | int | float | np.ndarray

# What each kind of file needs besides NumPy.
_PACKAGES = {".nc": ("xarray", "h5netcdf", "h5py"), ".zarr": ("xarray", "zarr"), ".npz": ()}


@dataclasses.dataclass(frozen=True)
class NamedArrays:
    """Arrays with their names and dimensions: the description that every file is written from."""

    variables: Mapping[str, Variable]
    """What was computed."""
    coordinates: Mapping[str, Variable] = dataclasses.field(default_factory=dict)
    """What the dimensions stand for."""
    attributes: Mapping[str, Attribute] = dataclasses.field(default_factory=dict)
    """What else is to be known."""
    npz_names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """The names that an .npz has for some of them: one without dimensions, coordinates and
    attributes needs other words."""


def to_xarray(data: NamedArrays) -> Dataset:
    """The `xarray.Dataset` of these arrays."""
    return _xarray("xarray").Dataset(
        _with_objects(data.variables), _with_objects(data.coordinates), dict(data.attributes)
    )


def save(data: NamedArrays, path: PathLike) -> None:
    """Write to `path`, which ends in .nc, .zarr or .npz; what was there is replaced."""
    path = Path(path)
    packages = _packages(path, _PACKAGES)
    if path.suffix == ".npz":
        np.savez_compressed(path, **_npz_entries(data))  # pyright: ignore[reportArgumentType]
        return
    _xarray(*packages)
    if path.suffix == ".nc":
        to_xarray(data).to_netcdf(path, engine="h5netcdf")
    else:
        write_zarr(data, path)


def write_zarr(data: NamedArrays, path: Path) -> None:
    """Write to a Zarr store; what was there is replaced."""
    _xarray("xarray", "zarr")
    # Without consolidated metadata, which Zarr's third format does not specify.
    to_xarray(data).to_zarr(path, mode="w", zarr_format=3, consolidated=False)


def read_zarr(path: Path) -> Dataset:
    """The data set of a Zarr store, in memory."""
    return _xarray("xarray", "zarr").load_dataset(path, engine="zarr", consolidated=False)


def load(path: PathLike) -> Dataset:
    """The data set at `path`, in memory."""
    path = Path(path)
    xarray = _xarray(*_packages(path, [suffix for suffix in _PACKAGES if suffix != ".npz"]))
    if not path.exists():
        raise FileNotFoundError(f"`path` must be a file that `save` has written, got {path}.")
    if path.suffix == ".nc":
        return xarray.load_dataset(path, engine="h5netcdf")
    return read_zarr(path)


def _with_objects(variables: Mapping[str, Variable]) -> dict[str, tuple[Any, ...]]:
    """The same for xarray, with strings as objects.

    A fixed-width array of strings would come back from netCDF and Zarr with another dtype.
    """
    return {
        name: (dims, array.astype(object) if array.dtype.kind == "U" else array, *attributes)
        for name, (dims, array, *attributes) in variables.items()
    }


def _npz_entries(data: NamedArrays) -> dict[str, np.ndarray]:
    """All arrays and attributes by the names of an .npz."""
    arrays = {**data.variables, **data.coordinates}
    entries = {name: variable[1] for name, variable in arrays.items()} | {**data.attributes}
    # A name that was given away is no longer free: a parameter may be called `values`.
    taken = {*data.npz_names.values()}
    return {
        data.npz_names.get(name, f"{name}_" if name in taken else name): np.asarray(value)
        for name, value in entries.items()
    }


def _packages(path: Path, suffixes: Sequence[str] | Mapping[str, object]) -> tuple[str, ...]:
    if path.suffix not in suffixes:
        *most, last = suffixes
        must = f"`path` must end in {', '.join(most)} or {last}"
        raise ValueError(f"{must}, got {os.fspath(path)!r}.")
    return _PACKAGES[path.suffix]


def _xarray(*packages: str) -> ModuleType:
    """The module xarray, after a look whether `packages` are there."""
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ImportError(
                f"Data sets need the package {package}: pip install 'jaxfil[xarray]'."
            ) from error
    return importlib.import_module("xarray")
