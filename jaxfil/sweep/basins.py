"""Basins of attraction over a grid of initial states."""

import dataclasses
import functools as ft
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from jaxfil.model import check, dataset_io
from jaxfil.model.card import precision
from jaxfil.model.dataset import (
    component_coordinates,
    header,
    label_attributes,
    outcome_variables,
)
from jaxfil.model.dataset_io import NamedArrays, Variable
from jaxfil.model.drawing import draw
from jaxfil.model.labels import Labels
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import parameters
from jaxfil.model.system import System
from jaxfil.model.types import Axes, Dataset, PathLike, State
from jaxfil.sweep.conditions import CONDITIONS, Conditions, condition_entries
from jaxfil.sweep.diagram import BifurcationDiagram, periods_of, same_state
from jaxfil.sweep.sweep import bifurcation_diagram

# Names of its data set that are not parameters.
TAKEN = {"label", "outcome", "outcome_code", "attractor", "period", "axis_0", "axis_1", "motion"}
TAKEN |= {"point", "component", "unit", "components", "symbols", "units", "x0_dtype"} | CONDITIONS

# Arguments of `bifurcation_diagram` that are passed on.
_OPTIONS = ("steps", "stepper", "progress", "checkpoint", "compact", "section", "max_return")
# Labels of states without a periodic attractor.
APERIODIC, FAILED = 0, -1


class Basins(eqx.Module):
    """The attractor of each initial state of a grid.

    >>> import jaxfil as jf
    >>> found = jf.basins_of_attraction(
    ...     jf.systems.SDOscillator(omega=0.6, zeta=0.1), ([-1.0, 1.0], [0.1]), transient=20,
    ...     samples=8, steps=20, stepper=jf.RK4(), progress=False)
    >>> [len(section) for section in found.attractors]  # two of period one
    [1, 1]
    """

    axes: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]]
    """The grid's values of the two `components`, shapes (a,) and (b,)."""
    labels: Int[np.ndarray, "a b"]
    """`labels[i, j]` belongs to `axes[0][i]` and `axes[1][j]`. It is k ≥ 1 for `attractors[k - 1]`,
    0 without a detected period (chaos, a torus, a period longer than half the samples, or an
    unfinished transient), and −1 for a failed lane."""
    attractors: tuple[Float[np.ndarray, "period n"], ...]
    """The section points of each periodic attractor, shape (its period, n), short periods first.
    Chaotic motions share the label 0 and have no entry."""
    results: RESULTS
    """The outcome of each lane, shape (a, b)."""
    components: tuple[int, int] = eqx.field(static=True)
    """The numbers of the two components of the state."""
    system: str = eqx.field(static=True)
    """The name of the system's class."""
    conditions: Conditions
    """The conditions of the sweep; `x0` has the other components, shape (n,)."""
    names: Labels = eqx.field(static=True, default=Labels())
    """Names of the components in pictures."""

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the basins and the section points of their attractors; returns the axes."""
        return draw(self, ax=ax)

    def to_xarray(self) -> Dataset:
        """An `xarray.Dataset` of `label` and `outcome` (axis_0, axis_1), whose coordinates are the
        two components of the initial state, and of the section points `attractor` (motion, point,
        component), NaN beyond the `period` (motion) of each.

        The attributes have the system, its parameters and the other conditions. Needs the package
        xarray.
        """
        return dataset_io.to_xarray(self.named_arrays())

    def save(self, path: PathLike) -> None:
        """Write to a netCDF file (`path` ends in .nc), a Zarr store (.zarr) or an .npz.

        `jaxfil.load(path)` returns the same basins, bit for bit. An existing file is replaced.
        """
        dataset_io.save(self.named_arrays(), path)

    def named_arrays(self) -> NamedArrays:
        """The data that `save` writes, for every file format."""
        lanes = ("axis_0", "axis_1")
        longest = max((len(points) for points in self.attractors), default=0)
        n = self.conditions.x0.size
        padded = np.full((len(self.attractors), longest, n), np.nan, self.conditions.x0.dtype)
        for rows, points in zip(padded, self.attractors, strict=True):
            rows[: len(points)] = points
        variables: dict[str, Variable] = {
            "label": (lanes, self.labels),
            **outcome_variables(self.results, lanes),
        }
        if longest:  # netCDF has no dimension of length zero
            variables["attractor"] = ("motion", "point", "component"), padded
            variables["period"] = "motion", np.array([len(points) for points in self.attractors])
        arrays, given = condition_entries(self.conditions, TAKEN, ())
        coordinates = component_coordinates(self.names, n)
        for lane, i, values in zip(lanes, self.components, self.axes, strict=True):
            name = self.names.state[i] if self.names.state else f"x[{i}]"
            unit = self.names.unit(name)
            words = {"long_name": name} | ({"units": unit} if unit else {})
            coordinates[lane] = lane, values, words
        attributes = header("Basins") | {"system": self.system, **given}
        attributes |= label_attributes(self.names) | {"components": np.array(self.components)}
        # The numbers of attributes are read as float64, and there may be no attractor.
        attributes["x0_dtype"] = self.conditions.x0.dtype.name
        return NamedArrays(variables | arrays, coordinates, attributes)

    def __repr__(self) -> str:
        a, b = self.labels.shape
        told = precision(self.attractors[0]) if self.attractors else ""
        lines = [f"Basins of {self.system}{told}: {a} × {b} initial states"]
        for k, points in enumerate(self.attractors, start=1):
            state = np.array2string(points[0], precision=6, separator=", ")
            lines.append(f"  {k}: period {len(points)} through {state}, {self._share(k)}")
        for label, meaning in ((APERIODIC, "no period found"), (FAILED, "failed")):
            if (self.labels == label).any():
                lines.append(f"  {meaning}: {self._share(label)}")
        return "\n".join(lines)

    def _share(self, label: int) -> str:
        return f"{np.mean(self.labels == label):.1%} of the states"


def basins_of_attraction(
    system: System,
    axes: tuple[ArrayLike | Sequence[float], ArrayLike | Sequence[float]],
    *,
    x0: State | None = None,
    components: tuple[int, int] = (0, 1),
    transient: int = 500,
    samples: int = 32,
    tolerance: float = 1e-4,
    **options: Any,
) -> Basins:
    """The long-term motion of a system from every initial state of a grid.

    Each state runs `transient` forcing periods T from t = 0, then `samples` more. A motion has the
    period m if

        |x(t + mT) − x(t)| ≤ tolerance · min(max |x|, R)

    in every component, with its range R over all initial states and samples, which is smaller than
    |x| for an offset with a small variation, such as a temperature in kelvin. Below eps times the
    largest initial state of the grid it has decayed to rest at zero, of period 1. Motions of one
    period are one attractor if one passes, at the phase of the section, near a point of the other.

    **Arguments**

    - `system`: a `System` with a `period`, or any `System` with a `section`. It must have a float
      field.
    - `axes`: the values of the two components in the grid, shapes (a,) and (b,).
    - `x0`: the other components of every initial state, shape (n,); by default zeros (2,).
    - `components`: the two components of the state along the grid.
    - `transient`: forcing periods, or crossings, before the first sample. Near a bifurcation
      transients are long.
    - `samples`: number of sampled forcing periods, or crossings; the longest detectable period is
      half of it.
    - `tolerance`: the largest distance of a motion from its earlier state, relative to its size or
      its range R.
    - `options`: `steps`, `stepper`, `progress`, `checkpoint`, `compact`, `section` and `max_return`
      of `bifurcation_diagram`.

    **Returns** `Basins`.

    **Outcomes**, one for each lane in `results`: `successful`, `max_steps_reached`, `zeno`,
    `nonunique`, `mode_undecided`, `reset_undecided`, `undeclared_sliding`, `nonfinite`,
    `step_too_long`, `invalid_period`, `section_not_reached`, and after Ctrl-C `interrupted`. A lane
    that did not succeed has the label −1.

    **Source**: textbook; H. E. Nusse and J. A. Yorke, Dynamics: Numerical Explorations, Springer
    (1998), chapter 7.

    >>> import jaxfil as jf
    >>> found = jf.basins_of_attraction(
    ...     jf.systems.SDOscillator(omega=0.6, zeta=0.1), ([-1.0, 1.0], [0.1]), transient=20,
    ...     samples=8, steps=20, stepper=jf.RK4(), progress=False)
    >>> found.labels.ravel().tolist()  # one about −1, one about +1
    [1, 2]
    """
    check.system("system", system)
    unknown = [name for name in options if name not in _OPTIONS]
    if unknown:
        raise TypeError(
            f"`{unknown[0]}` is not an argument of `basins_of_attraction`. Options of "
            f"`bifurcation_diagram` that it takes are {', '.join(_OPTIONS)}."
        )
    if options.get("section") is None:
        if system.period is None:
            raise ValueError(
                "`system` must be forced, since motions are sampled once a forcing period, and the "
                f"period of {type(system).__name__} is None. Give a `section` to sample at."
            )
        check.period(system, jnp.result_type(float))
    several = axes if isinstance(axes, (tuple, list, np.ndarray)) else ()
    if len(several) != 2:
        raise ValueError(
            f"`axes` must be a pair, the values of two components, got {check.told(axes)}."
        )
    tolerance = float(check.scalar("tolerance", tolerance, float, positive=True))
    values = tuple(_axis(i, axis) for i, axis in enumerate(axes))
    rest = np.zeros(2) if x0 is None else np.asarray(check.state("x0", x0), float)
    first, second = _components(components, rest.size)
    states = np.broadcast_to(rest, (len(values[0]), len(values[1]), rest.size)).copy()
    states[..., first], states[..., second] = np.meshgrid(*values, indexing="ij")
    # One lane for each state, as a sweep over a parameter with a constant value, so that it uses
    # the program, the chunks and the checkpoints of other sweeps.
    name, value = _a_parameter(system)
    diagram = bifurcation_diagram(
        system,
        name,
        np.full(states[..., 0].size, value),
        jnp.asarray(states.reshape(-1, rest.size)),
        transient=transient,
        samples=samples,
        **options,
    )
    labels, attractors = _classified(diagram, tolerance, _ranges(diagram, states))
    shape = states.shape[:2]
    return Basins(
        axes=(values[0], values[1]),
        labels=labels.reshape(shape),
        attractors=attractors,
        results=jax.tree.map(lambda codes: np.reshape(codes, shape), diagram.results),
        components=(first, second),
        system=type(system).__name__,
        conditions=dataclasses.replace(
            diagram.conditions,
            parameters={k: np.asarray(v, diagram.xs.dtype) for k, v in parameters(system).items()},
            x0=rest.astype(diagram.xs.dtype),
        ),
        names=diagram.labels.of(()),
    )


def _a_parameter(system: System) -> tuple[str, float]:
    """A parameter that is one number, or an entry of an array, and its value."""
    known = {name: np.asarray(leaf) for name, leaf in parameters(system).items() if np.size(leaf)}
    if not known:
        raise ValueError(f"`system` must have a float field, got {type(system).__name__}.")
    name = min(known, key=lambda name: known[name].ndim)
    index = ",".join("0" * known[name].ndim)
    return f"{name}[{index}]" if index else name, known[name].flat[0]


def _axis(i: int, axis: Any) -> np.ndarray:
    must = "finite numbers of shape (k,)"
    values = check.known_numbers(f"axes[{i}]", axis, must).astype(float)
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise ValueError(f"`axes[{i}]` must be {must}, got {check.told(axis)}.")
    return values


def _components(components: Any, n: int) -> tuple[int, int]:
    pair = tuple(components) if isinstance(components, (tuple, list, np.ndarray)) else ()
    whole = all(check.is_whole(c) and 0 <= c < n for c in pair)
    if not whole or len(pair) != 2 or len({*pair}) != 2:
        raise ValueError(
            f"`components` must be two different ones from 0 to {n - 1}, got "
            f"{check.told(components)}."
        )
    return pair


def _ranges(diagram: BifurcationDiagram, states: np.ndarray) -> np.ndarray:
    """The range of each component, over initial states and samples."""
    n = states.shape[-1]
    every = np.concatenate([states.reshape(-1, n), diagram.xs.reshape(-1, n)])
    return np.nanmax(every, axis=0) - np.nanmin(every, axis=0)


def _classified(
    diagram: BifurcationDiagram, tolerance: float, ranges: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """The label of every lane, and the section points of every attractor."""
    equal = ft.partial(same_state, tolerance=tolerance, least=diagram.decayed, spread=ranges)
    found = periods_of(diagram.xs, equal(diagram.xs))
    periods = np.where(diagram.successful, found, FAILED)
    # Short periods first; each attractor claims all lanes that pass near it, in one pass over the
    # lanes per attractor, of which there are few.
    labels = np.where(periods > 0, APERIODIC, periods)
    attractors: list[np.ndarray] = []
    for period in np.unique(periods[periods > 0]):
        left = np.flatnonzero(periods == period)
        while left.size:
            points = diagram.xs[left[0], -period:]  # after the longest transient
            # Ten times the largest distance at which two lanes of one motion repeat.
            near = 10 * equal(points)
            away = np.abs(diagram.xs[left, -1][:, None] - points)
            same = np.any(np.all(away <= near, axis=-1), axis=-1)
            attractors.append(points)
            labels[left[same]] = len(attractors)
            left = left[~same]
    return labels, tuple(attractors)
