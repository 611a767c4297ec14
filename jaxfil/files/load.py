"""Results from their files, bit for bit."""

import os
from collections.abc import Callable
from typing import Any

from jaxfil.files.basins import basins_from
from jaxfil.files.diagram import diagram_from
from jaxfil.files.orbit import branch_from, orbit_from
from jaxfil.files.solution import solution_from
from jaxfil.integrate.run.solution import Solution
from jaxfil.model import check, dataset_io
from jaxfil.model.dataset import TYPE
from jaxfil.model.dataset_io import NamedArrays
from jaxfil.model.system import System
from jaxfil.model.types import PathLike
from jaxfil.orbits.branch import Branch
from jaxfil.orbits.orbit import Orbit
from jaxfil.sweep.basins import Basins
from jaxfil.sweep.diagram import BifurcationDiagram

_Saved = BifurcationDiagram | Basins | Branch | Orbit | Solution

_READERS: dict[str, Callable[[NamedArrays, System | None], _Saved]] = {
    "BifurcationDiagram": lambda data, system: diagram_from(data),
    "Basins": lambda data, system: basins_from(data),
    "Branch": branch_from,
    "Orbit": orbit_from,
    "Solution": solution_from,
}
# The type of early files, which do not state it.
_FIRST = "BifurcationDiagram"
_OF_A_DIAGRAM = {"jaxfil_version", "system", "swept", "transient", "steps", "stepper"}


def load(path: PathLike, *, system: System | None = None) -> Any:
    """Load a result that `save` wrote, bit for bit.

    **Arguments**

    - `path`: a netCDF file (.nc), a Zarr store (.zarr) or an .npz, of the command line too.
    - `system`: a system of the same class, required for an orbit, a branch, and a solution that was
      saved with `diffrax.SaveAt(dense=True)`, because a file contains names and numbers but no
      functions. The parameters of the file replace its own; whole numbers, flags, words, static
      fields and the names of its functions must be those of the file. Other results ignore it.

    **Returns** a `BifurcationDiagram`, `Basins`, a `Branch`, an `Orbit` or a `Solution`.

    **Raises** `FileNotFoundError` without a file, `ValueError` for another kind of file or a
    damaged one, for a wrong `system`, or if JAX does not compute in the float64 of the file, and
    `ImportError` without the packages of `pip install 'jaxfil[xarray]'`, which an .npz does not
    need.

    >>> import tempfile
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> d = jf.bifurcation_diagram(
    ...     jf.systems.SDOscillator(), "omega", jnp.array([0.6, 1.2]), jnp.array([0.3, 0.1]),
    ...     transient=2, samples=5, steps=20, stepper=jf.RK4(), progress=False)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     d.save(f"{folder}/sd.nc")
    ...     back = jf.load(f"{folder}/sd.nc")
    >>> bool((back.xs == d.xs).all()), back.conditions.stepper
    (True, 'RK4')
    """
    if system is not None:
        check.system("system", system)
    data = dataset_io.load(check.path("path", path))
    kind = data.attributes.get(TYPE, _FIRST)
    missing = set()
    if kind == _FIRST:
        missing = _OF_A_DIAGRAM - {*data.attributes} | {"x", "outcome"} - {*data.variables}
    if missing or kind not in _READERS:
        lacks = f"has no {', '.join(sorted(missing))}" if missing else f"is a {kind}"
        raise ValueError(
            f"`path` must be a file that `save` has written; {os.fspath(path)!r} {lacks}."
        )
    return _READERS[kind](data, system)
