"""Files of data sets: netCDF, Zarr or NumPy's .npz, by the file name extension.

One description, `NamedArrays`, serves all formats and is preserved bit for bit. Only this module
uses xarray, imported on first use.
"""

import contextlib
import dataclasses
import hashlib
import importlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from jaxfil.model.types import Dataset, PathLike

Variable: TypeAlias = (
    tuple[str | Sequence[str], np.ndarray]
    | tuple[str | Sequence[str], np.ndarray, Mapping[str, str]]
)
"""Dimensions of an array, the array, and its attributes."""

Attribute: TypeAlias = Any
"""A string, a number, or an array of one dimension."""

# The entry of an .npz that describes the others.
_CONTENTS = "jaxfil_contents"
# The attribute with the hash of all arrays. An .npz has one of each array by itself.
_CHECKSUM = "jaxfil_sha256"
# A quantity in seconds is a number, and not a time of a calendar.
_AS_STORED = {"decode_timedelta": False}
# Packages that each format needs in addition to NumPy.
_PACKAGES = {".nc": ("xarray", "h5netcdf", "h5py"), ".zarr": ("xarray", "zarr"), ".npz": ()}


@dataclasses.dataclass(frozen=True)
class NamedArrays:
    """Arrays with their names and dimensions, the common description of all file formats."""

    variables: Mapping[str, Variable]
    """The computed arrays."""
    coordinates: Mapping[str, Variable] = dataclasses.field(default_factory=dict)
    """The values along the dimensions."""
    attributes: Mapping[str, Attribute] = dataclasses.field(default_factory=dict)
    """Further metadata."""
    npz_names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Alternative names in an .npz, which has no dimensions, coordinates and attributes of its
    own."""
    npz_extras: Mapping[str, Attribute] = dataclasses.field(default_factory=dict)
    """Additional entries of an .npz for `numpy.load`, not read back."""

    def __contains__(self, name: str) -> bool:
        return name in self.variables or name in self.coordinates

    def array(self, name: str) -> np.ndarray:
        """The variable or coordinate called `name`."""
        return ({**self.variables, **self.coordinates})[name][1]

    def told(self, name: str) -> Mapping[str, str]:
        """The attributes of a coordinate."""
        _, _, *attributes = self.coordinates[name]
        return attributes[0] if attributes else {}


def to_xarray(data: NamedArrays) -> Dataset:
    """The `xarray.Dataset` of these arrays."""
    return _xarray("xarray").Dataset(
        _with_objects(data.variables), _with_objects(data.coordinates), dict(data.attributes)
    )


def save(data: NamedArrays, path: PathLike) -> None:
    """Write to `path`, which ends in .nc, .zarr or .npz; an existing file is replaced."""
    path = Path(path)
    packages = _packages(path)
    if path.suffix == ".npz":
        np.savez_compressed(path, **_npz_entries(data))  # pyright: ignore[reportArgumentType]
        return
    _xarray(*packages)
    known = {**data.attributes, _CHECKSUM: _checksum(data)}
    data = dataclasses.replace(data, attributes=known)
    if path.suffix == ".nc":
        to_xarray(data).to_netcdf(path, engine="h5netcdf")
    else:
        write_zarr(data, path)


def write_zarr(data: NamedArrays, path: Path) -> None:
    """Write to a Zarr store; an existing store is replaced."""
    _xarray("xarray", "zarr")
    # Without consolidated metadata, which Zarr's third format does not specify.
    to_xarray(data).to_zarr(path, mode="w", zarr_format=3, consolidated=False)


def read_zarr(path: Path) -> Dataset:
    """The data set of a Zarr store, in memory."""
    xarray = _xarray("xarray", "zarr")
    return xarray.load_dataset(path, engine="zarr", consolidated=False, **_AS_STORED)


def load(path: PathLike) -> NamedArrays:
    """The data set saved at `path`, in memory."""
    path = Path(path)
    packages = _packages(path)
    if not path.exists():
        raise FileNotFoundError(f"`path` must be a file that `save` has written, got {path}.")
    if path.suffix == ".npz":
        return _from_npz(path)
    xarray = _xarray(*packages)
    with _foreign_refused(path):
        if path.suffix == ".nc":
            return _intact(xarray.load_dataset(path, engine="h5netcdf", **_AS_STORED))
        return _intact(read_zarr(path))


@contextlib.contextmanager
def _foreign_refused(path: Path) -> Iterator[None]:
    """What the readers of formats raise for a file of another kind, as an error of `path`."""
    try:
        yield
    except (ImportError, MemoryError, PermissionError):  # not about its content
        raise
    except Exception as error:  # of a format, of its codecs, or of what is lacking
        raise ValueError(
            f"`path` must be a file that `save` has written; {os.fspath(path)!r} is not one, or is "
            "damaged."
        ) from error


def _intact(data: Dataset) -> NamedArrays:
    """The arrays of a file, after a check that they are those that were saved."""
    # A file of an earlier version has no checksum.
    checksum = data.attrs.pop(_CHECKSUM, None)
    found = _from_xarray(data)
    if checksum is not None and checksum != _checksum(found):
        raise ValueError("The arrays are not those that were saved.")
    return found


def _checksum(data: NamedArrays) -> str:
    """A hash of all arrays. NetCDF has none of its own, and a Zarr store that has lost a part of an
    array is read as if this had its filling value."""
    sha = hashlib.sha256()
    for name, (dims, array, *_) in sorted({**data.variables, **data.coordinates}.items()):
        sha.update(repr((name, [*_dims(dims)], array.shape)).encode())
        sha.update(_content(array))
    return sha.hexdigest()


def _content(array: np.ndarray) -> bytes:
    """The numbers or words of an array, in one form for all machines and formats."""
    if array.dtype.kind in "OUT":
        return repr(array.tolist()).encode()
    if array.dtype.kind == "f":
        # A part of an array that is all NaN is not written.
        array = np.where(np.isnan(array), array.dtype.type(np.nan), array)
    return array.astype(array.dtype.newbyteorder("<")).tobytes()


def _from_xarray(data: Dataset) -> NamedArrays:
    def described(arrays: Mapping[str, Any]) -> dict[str, Variable]:
        return {
            name: (each.dims, _without_objects(each.values), each.attrs)
            for name, each in arrays.items()
        }

    return NamedArrays(described(data.data_vars), described(data.coords), data.attrs)


def _without_objects(array: np.ndarray) -> np.ndarray:
    return array.astype(str) if array.dtype.kind == "O" else array


def _with_objects(variables: Mapping[str, Variable]) -> dict[str, tuple[Any, ...]]:
    """The same for xarray, with strings as objects.

    A fixed-width array of strings would come back from netCDF and Zarr with another dtype.
    """
    return {
        name: (dims, array.astype(object) if array.dtype.kind == "U" else array, *attributes)
        for name, (dims, array, *attributes) in variables.items()
    }


def _npz_entries(data: NamedArrays) -> dict[str, np.ndarray]:
    """All arrays and attributes by their names in an .npz, and the table of contents."""
    # An alternative name is no longer free, because a parameter may be called `values`.
    taken = {*data.npz_names.values(), _CONTENTS}
    entries: dict[str, np.ndarray] = {}

    def kept(name: str, value: Any) -> str:
        entry = data.npz_names.get(name, f"{name}_" if name in taken else name)
        entries[entry] = np.asarray(value)
        return entry

    def arrays(described: Mapping[str, Variable]) -> dict[str, list[Any]]:
        return {
            name: [kept(name, array), _dims(dims), *map(dict, attributes)]
            for name, (dims, array, *attributes) in described.items()
        }

    contents = {
        "variables": arrays(data.variables),
        "coordinates": arrays(data.coordinates),
        "attributes": {name: kept(name, value) for name, value in data.attributes.items()},
    }
    extras = {name: np.asarray(value) for name, value in data.npz_extras.items()}
    return entries | extras | {_CONTENTS: np.asarray(json.dumps(contents))}


def _dims(dims: str | Sequence[str]) -> list[str]:
    return [dims] if isinstance(dims, str) else [*dims]


def _from_npz(path: Path) -> NamedArrays:
    # NumPy leaves a damaged archive open that it has opened itself.
    with _foreign_refused(path), open(path, "rb") as opened, np.load(opened) as file:
        entries = dict(file)
    if _CONTENTS not in entries:
        raise ValueError(
            f"`path` must be a file that `save` has written; {os.fspath(path)!r} has no "
            f"{_CONTENTS}."
        )
    with _foreign_refused(path):
        return _from_entries(entries)


def _from_entries(entries: Mapping[str, np.ndarray]) -> NamedArrays:
    contents = json.loads(entries[_CONTENTS].item())

    def described(told: Mapping[str, list[Any]]) -> dict[str, Variable]:
        return {
            name: (dims, entries[entry], *attributes)
            for name, (entry, dims, *attributes) in told.items()
        }

    attributes = {name: entries[entry] for name, entry in contents["attributes"].items()}
    return NamedArrays(
        described(contents["variables"]),
        described(contents["coordinates"]),
        {name: v if v.ndim else v.item() for name, v in attributes.items()},
    )


def _packages(path: Path) -> tuple[str, ...]:
    if path.suffix not in _PACKAGES:
        *most, last = _PACKAGES
        must = f"`path` must end in {', '.join(most)} or {last}"
        raise ValueError(f"{must}, got {os.fspath(path)!r}.")
    return _PACKAGES[path.suffix]


def _xarray(*packages: str) -> ModuleType:
    """The module xarray, after a check that `packages` are installed."""
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ImportError(
                f"Data sets need the package {package}: pip install 'jaxfil[xarray]'."
            ) from error
    return importlib.import_module("xarray")
