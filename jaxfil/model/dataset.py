"""Conversion between results and named arrays, common to all results.

A result's arrays, outcomes, components and system become variables, coordinates and attributes, and
are read back from them. `dataset_io` writes and reads the files.
"""

import json
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.model.dataset_io import Attribute, NamedArrays, Variable
from jaxfil.model.labels import Labels
from jaxfil.model.other_fields import other_fields
from jaxfil.model.outcomes import RESULTS, outcome_codes, outcome_names, outcomes
from jaxfil.model.parameter import cast, parameters, replace_leaves
from jaxfil.model.system import System
from jaxfil.version import __version__

_Record = TypeVar("_Record")

Fields = Mapping[str, tuple[str, str]]
"""Names of arrays in a data set, each with the field of the record and its dimensions."""

TYPE = "jaxfil_type"
"""The attribute with the class of the result in a data set."""

OTHERS = "other_fields"
"""The attribute with the fields of a system that are no parameters, absent in older files."""


def header(kind: str) -> dict[str, Attribute]:
    """The first attributes of every data set."""
    return {TYPE: kind, "jaxfil_version": __version__}


def variables_of(record: Any, fields: Fields, batch: Sequence[str] = ()) -> dict[str, Variable]:
    """The fields of a record that are not None; `batch` names the leading dimensions."""
    given = {name: (getattr(record, field), dims) for name, (field, dims) in fields.items()}
    return {
        name: ((*batch, *dims.split()), np.asarray(value))
        for name, (value, dims) in given.items()
        if value is not None
    }


def fields_from(data: NamedArrays, fields: Fields) -> dict[str, Any]:
    """The fields of a record, None where the data set has no array."""
    return {
        field: exact_array(data.array(name)) if name in data else None
        for name, (field, _) in fields.items()
    }


def record(kind: type[_Record], **fields: Any) -> _Record:
    """A record of one lane, or of a batch as `jax.vmap` returns it. The declared dimensions are the
    dimensions of one lane, and a call of the class would check them."""
    made = object.__new__(kind)
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    return made


def exact_array(array: np.ndarray) -> Array:
    """The numbers of a file as a JAX array, bit for bit, or an error where JAX would round them to
    float32."""
    if array.dtype == np.float64 and jnp.result_type(float) != np.float64:
        raise ValueError(
            "`path` must hold float32 numbers unless JAX computes in float64, got float64; call "
            'jax.config.update("jax_enable_x64", True) first.'
        )
    return jnp.asarray(array)


def outcome_variables(results: RESULTS, dims: Sequence[str]) -> dict[str, Variable]:
    """Outcomes as names, which are read back, and as integers of this version."""
    words = outcome_names(results)
    return {"outcome": (dims, words), "outcome_code": (dims, outcome_codes(words))}


def outcomes_from(data: NamedArrays, name: str = "outcome") -> RESULTS:
    """The outcomes with these names."""
    return outcomes(outcome_codes(data.array(name)))


def component_coordinates(labels: Labels, n: int) -> dict[str, Variable]:
    """The names of n components, or their numbers, and their units if any."""
    names = np.array(labels.state) if labels.state else np.arange(n)
    coordinates: dict[str, Variable] = {"component": ("component", names)}
    units = [labels.unit(name) for name in labels.state]
    if any(units):
        coordinates["unit"] = "component", np.array(units)
    return coordinates


def quantity_entries(
    averages: Mapping[str, np.ndarray], dims: Sequence[str]
) -> tuple[Variable, Variable, str]:
    """Averages of lanes along these dimensions in one array, the names of its columns, and the
    shape of each quantity."""
    columns, names = [], []
    for name, v in averages.items():
        columns.append(v.reshape(*v.shape[: len(dims)], -1))
        own = np.ndindex(v.shape[len(dims) :])
        names += [f"{name}[{','.join(map(str, i))}]" if i else name for i in own]
    shapes = {name: v.shape[len(dims) :] for name, v in averages.items()}
    written = json.dumps(shapes, ensure_ascii=False)
    array = np.concatenate(columns, axis=-1)
    return ((*dims, "quantity"), array), ("quantity", np.array(names)), written


def quantities_from(data: NamedArrays) -> dict[str, np.ndarray] | None:
    """The averages that `quantity_entries` stored; None without averages."""
    if "averages" not in data:
        return None
    rows, found, start = data.array("averages"), {}, 0
    for name, shape in json.loads(data.attributes["quantities"]).items():
        stop = start + math.prod(shape)
        found[name] = rows[..., start:stop].reshape(*rows.shape[:-1], *shape)
        start = stop
    return found


def axis_of(labels: Labels, name: str, dimension: str, values: np.ndarray) -> Variable:
    """A parameter's values along a dimension, with its symbol and unit in xarray's form."""
    symbol, unit = labels.symbol(name), labels.unit(name)
    # A symbol equal to the name is omitted, because xarray shows the name by itself.
    attributes = {"long_name": symbol} if symbol != name else {}
    return dimension, values, attributes | ({"units": unit} if unit else {})


def label_attributes(labels: Labels) -> dict[str, Attribute]:
    """All labels, where coordinates do not include all of them."""
    known = {"symbols": dict(labels.symbols), "units": dict(labels.units)}
    return {key: json.dumps(pairs, ensure_ascii=False) for key, pairs in known.items() if pairs}


def labels_from(data: NamedArrays) -> Labels:
    """The labels stored by `component_coordinates` and `label_attributes`."""
    known = [json.loads(data.attributes.get(key, "{}")) for key in ("symbols", "units")]
    symbols, units = (tuple(pairs.items()) for pairs in known)
    return Labels(component_names(data), symbols, units)


def component_names(data: NamedArrays) -> tuple[str, ...]:
    """The names of the components; empty if they have numbers."""
    names = data.array("component")
    return () if names.dtype.kind == "i" else tuple(map(str, names))


def key_of(name: str, taken: Collection[str]) -> str:
    """The name of a parameter in a data set. A name used by the data set itself, with any number of
    underscores already appended, gets one more underscore."""
    return f"{name}_" if name.rstrip("_") in taken else name


def name_of(key: str, taken: Collection[str]) -> str:
    """The name of a parameter from its name in a data set, the inverse of `key_of`."""
    return key[:-1] if key.endswith("_") and key.rstrip("_") in taken else key


def parameter_entries(
    known: Mapping[str, np.ndarray], taken: Collection[str], batch: Sequence[str] = ()
) -> tuple[dict[str, Variable], dict[str, Attribute]]:
    """Arrays of parameters, and single numbers as attributes."""
    variables: dict[str, Variable] = {}
    attributes: dict[str, Attribute] = {}
    for name, value in known.items():
        key = key_of(name, taken)
        if value.ndim:  # attributes of a file are numbers, or rows of them
            own = own_dimensions(key, value.ndim - len(batch))
            variables[key] = (*batch, *own), value
        else:
            attributes[key] = float(value)
    return variables, attributes


def own_dimensions(name: str, number: int) -> list[str]:
    """The names of the dimensions of an array in a data set, which are no names of parameters."""
    # An array has no attributes that are parameters, as its path with a dot would name.
    return [f"{name}.dim_{i}" for i in range(number)]


def system_entries(
    system: System,
    taken: Collection[str],
    batch: Sequence[str] = (),
    lanes: Sequence[int] = (),
    skip: str = "",
) -> tuple[dict[str, Variable], dict[str, Attribute]]:
    """The name of a system, its parameters except `skip`, and its other fields; `lanes` is the
    shape of a batch."""
    known = {key: np.asarray(v) for key, v in parameters(system).items() if key != skip}
    variables, attributes = parameter_entries(known, taken, batch)
    others = json.dumps(other_fields(system, lanes))
    return variables, {"system": type(system).__name__, OTHERS: others, **attributes}


def system_from(
    data: NamedArrays,
    system: System | None,
    dtype: np.dtype,
    taken: Collection[str],
    skip: str = "",
) -> System:
    """`system` with the parameters of the data set; an error if it differs in anything else."""
    name = str(data.attributes["system"])
    if system is None or type(system).__name__ != name:
        given = "None" if system is None else repr(system)
        raise ValueError(
            f"`system` must be a {name}, the system of the result in `path`, got {given}."
        )
    keys = {leaf: key_of(leaf, taken) for leaf in parameters(system) if leaf != skip}
    numbers = {key for key, v in data.attributes.items() if isinstance(v, (float, np.floating))}
    strange = {*keys.values()} - {*data.variables} - numbers
    strange |= (numbers | {*data.variables}) - {*keys.values()} - {*taken}
    if strange:
        raise ValueError(
            f"`system` must have the parameters that `path` holds; they differ in "
            f"{', '.join(sorted(strange))}, got {system!r}."
        )
    _check_others(data, system)
    values = {
        leaf: data.array(key) if key in data.variables else data.attributes[key]
        for leaf, key in keys.items()
    }
    exact = {k: exact_array(np.asarray(v, dtype)) for k, v in values.items()}
    return replace_leaves(cast(system, dtype), exact)


def _check_others(data: NamedArrays, system: System) -> None:
    """Check that fields that are no parameters are those of the data set."""
    if OTHERS not in data.attributes:
        return
    held, given = json.loads(data.attributes[OTHERS]), other_fields(system)
    for name in sorted({*held, *given}):
        was, is_now = held.get(name, "absent"), given.get(name, "absent")
        if was != is_now:
            raise ValueError(
                f"`system` must be the system of the result in `path`, whose `{name}` is {was}, "
                f"got {is_now}."
            )
