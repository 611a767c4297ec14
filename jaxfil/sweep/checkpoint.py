"""Checkpoints: finished chunks of a sweep on disk, with the record of the sweep.

The folder holds Zarr groups that xarray opens: `sweep.zarr`, the record, and one for each chunk. A
group is written under a temporary name and then renamed, which is atomic. A group with its final
name is therefore complete, even if a process was killed, and two processes do not interfere. Each
carries a checksum of its numbers, its name and the record, which detects damaged or exchanged
groups.
"""

import dataclasses
import os
import shutil
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxfil.model import dataset_io
from jaxfil.model.dataset import own_dimensions
from jaxfil.model.dataset_io import NamedArrays, Variable
from jaxfil.model.outcomes import outcome_codes, outcome_names, outcomes
from jaxfil.model.types import Dataset, PathLike
from jaxfil.model.warning import warn
from jaxfil.sweep.record import Record, digest, shown
from jaxfil.sweep.sampling import Samples

_RECORD = "sweep.zarr"
_T = TypeVar("_T")


@dataclasses.dataclass(frozen=True)
class FinishedChunk:
    """The finished lanes of a chunk."""

    samples: Samples[np.ndarray]
    """Samples of the lanes, shape (lanes, samples, k)."""
    codes: np.ndarray
    """Codes of the outcomes, shape (lanes,)."""
    end: np.ndarray
    """Last states, shape (lanes, n), or the last state of all, shape (n,), where each lane starts
    from the end of the previous one."""


class Checkpoint:
    """The folder of one sweep, created if necessary, refused if it belongs to another sweep.

    The samples of a sweep at a section are `timed`.
    """

    def __init__(self, path: PathLike, record: Record, timed: bool):
        self._path, self._timed = Path(path), timed
        self._record = digest(record).hex()
        self._damaged: list[str] = []
        self._path.mkdir(parents=True, exist_ok=True)
        if not (self._path / _RECORD).exists():
            strange = [name for name in os.listdir(self._path) if not name.startswith(".")]
            if strange:
                raise ValueError(
                    f"`checkpoint` must be a new folder, or one of an earlier run; {path} holds "
                    f"{strange[0]}."
                )
            self._put(_RECORD, _pack(record, self._record))
        before = self._intact(_RECORD, _unpack)
        if before is None:
            # The damaged record cannot identify the sweep, but each piece identifies itself.
            self._put(_RECORD, _pack(record, self._record))
            return
        changes = _changes(before, record)
        if changes:
            raise ValueError(
                f"`checkpoint` must be a new folder, or all arguments must be the same as in the "
                f"run that began {path}. They differ: {'; '.join(changes)}."
            )

    def read(self, start: int, stop: int) -> FinishedChunk | None:
        """The lanes from number `start` to `stop`, or None if they are unfinished or damaged."""
        name = _name(start, stop)
        if not (self._path / name).exists():
            return None

        def unpack(data: Dataset) -> FinishedChunk | None:
            averages = data["averages"].values if "averages" in data else None
            halvings = data["halvings"].values
            samples = _from_columns(data["x"].values, self._timed, halvings, averages)
            codes = outcome_codes(data["outcome"].values)
            chunk = FinishedChunk(samples, codes, data["end"].values)
            same = data.attrs["checksum"] == self._checksum(name, chunk)
            return chunk if same and len(chunk.codes) == stop - start else None

        return self._intact(name, unpack)

    def write(self, start: int, stop: int, chunk: FinishedChunk) -> None:
        """Store finished lanes."""
        name = _name(start, stop)
        # A separate dimension, because a padded chunk has more last states than lanes.
        end = ("end_lane", "end_component")[-chunk.end.ndim :]
        variables: dict[str, Variable] = {
            "x": (("lane", "sample", "component"), _columns(chunk.samples)),
            "outcome": (("lane",), _names(chunk)),
            "halvings": (("lane",), chunk.samples.halvings),
            "end": (end, chunk.end),
        }
        if chunk.samples.averages is not None:
            variables["averages"] = ("lane", "quantity"), chunk.samples.averages
        checksum = {"checksum": self._checksum(name, chunk)}
        self._put(name, NamedArrays(variables, attributes=checksum))

    def tell_damaged(self) -> None:
        """Warn of damaged groups."""
        if self._damaged:
            warn(
                f"The checkpoint {self._path} has parts that are damaged or belong to another "
                f"sweep, and are computed again: {', '.join(sorted(self._damaged))}.",
                RuntimeWarning,
            )
        self._damaged = []

    def _checksum(self, name: str, chunk: FinishedChunk) -> str:
        outcomes = " ".join(_names(chunk))
        piece = {"sweep": self._record, "name": name, "outcome": outcomes}
        numbers = {"x": _columns(chunk.samples), "halvings": chunk.samples.halvings}
        if chunk.samples.averages is not None:
            numbers["averages"] = chunk.samples.averages
        return digest({**piece, **numbers, "end": chunk.end}).hex()

    def _intact(self, name: str, unpack: Callable[[Dataset], _T | None]) -> _T | None:
        """An intact group, or None after a damaged one is set aside."""
        path = self._path / name
        try:
            # Any error of Zarr, xarray or a codec for a damaged file.
            found = unpack(dataset_io.read_zarr(path))
        except (ImportError, MemoryError, PermissionError):  # not about the group
            raise
        except Exception:
            found = None
        if found is None and path.exists():
            self._damaged.append(name)
            away = self._path / f".{uuid.uuid4().hex}-{name}"
            with suppress(FileNotFoundError):  # another process has set it aside
                os.rename(path, away)
            shutil.rmtree(away, ignore_errors=True)
        return found

    def _put(self, name: str, data: NamedArrays) -> None:
        partial = self._path / f".{uuid.uuid4().hex}-{name}"
        try:
            dataset_io.write_zarr(data, partial)
            os.rename(partial, self._path / name)
        except Exception as error:
            # Another process has written the same group first; a folder that is not empty stays.
            if not (self._path / name).exists():
                shutil.rmtree(partial, ignore_errors=True)
                if not isinstance(error, OSError):
                    raise
                why = f"{error.strerror or error}; what was finished before is kept"
                raise OSError(error.errno, why, str(self._path / name)) from error
        # Remove partial groups of a run that was killed during writing.
        for left in self._path.glob(f".*-{name}"):
            shutil.rmtree(left, ignore_errors=True)


def _name(start: int, stop: int) -> str:
    return f"lanes-{start}-{stop}.zarr"


def _columns(samples: Samples[np.ndarray]) -> np.ndarray:
    """Samples as one array; times are the last column."""
    xs = np.asarray(samples.xs)
    if samples.times is None:
        return xs
    return np.concatenate([xs, np.asarray(samples.times)[..., None]], axis=-1)


def _from_columns(
    x: np.ndarray, timed: bool, halvings: np.ndarray, averages: np.ndarray | None
) -> Samples[np.ndarray]:
    """The samples from the array of `_columns`, and the further numbers of each lane."""
    xs, times = (x[..., :-1], x[..., -1]) if timed else (x, None)
    return Samples(xs, times, halvings, averages)


def _names(chunk: FinishedChunk) -> np.ndarray:
    # Names instead of codes, because a later version may number its outcomes in another order.
    return outcome_names(outcomes(chunk.codes))


def _pack(record: Record, checksum: str) -> NamedArrays:
    arrays = {name: v for name, v in record.items() if isinstance(v, np.ndarray)}
    variables = {name: (own_dimensions(name, v.ndim), v) for name, v in arrays.items()}
    attributes = {name: v for name, v in record.items() if name not in arrays}
    return NamedArrays(variables, attributes=attributes | {"checksum": checksum})


def _unpack(data: Dataset) -> Record | None:
    attributes = dict(data.attrs)
    checksum = attributes.pop("checksum", None)
    record = attributes | {name: data[name].values for name in data}
    # A record without a version was begun by an earlier one, which the message names.
    return record if checksum in (None, digest(record).hex()) else None


def _changes(before: Record, now: Record) -> list[str]:
    """The differences between two records, with old and new values."""
    changes = []
    for name in dict.fromkeys([*now, *before]):
        a, b = before.get(name, "absent"), now.get(name, "absent")
        if shown(a) != shown(b):
            changes.append(f"{name} was {shown(a)} and is {shown(b)}")
        elif isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            other = np.argwhere(_bits(a) != _bits(b))
            if len(other):
                i = tuple(map(int, other[0]))
                place = str(list(i)) if i else ""
                changes.append(f"{name}{place} was {a[i]} and is {b[i]}")
    return changes


def _bits(array: np.ndarray) -> np.ndarray:
    # Compared as integers: NaN equals itself, and 0.0 differs from -0.0.
    return array.view(f"u{array.dtype.itemsize}")
