"""A bifurcation diagram read back from its file.

A path enters; the diagram that was saved there leaves, bit for bit.
"""

import json
import os

import numpy as np

from jaxfil.model.labels import Labels
from jaxfil.model.outcomes import outcome_codes, outcomes
from jaxfil.model.types import Dataset, PathLike
from jaxfil.sweep import dataset_io
from jaxfil.sweep.diagram import (
    ATTRIBUTES,
    VARIABLES,
    BifurcationDiagram,
    Conditions,
    key_of,
)


def load(path: PathLike) -> BifurcationDiagram:
    """The bifurcation diagram that `BifurcationDiagram.save` wrote, bit for bit.

    **Arguments**

    - `path`: a netCDF file (.nc) or a Zarr store (.zarr).

    **Returns** a `BifurcationDiagram`.

    **Outcomes**: those of the lanes that were saved, such as `successful`; none is added.

    **Raises** `FileNotFoundError` if there is nothing, `ValueError` if there is something else, and
    `ImportError` without the packages of `pip install 'jaxfil[xarray]'`.

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
    data = dataset_io.load(path)
    optional = {"follow", "x0", "compact", "section", "max_return", "symbols", "observe"}
    needed = ATTRIBUTES - optional
    missing = needed - {*data.attrs} | {"x", "outcome"} - {*data}
    if missing:
        raise ValueError(
            f"`path` must be a diagram that `save` has written; {os.fspath(path)!r} has no "
            f"{', '.join(sorted(missing))}."
        )
    dtype, swept = data["x"].dtype, tuple(data.attrs["swept"].split(", "))
    axes = [data[key_of(name)].values for name in swept]
    if "point" in data["x"].dims:
        values = np.stack(axes, axis=1)
    else:
        values = axes[0] if len(swept) == 1 else tuple(axes)
    # An attribute of one number comes back as a number, and one of float32 as float64.
    x0 = data["x0"].values if "x0" in data else np.reshape(data.attrs["x0"], (-1,)).astype(dtype)
    longest = data.attrs.get("max_return")
    return BifurcationDiagram(
        values=values,
        xs=data["x"].values,
        results=outcomes(outcome_codes(data["outcome"].values)),
        parameter=swept[0] if len(swept) == 1 else swept,
        system=data.attrs["system"],
        conditions=Conditions(
            parameters=_parameters(data, dtype),
            x0=x0,
            transient=int(data.attrs["transient"]),
            steps=int(data.attrs["steps"]),
            stepper=data.attrs["stepper"],
            follow=data.attrs.get("follow"),
            version=data.attrs["jaxfil_version"],
            compact=bool(data.attrs.get("compact", False)),
            section=data.attrs.get("section"),
            max_return=None if longest is None else float(longest),
            observe=data.attrs.get("observe"),
        ),
        labels=_labels(data, swept),
        errors=data["error"].values if "error" in data else None,
    )


def _labels(data: Dataset, swept: tuple[str, ...]) -> Labels:
    """What was called how, from the names of components and the attributes of parameters."""
    components = data["component"].values
    names = () if components.dtype.kind == "i" else tuple(map(str, components))
    units = dict(zip(names, map(str, data["unit"].values), strict=True)) if "unit" in data else {}
    told = {name: data[key_of(name)].attrs for name in swept}
    units |= {name: attrs["units"] for name, attrs in told.items() if "units" in attrs}
    symbols = {n: attrs["long_name"] for n, attrs in told.items() if "long_name" in attrs}
    symbols |= json.loads(data.attrs.get("symbols", "{}"))  # older files have none
    known = {name: unit for name, unit in units.items() if unit}
    return Labels(names, tuple(sorted(symbols.items())), tuple(sorted(known.items())))


def _parameters(data: Dataset, dtype: np.dtype) -> dict[str, np.ndarray]:
    """The parameters that were not swept, by name."""
    scalars = {key: np.asarray(v, dtype) for key, v in data.attrs.items() if key not in ATTRIBUTES}
    arrays = {key: data[key].values for key in data if key not in {*VARIABLES, "x0"}}
    return {
        key[:-1] if key[:-1] in VARIABLES | ATTRIBUTES else key: value
        for key, value in sorted((scalars | arrays).items())
    }
