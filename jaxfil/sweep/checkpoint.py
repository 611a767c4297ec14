"""Checkpoints: finished chunks of a sweep on disk, and what the sweep was asked for.

A folder and a record of every argument enter; chunks of finished lanes leave and come back. The
folder holds Zarr groups that xarray opens: `sweep.zarr`, the record, and one for each chunk. A
group is written under a name of its own and then renamed, which the file system does whole or not
at all: what bears its name is complete, whenever a process was killed, and two at the same work
harm nothing. Each carries a checksum of its numbers, its name and the record: what was damaged on
the disk since, or put in another's place, is found out.
"""

import dataclasses
import hashlib
import os
import shutil
import uuid
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.run.observed import Observable
from jaxfil.integrate.steppers.explicit import Stepper, tableau_of
from jaxfil.model import check, dataset_io
from jaxfil.model.dataset_io import NamedArrays, Variable
from jaxfil.model.outcomes import outcome_codes, outcome_names, outcomes
from jaxfil.model.parameter import is_parameter
from jaxfil.model.section import Section
from jaxfil.model.system import System
from jaxfil.model.types import Dataset, PathLike
from jaxfil.model.warning import warn
from jaxfil.sweep.conditions import Conditions
from jaxfil.sweep.parameter_grid import ParameterGrid

_RECORD = "sweep.zarr"
_T = TypeVar("_T")

Record = Mapping[str, str | int | np.ndarray]
"""What a sweep was asked for: every argument by name."""


@dataclasses.dataclass(frozen=True)
class FinishedChunk:
    """Lanes of a chunk that have run to their end."""

    xs: np.ndarray
    """Samples, shape (lanes, samples, k); of a section with their times behind, k + 1 columns."""
    codes: np.ndarray
    """Codes of their outcomes, shape (lanes,)."""
    end: np.ndarray
    """Last states, shape (lanes, n), or the last state of all, shape (n,), where each lane starts
    from the last one's end."""


class Checkpoint:
    """The folder of one sweep, made if it is not there, refused if it holds another one."""

    def __init__(self, path: PathLike, record: Record):
        self._path = Path(path)
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
            # Whose it was is not known any more; each piece says for itself that it is this one's.
            self._put(_RECORD, _pack(record, self._record))
            return
        changes = _changes(before, record)
        if changes:
            raise ValueError(
                f"`checkpoint` must be a new folder, or the arguments those of the run that began "
                f"{path}: {'; '.join(changes)}."
            )

    def read(self, start: int, stop: int) -> FinishedChunk | None:
        """The lanes from number `start` to `stop`, or None if they are not finished, or not as they
        were written."""
        name = _name(start, stop)
        if not (self._path / name).exists():
            return None

        def unpack(data: Dataset) -> FinishedChunk | None:
            names = data["outcome"].values
            chunk = FinishedChunk(data["x"].values, outcome_codes(names), data["end"].values)
            same = data.attrs["checksum"] == self._checksum(name, chunk)
            return chunk if same and len(chunk.codes) == stop - start else None

        return self._intact(name, unpack)

    def write(self, start: int, stop: int, chunk: FinishedChunk) -> None:
        """Keep finished lanes."""
        name = _name(start, stop)
        # A dimension of its own: a chunk that is filled up has more last states than lanes.
        end = ("end_lane", "end_component")[-chunk.end.ndim :]
        variables: dict[str, Variable] = {
            "x": (("lane", "sample", "component"), chunk.xs),
            "outcome": (("lane",), _names(chunk)),
            "end": (end, chunk.end),
        }
        checksum = {"checksum": self._checksum(name, chunk)}
        self._put(name, NamedArrays(variables, attributes=checksum))

    def tell_damaged(self) -> None:
        """Warn of what was not as it was written."""
        if self._damaged:
            warn(
                f"The checkpoint {self._path} held what was damaged, or another sweep's, and is "
                f"computed again: {', '.join(sorted(self._damaged))}.",
                RuntimeWarning,
            )
        self._damaged = []

    def _checksum(self, name: str, chunk: FinishedChunk) -> str:
        outcomes = " ".join(_names(chunk))
        piece = {"sweep": self._record, "name": name, "outcome": outcomes}
        return digest({**piece, "x": chunk.xs, "end": chunk.end}).hex()

    def _intact(self, name: str, unpack: Callable[[Dataset], _T | None]) -> _T | None:
        """A group that is as it was written; another one is put away, and None leaves."""
        path = self._path / name
        try:
            # Whatever Zarr, xarray or a codec say of a file that something has written into.
            found = unpack(dataset_io.read_zarr(path))
        except (ImportError, MemoryError, PermissionError):  # which say nothing of the group
            raise
        except Exception:
            found = None
        if found is None and path.exists():
            self._damaged.append(name)
            away = self._path / f".{uuid.uuid4().hex}-{name}"
            with suppress(FileNotFoundError):  # another process has put it away
                os.rename(path, away)
            shutil.rmtree(away, ignore_errors=True)
        return found

    def _put(self, name: str, data: NamedArrays) -> None:
        partial = self._path / f".{uuid.uuid4().hex}-{name}"
        try:
            dataset_io.write_zarr(data, partial)
            os.rename(partial, self._path / name)
        except Exception as error:
            # Another process has put the same there first: a folder that is not empty stays.
            if not (self._path / name).exists():
                shutil.rmtree(partial, ignore_errors=True)
                if not isinstance(error, OSError):
                    raise
                why = f"{error.strerror or error}; what was finished before is kept"
                raise OSError(error.errno, why, str(self._path / name)) from error
        # What is left by a run that was killed while it wrote is no use to anyone.
        for left in self._path.glob(f".*-{name}"):  # by a run that was killed
            shutil.rmtree(left, ignore_errors=True)


def record_of(
    system: System, grid: ParameterGrid, given: Conditions, *, samples: int, stepper: Stepper
) -> Record:
    """All that the numbers of a sweep depend on, by the names that a user knows."""
    # The coefficients as well as the name: another version of diffrax may have other digits.
    table = repr(tableau_of(stepper)).encode()
    columns = grid.values if isinstance(grid.values, tuple) else grid.rows.T
    return {
        "system": type(system).__name__,
        "equations": equations(system, np.zeros(given.x0.shape[-1:], given.x0.dtype)),
        **{f"system.{key}": value for key, value in given.parameters.items()},
        "parameter": ", ".join(grid.names),
        "points": str(grid.shape),
        **{f"values of {key}": v for key, v in zip(grid.names, columns, strict=True)},
        "x0": given.x0,
        "transient": given.transient,
        "samples": samples,
        "steps": given.steps,
        "stepper": given.stepper,
        "coefficients": hashlib.sha256(table).hexdigest()[:16],
        "follow": str(given.follow),
        "compact": str(given.compact),
        "section": f"{given.section}, {given.max_return}",
        "observe": str(given.observe),
        "transient_time": str(given.transient_time),
        "jaxfil": given.version,
        # Other versions and other machines give other last bits, and a diagram of two halves that
        # differ in them is equal to neither.
        "jax": jax.__version__,
        "backend": jax.default_backend(),
    }


def digest(record: Record) -> bytes:
    """A hash of all arguments."""
    sha = hashlib.sha256()  # and not `hash`, which is another one in each process
    for name, value in sorted(record.items()):
        sha.update(f"{name} {_shown(value)} ".encode())
        sha.update(value.tobytes() if isinstance(value, np.ndarray) else b"")
    return sha.digest()


def equations(system: System, x: np.ndarray) -> str:
    """A hash of what a system computes from its parameters, a time and a state.

    It is that of the program lowered for XLA: of everything the functions of the system do, their
    constants included, and of nothing that changes from one process to the next.
    """
    # Parameters are arguments of the program and not constants in it: new values are told by name.
    leaves, static = eqx.partition(system, is_parameter)
    state = jnp.asarray(x)
    h = check.shapes(system, state)

    def everything(leaves: System, t: Array, x: Array) -> tuple[Any, ...]:
        s = eqx.combine(leaves, static)
        field = s.vector_field(t, x, jnp.ones(h, x.dtype))
        after = s.reset(t, x, jnp.zeros((), jnp.int32)) if s.resets else None
        return field, s.switching(t, x), after, s.period, s.clocks

    text = jax.jit(everything).lower(leaves, jnp.zeros((), state.dtype), state).as_text()
    return hashlib.sha256(f"{text} {system.slides}".encode()).hexdigest()[:16]


def identity(section: Section, x: np.ndarray) -> str:
    """A section in words, and a hash of its function and that function's numbers."""
    sha = _fingerprint(section.function, jnp.zeros((), x.dtype), jnp.asarray(x))
    rate = ", of its rate" if section.of_rate else ""
    return f"function {sha}{rate}, direction {section.direction}"


def observed_identity(observable: Observable, system: System, x: np.ndarray) -> str:
    """The name of what is observed, and the same of its function."""
    state = jnp.asarray(x)
    side = jnp.ones(check.shapes(system, state), x.dtype)
    sha = _fingerprint(observable.function, jnp.zeros((), x.dtype), state, side)
    return f"{observable.name}, function {sha}"


def _fingerprint(function: Any, *example: Array) -> str:
    """A hash of a function of arrays like these, and of its numbers."""
    leaves, static = eqx.partition(function, is_parameter)

    def call(leaves: Any, *args: Array) -> Any:
        return eqx.combine(leaves, static)(*args)

    text = jax.jit(call).lower(leaves, *example).as_text()
    numbers = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(leaves)]
    return hashlib.sha256(f"{text} {numbers}".encode()).hexdigest()[:16]


def _name(start: int, stop: int) -> str:
    return f"lanes-{start}-{stop}.zarr"


def _names(chunk: FinishedChunk) -> np.ndarray:
    # Names and not codes: a later version may number its outcomes in another order.
    return outcome_names(outcomes(chunk.codes))


def _pack(record: Record, checksum: str) -> NamedArrays:
    arrays = {name: v for name, v in record.items() if isinstance(v, np.ndarray)}
    variables = {name: ([f"{name}_{i}" for i in range(v.ndim)], v) for name, v in arrays.items()}
    attributes = {name: v for name, v in record.items() if name not in arrays}
    return NamedArrays(variables, attributes=attributes | {"checksum": checksum})


def _unpack(data: Dataset) -> Record | None:
    attributes = dict(data.attrs)
    checksum = attributes.pop("checksum", None)
    record = attributes | {name: data[name].values for name in data}
    # Without one it was begun by an earlier version, which is told by name.
    return record if checksum in (None, digest(record).hex()) else None


def _changes(before: Record, now: Record) -> list[str]:
    """What differs between two records, from what to what."""
    changes = []
    for name in dict.fromkeys([*now, *before]):
        a, b = before.get(name, "absent"), now.get(name, "absent")
        if _shown(a) != _shown(b):
            changes.append(f"{name} was {_shown(a)} and is {_shown(b)}")
        elif isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            other = np.argwhere(_bits(a) != _bits(b))
            if len(other):
                i = tuple(map(int, other[0]))
                place = str(list(i)) if i else ""
                changes.append(f"{name}{place} was {a[i]} and is {b[i]}")
    return changes


def _bits(array: np.ndarray) -> np.ndarray:
    # Compared as integers: NaN is equal to itself, and 0.0 is not -0.0.
    return array.view(f"u{array.dtype.itemsize}")


def _shown(value: str | int | np.ndarray) -> str:
    if isinstance(value, np.ndarray):
        return f"of shape {value.shape} and dtype {value.dtype}"
    return str(value)
