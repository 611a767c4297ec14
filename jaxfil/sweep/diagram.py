"""Bifurcation diagrams: long-term motions against one parameter or several."""

import functools as ft
import json
import math

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxfil.model import dataset_io
from jaxfil.model.card import counted, precision
from jaxfil.model.dataset import (
    axis_of,
    component_coordinates,
    header,
    key_of,
    outcome_variables,
    quantity_entries,
)
from jaxfil.model.dataset_io import NamedArrays, Variable
from jaxfil.model.drawing import draw
from jaxfil.model.labels import Labels
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.types import Axes, Dataset, PathLike
from jaxfil.sweep.conditions import CONDITIONS, Conditions, condition_entries
from jaxfil.xla.thresholds import SAME_STATE

# Names of its data set that are not parameters.
TAKEN = {"x", "t", "outcome", "outcome_code", "error", "sample", "component", "point", "unit"}
TAKEN |= {"averages", "quantity", "quantities"}
TAKEN |= {"swept", "symbols", "halvings"} | CONDITIONS


def same_state(
    xs: np.ndarray, tolerance: float, least: float, spread: np.ndarray | float = np.inf
) -> np.ndarray:
    """The largest distance of equal states of a motion, (…, k, n), per component, (…, n). A motion
    smaller than `least` has decayed. It is relative to the `spread` of components, (n,), where that
    is smaller than they are."""
    size = np.max(np.abs(xs), axis=-2)
    largest = np.maximum(np.max(size, axis=-1, keepdims=True), least)
    rounding = SAME_STATE * np.finfo(xs.dtype).eps * largest
    return np.maximum(tolerance * np.maximum(np.minimum(size, spread), least), rounding)


def periods_of(xs: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """The number of samples (…, k, n) after which each motion is within the distances (…, n) of
    where it was; 0 where there is none up to k/2."""
    # The shortest period that fits is chosen, because its multiples fit too.
    found = np.zeros(xs.shape[:-2], int)
    for m in range(1, xs.shape[-2] // 2 + 1):
        apart = np.max(np.abs(xs[..., m:, :] - xs[..., :-m, :]), axis=-2)
        found[(found == 0) & np.all(apart <= bound, axis=-1)] = m
    return found


class BifurcationDiagram(eqx.Module):
    """The long-term motion against a parameter, or several.

    Lanes are along the first dimension of its arrays, shape (p,), or along one dimension for each
    parameter of a grid, shape (p1, p2, …).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jf.bifurcation_diagram(
    ...     jf.systems.SDOscillator(), "omega", jnp.array([0.6, 1.2]), jnp.array([0.3, 0.1]),
    ...     transient=20, samples=5, steps=20, stepper=jf.RK4(), progress=False
    ... ).successful.tolist()
    [True, True]
    """

    values: Float[np.ndarray, " p"] | Float[np.ndarray, "p k"] | tuple[np.ndarray, ...]
    """The swept values, shape (p,); for a grid one array for each of its parameters, where
    `xs[i, j]` belongs to `values[0][i]` and `values[1][j]`; for single points shape (p, k)."""
    xs: Float[np.ndarray, "*shape samples n"]
    """`xs[i, k]` is the state of lane i at its k-th sample, a multiple of the forcing period or a
    crossing of the section, or its observed value; NaN after a failure of the lane."""
    results: RESULTS
    """The outcome of each lane; `jf.RESULTS.names(diagram.results)[i]` is its name for lane i."""
    parameter: str | tuple[str, ...] = eqx.field(static=True)
    """The name of the swept parameter, or a tuple of names."""
    system: str = eqx.field(static=True)
    """The name of the system's class."""
    conditions: Conditions
    """The other arguments of the sweep."""
    labels: Labels = eqx.field(static=True, default=Labels())
    """Names of its quantities in pictures and named arrays."""
    errors: Float[np.ndarray, "*shape n"] | None = None
    """Estimated largest |xs − exact| of each lane and component, if requested, from the largest
    distance to a run at half the step. NaN where one of the two failed. For a chaotic lane, whose
    samples are on the attractor but not on the exact orbit of the initial state, it is as large as
    the attractor."""
    times: Float[np.ndarray, "*shape samples"] | None = None
    """The times of the sampled crossings, whose `numpy.diff` are the return times; NaN after a
    failure of the lane. None for once a forcing period."""
    halvings: Int[np.ndarray, "*shape"] | None = None
    """The number of halved steps of each lane."""
    averages: dict[str, Float[np.ndarray, "..."]] | None = None
    """Averages over the time of the samples, by name: `averages["power"][i]` belongs to lane i and
    is NaN if it failed. None without averages."""

    @property
    def successful(self) -> np.ndarray:
        """Whether each lane reached its end, shape (p,), or the shape of the grid."""
        return np.asarray(self.results == RESULTS.successful)

    def plot(self, ax: Axes | None = None, component: int = 0) -> Axes:
        """Draw one component of the samples against the parameter, or, on a grid of two, the map of
        periods (`jaxfil.plot.parameter_map`); returns the matplotlib axes."""
        return draw(self, ax=ax, component=component)

    def periods(self, tolerance: float = 1e-4) -> np.ndarray:
        r"""The period of each lane's motion in forcing periods, or in returns to the section,
        integers of shape (p,) or the grid's.

        It is the least m with max_k |x[k + m] − x[k]| ≤ `tolerance` · max_k |x[k]| in every
        component, over all samples and for m up to half their number. It is 0 without such m
        (chaos, a torus, a longer period or an unfinished transient), and −1 where the lane failed.
        A component below 1024 eps of the lane's largest one is rounding, or has decayed, and has no
        separate period. A motion below eps times the largest initial state has decayed to rest at
        zero, of period 1.
        """
        # Relative to the largest |x| of the lane instead of its spread, which is zero for a motion
        # of period one.
        found = periods_of(self.xs, same_state(self.xs, tolerance, self.decayed))
        return np.where(self.successful, found, -1)

    @property
    def decayed(self) -> float:
        """The size below which a motion has decayed, eps times the largest initial state; 0 for
        observed values, which have other units."""
        if self.conditions.observe is not None:
            return 0.0
        largest = np.max(np.abs(self.conditions.x0), initial=0.0)
        return float(np.finfo(self.xs.dtype).eps * largest)

    def to_xarray(self) -> Dataset:
        """An `xarray.Dataset` of `x` (parameters, sample, component), of `outcome` (parameters)
        in words and `outcome_code`, of `error` (parameters, component) if errors were
        estimated, of the times `t` (parameters, sample) of crossings of a section, and of
        `averages` (parameters, quantity), whose `quantity` is a name, or one with an index.

        The codes belong to this version. Components have the names defined by the system, and a
        coordinate `unit` if it defines units; parameters have their symbol as `long_name`. The
        attributes have all other conditions: the system, its other parameters, the initial state,
        steps and stepper. Points in parameter space have the dimension `point` and a coordinate for
        each parameter. Needs the package xarray.
        """
        return dataset_io.to_xarray(self.named_arrays())

    def named_arrays(self) -> NamedArrays:
        """Arrays with dimensions and attributes that `save` writes, for every file format."""
        dims, coordinates = self._coordinates()
        samples, n = self.xs.shape[-2:]
        variables: dict[str, Variable] = {
            "x": ((*dims, "sample", "component"), self.xs),
            **outcome_variables(self.results, dims),
        }
        if self.errors is not None:
            variables["error"] = (*dims, "component"), self.errors
        if self.times is not None:
            variables["t"] = (*dims, "sample"), self.times
        if self.halvings is not None:
            variables["halvings"] = dims, self.halvings
        arrays, given = condition_entries(self.conditions, TAKEN, dims)
        coordinates["sample"] = "sample", np.arange(samples)
        coordinates |= component_coordinates(self.labels, n)
        names = (self.parameter,) if isinstance(self.parameter, str) else self.parameter
        attributes = header("BifurcationDiagram") | {"system": self.system}
        attributes |= {"swept": ", ".join(names), **given}
        if self.averages is not None:
            averages, quantities, shapes = quantity_entries(self.averages, dims)
            variables["averages"], coordinates["quantity"] = averages, quantities
            attributes["quantities"] = shapes
        if self.labels.symbols:
            attributes["symbols"] = json.dumps(dict(self.labels.symbols), ensure_ascii=False)
        return NamedArrays(variables | arrays, coordinates, attributes, self._npz_names())

    def _npz_names(self) -> dict[str, str]:
        """Names in an .npz, equal to the names of the fields here."""
        names = {"x": "xs", "outcome": "results", "error": "errors", "swept": "parameter"}
        names["t"] = "times"
        if isinstance(self.parameter, str):
            names[key_of(self.parameter, TAKEN)] = "values"
        return names

    def _coordinates(self) -> tuple[tuple[str, ...], dict[str, Variable]]:
        """The dimensions of a lane, and the values of the parameters along them."""
        if isinstance(self.parameter, str):
            key = key_of(self.parameter, TAKEN)
            return (key,), {key: axis_of(self.labels, self.parameter, key, np.asarray(self.values))}
        keys = tuple(key_of(name, TAKEN) for name in self.parameter)
        if isinstance(self.values, tuple):
            along, columns = keys, self.values
        else:
            along, columns = ("point",) * len(keys), self.values.T
        axes = map(ft.partial(axis_of, self.labels), self.parameter, along, columns)
        return tuple(dict.fromkeys(along)), dict(zip(keys, axes, strict=True))

    def save(self, path: PathLike) -> None:
        """Write to a netCDF file (`path` ends in .nc), a Zarr store (.zarr) or an .npz.

        `jaxfil.load(path)` returns the same diagram, bit for bit. `xarray.open_dataset` opens the
        first two, which need `pip install 'jaxfil[xarray]'`; `numpy.load` opens the last, in which
        the numbers have the names of the fields here. An existing file is replaced.
        """
        dataset_io.save(self.named_arrays(), path)

    def __repr__(self) -> str:
        *shape, samples, n = self.xs.shape
        if isinstance(self.values, tuple):
            swept = [_range(*pair) for pair in zip(self.parameter, self.values, strict=True)]
        elif isinstance(self.parameter, str):
            swept = [_range(self.parameter, self.values)]
        else:
            swept = [f"  {', '.join(self.parameter)}: {shape[0]} points"]
        ended = counted(self.results)
        good = f"{ended.pop('successful', 0)} of {math.prod(shape)} lanes successful"
        lines = [
            f"BifurcationDiagram of {self.system}{precision(self.xs)}",
            *swept,
            f"  {samples} samples of {n} components each",
            f"  {', '.join([good, *(f'{count} {name}' for name, count in ended.items())])}",
        ]
        if self.halvings is not None and self.halvings.any():
            lines.append(_halvings_line(self.halvings))
        if self.errors is not None:
            lines.append(_errors_line(self.errors))
        return "\n".join(lines)


def _range(name: str, axis: np.ndarray) -> str:
    return f"  {name}: {axis.size} values from {axis[0]:g} to {axis[-1]:g}"


def _halvings_line(halvings: np.ndarray) -> str:
    """The number of lanes with halved steps, and the largest number of halvings."""
    lanes = int(np.sum(halvings > 0))
    plural = "" if lanes == 1 else "s"
    return f"  steps halved in {lanes} lane{plural}, {int(halvings.max())} times at most"


def _errors_line(errors: np.ndarray) -> str:
    """The errors of lanes, each the largest of its components."""
    lanes = np.max(errors, axis=-1)
    lanes = lanes[np.isfinite(lanes)]  # not `nanmax`, which warns without finite values
    if not lanes.size:
        return "  error unknown: no lane has ended, or none at half the step"
    return (
        f"  error about {np.median(lanes):.1e} in the median lane, {lanes.max():.1e} at most, from "
        "a run at half the step"
    )
