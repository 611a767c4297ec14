"""A bifurcation diagram: motions settled on, against one parameter or several.

Samples and outcomes of all lanes and the conditions they ran under enter; pictures, named arrays
and files leave, and what `save` wrote comes back.
"""

import math
import os
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxfil.model.card import precision
from jaxfil.model.drawing import draw
from jaxfil.model.labels import Labels
from jaxfil.model.outcomes import RESULTS, outcome_codes, outcome_names, outcomes
from jaxfil.sweep import dataset_io

# Names of a data set that are no parameter's.
_VARIABLES = {"x", "outcome", "error", "sample", "component", "point", "unit"}
_ATTRIBUTES = {
    "system",
    "swept",
    "x0",
    "transient",
    "steps",
    "stepper",
    "follow",
    "jaxfil_version",
}


class Conditions(eqx.Module):
    """What a sweep ran with besides the values swept.

    `parameters` holds the system's other float leaves by name; `x0` is the initial state, shape
    (n,), or one for each lane; `version` is jaxfil's.
    """

    parameters: dict[str, np.ndarray]
    x0: np.ndarray
    transient: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    stepper: str = eqx.field(static=True)
    follow: str | None = eqx.field(static=True)
    version: str = eqx.field(static=True)


class BifurcationDiagram(eqx.Module):
    """The motion settled on against a parameter, or several.

    `xs[i, k]` is the state at the k-th sampled forcing period (t a multiple of the period) for
    `values[i]`; NaN from where a lane failed. `results[i]` is the lane's outcome.

    In a grid of parameters, `parameter` is a tuple of names and `values` one of arrays, and
    `xs[i, j, k]` belongs to `values[0][i]` and `values[1][j]`; of points in parameter space,
    `values` has shape (p, number of names).

    `errors[i]` estimates how far the samples of a lane are from the exact ones of that initial
    state: the largest distance in each component from a run at half the step. It is of the size of
    the attractor where a lane is chaotic, whose samples are on the attractor but no longer those of
    the initial state.
    """

    values: Float[np.ndarray, " p"] | Float[np.ndarray, "p k"] | tuple[np.ndarray, ...]
    xs: Float[np.ndarray, "*shape samples n"]
    results: RESULTS
    parameter: str | tuple[str, ...] = eqx.field(static=True)
    system: str = eqx.field(static=True)
    conditions: Conditions
    labels: Labels = eqx.field(static=True, default=Labels())
    """What pictures and named arrays call its quantities."""
    errors: Float[np.ndarray, "*shape n"] | None = None
    """Estimated largest |xs − exact| of each lane, component by component, if asked for; NaN where
    the lane or the run at half the step failed."""

    @property
    def successful(self) -> np.ndarray:
        """Which lanes reached their end, shape (p,), or that of the grid."""
        return np.asarray(self.results == RESULTS.successful)

    def plot(self, ax: Any = None, component: int = 0) -> Any:
        """Draw one component of the samples against the parameter, or, on a grid of two, the map of
        periods (`jaxfil.plot.parameter_map`); returns the matplotlib axes."""
        return draw(self, ax=ax, component=component)

    def periods(self, tolerance: float = 1e-4) -> np.ndarray:
        r"""The period of each lane's motion in forcing periods, integers of shape (p,) or the
        grid's.

        It is the least m with max_k |x[k + m] − x[k]| ≤ `tolerance` · max_k |x[k]| in every
        component, over all samples and for m up to half their number; 0 where there is none
        (chaos, a torus, a longer period or a transient not yet over), −1 where the lane failed.
        """
        xs = self.xs
        bound = tolerance * np.max(np.abs(xs), axis=-2)
        found = np.where(self.successful, 0, -1)
        for m in range(1, xs.shape[-2] // 2 + 1):
            apart = np.max(np.abs(xs[..., m:, :] - xs[..., :-m, :]), axis=-2)
            found[(found == 0) & np.all(apart <= bound, axis=-1)] = m
        return found

    def to_xarray(self) -> Any:
        """An `xarray.Dataset` of `x` (parameters, sample, component) and `outcome` (parameters),
        and of `error` (parameters, component) if errors were estimated.

        Outcomes are words. Components have the names that the system gives them, and a coordinate
        `unit` where it gives units; parameters have their symbol as `long_name`. The attributes
        say what else it takes to make the diagram again: the system, its other parameters, the
        initial state, steps and stepper. Points in parameter space have the dimension `point` and
        a coordinate for each parameter. Needs the package xarray.
        """
        dims, coordinates = self._coordinates()
        samples, n = self.xs.shape[-2:]
        variables: dict[str, Any] = {
            "x": ((*dims, "sample", "component"), self.xs),
            "outcome": (dims, outcome_names(self.results).astype(object)),
        }
        if self.errors is not None:
            variables["error"] = (*dims, "component"), self.errors
        if self.conditions.x0.ndim > 1:
            variables["x0"] = (*dims, "component"), self.conditions.x0
        for name, value in self.conditions.parameters.items():
            if value.ndim:  # a file's attributes are numbers, or rows of them
                variables[_key(name)] = [f"{_key(name)}_{i}" for i in range(value.ndim)], value
        counts = {
            "sample": ("sample", np.arange(samples)),
            "component": ("component", self._components(n)),
        }
        units = [self.labels.unit(name) for name in self.labels.state]
        if any(units):
            counts["unit"] = "component", np.array(units, object)
        return dataset_io.dataset(variables, coordinates | counts, self._attributes())

    def _components(self, n: int) -> np.ndarray:
        names = self.labels.state
        return np.array(names, object) if names else np.arange(n)

    def _axis(self, name: str, dimension: str, values: Any) -> tuple[str, Any, dict]:
        """A parameter's values along a dimension, with its symbol and unit as xarray shows them."""
        told = {"long_name": self.labels.symbol(name), "units": self.labels.unit(name)}
        attributes = {key: word for key, word in told.items() if word not in ("", name)}
        return dimension, values, attributes

    def _coordinates(self) -> tuple[tuple[str, ...], dict[str, Any]]:
        """The dimensions of a lane, and the values of the parameters along them."""
        if isinstance(self.parameter, str):
            key = _key(self.parameter)
            return (key,), {key: self._axis(self.parameter, key, self.values)}
        keys = tuple(map(_key, self.parameter))
        if isinstance(self.values, tuple):
            along, columns = keys, self.values
        else:
            along, columns = ("point",) * len(keys), self.values.T
        axes = map(self._axis, self.parameter, along, columns)
        return tuple(dict.fromkeys(along)), dict(zip(keys, axes, strict=True))

    def _attributes(self) -> dict[str, Any]:
        given = self.conditions
        several = not isinstance(self.parameter, str)
        attributes = {
            "system": self.system,
            "swept": ", ".join(self.parameter) if several else self.parameter,
            "transient": given.transient,
            "steps": given.steps,
            "stepper": given.stepper,
            "jaxfil_version": given.version,
        }
        if given.follow is not None:
            attributes["follow"] = given.follow
        if given.x0.ndim == 1:
            attributes["x0"] = given.x0
        scalars = {name: v for name, v in given.parameters.items() if v.ndim == 0}
        return attributes | {_key(name): float(value) for name, value in scalars.items()}

    def save(self, path: str | os.PathLike) -> None:
        """Write `to_xarray()` to a netCDF file (`path` ends in .nc) or a Zarr store (.zarr).

        `jaxfil.load(path)` gives the same diagram back, bit for bit; `xarray.open_dataset` opens
        it too. What was at `path` is replaced. Needs `pip install 'jaxfil[xarray]'`.
        """
        dataset_io.save(self.to_xarray(), path)

    def __repr__(self) -> str:
        *shape, samples, n = self.xs.shape
        if isinstance(self.values, tuple):
            swept = [_range(*pair) for pair in zip(self.parameter, self.values, strict=True)]
        elif isinstance(self.parameter, str):
            swept = [_range(self.parameter, self.values)]
        else:
            swept = [f"  {', '.join(self.parameter)}: {shape[0]} points"]
        lines = [
            f"BifurcationDiagram of {self.system}{precision(self.xs)}",
            *swept,
            f"  {samples} samples of {n} components each",
            f"  {int(self.successful.sum())} of {math.prod(shape)} lanes successful",
        ]
        if self.errors is not None:
            lines.append(_errors_line(self.errors))
        return "\n".join(lines)


def load(path: str | os.PathLike) -> BifurcationDiagram:
    """The bifurcation diagram that `BifurcationDiagram.save` wrote to `path`, bit for bit."""
    data = dataset_io.load(path)
    missing = (_ATTRIBUTES - {"follow", "x0"}) - {*data.attrs} | {"x", "outcome"} - {*data}
    if missing:
        raise ValueError(
            f"`path` must be a diagram that `save` has written; {os.fspath(path)!r} has no "
            f"{', '.join(sorted(missing))}."
        )
    dtype, swept = data["x"].dtype, tuple(data.attrs["swept"].split(", "))
    axes = [data[_key(name)].values for name in swept]
    if "point" in data["x"].dims:
        values = np.stack(axes, axis=1)
    else:
        values = axes[0] if len(swept) == 1 else tuple(axes)
    x0 = data["x0"].values if "x0" in data else np.reshape(data.attrs["x0"], (-1,)).astype(dtype)
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
        ),
        labels=_labels(data, swept),
        errors=data["error"].values if "error" in data else None,
    )


def _labels(data: Any, swept: tuple[str, ...]) -> Labels:
    """What was called how, from the names of components and the attributes of parameters."""
    components = data["component"].values
    names = () if components.dtype.kind == "i" else tuple(map(str, components))
    units = dict(zip(names, map(str, data["unit"].values), strict=True)) if "unit" in data else {}
    told = {name: data[_key(name)].attrs for name in swept}
    units |= {name: attrs["units"] for name, attrs in told.items() if "units" in attrs}
    symbols = {n: attrs["long_name"] for n, attrs in told.items() if "long_name" in attrs}
    known = {name: unit for name, unit in units.items() if unit}
    return Labels(names, tuple(sorted(symbols.items())), tuple(sorted(known.items())))


def _parameters(data: Any, dtype: Any) -> dict[str, np.ndarray]:
    """The parameters that were not swept, by name."""
    scalars = {key: np.asarray(v, dtype) for key, v in data.attrs.items() if key not in _ATTRIBUTES}
    arrays = {key: data[key].values for key in data if key not in {*_VARIABLES, "x0"}}
    return {
        key[:-1] if key[:-1] in _VARIABLES | _ATTRIBUTES else key: value
        for key, value in sorted((scalars | arrays).items())
    }


def _key(name: str) -> str:
    """The name of a parameter in a data set."""
    return f"{name}_" if name in _VARIABLES | _ATTRIBUTES else name


def _range(name: str, axis: np.ndarray) -> str:
    return f"  {name}: {axis.size} values from {axis[0]:g} to {axis[-1]:g}"


def _errors_line(errors: np.ndarray) -> str:
    """The errors of lanes, each the largest of its components."""
    lanes = np.max(errors, axis=-1)
    lanes = lanes[np.isfinite(lanes)]
    if not lanes.size:
        return "  error unknown: no lane has ended, or none at half the step"
    return (
        f"  error about {np.median(lanes):.1e} in the median lane, {lanes.max():.1e} at most, from "
        "a run at half the step"
    )
