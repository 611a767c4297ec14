"""Data sets in files: netCDF or Zarr, by the name's end.

An `xarray.Dataset` and a path enter and a file leaves, or a path enters and the data set leaves,
every number bit for bit. The only file that knows xarray, which is imported with the first use.
"""

import importlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_PACKAGES = {".nc": ("xarray", "h5netcdf", "h5py"), ".zarr": ("xarray", "zarr")}


def dataset(
    variables: Mapping[str, tuple[Any, ...]],
    coordinates: Mapping[str, tuple[Any, ...]],
    attributes: Mapping[str, Any],
) -> Any:
    """An `xarray.Dataset` of named (dimensions, array) or (dimensions, array, attributes)."""
    return _xarray("xarray").Dataset(variables, coordinates, attributes)


def save(data: Any, path: str | os.PathLike) -> None:
    """Write a data set to `path`, which ends in .nc or .zarr; what was there is replaced."""
    path = Path(path)
    _xarray(*_packages(path))
    if path.suffix == ".nc":
        data.to_netcdf(path, engine="h5netcdf")
    else:
        write_zarr(data, path)


def write_zarr(data: Any, path: Path) -> None:
    """Write a data set to a Zarr store; what was there is replaced."""
    _xarray("xarray", "zarr")
    data.to_zarr(path, mode="w", zarr_format=3, consolidated=False)


def read_zarr(path: Path) -> Any:
    """The data set of a Zarr store, in memory."""
    return _xarray("xarray", "zarr").load_dataset(path, engine="zarr", consolidated=False)


def load(path: str | os.PathLike) -> Any:
    """The data set at `path`, in memory."""
    path = Path(path)
    xarray = _xarray(*_packages(path))
    if not path.exists():
        raise FileNotFoundError(f"`path` must be a file that `save` has written, got {path}.")
    if path.suffix == ".nc":
        return xarray.load_dataset(path, engine="h5netcdf")
    return read_zarr(path)


def _packages(path: Path) -> tuple[str, ...]:
    if path.suffix not in _PACKAGES:
        raise ValueError(f"`path` must end in {' or '.join(_PACKAGES)}, got {os.fspath(path)!r}.")
    return _PACKAGES[path.suffix]


def _xarray(*packages: str) -> Any:
    """The module xarray, after a look whether `packages` are there."""
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ImportError(
                f"Data sets need the package {package}: pip install 'jaxfil[xarray]'."
            ) from error
    return importlib.import_module("xarray")
