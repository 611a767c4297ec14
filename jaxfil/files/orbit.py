"""Orbits and branches from their data sets."""

import json

import numpy as np

from jaxfil.files.solution import events_from, stepper_from
from jaxfil.model.dataset import (
    exact_array,
    fields_from,
    key_of,
    outcomes_from,
    record,
    system_from,
)
from jaxfil.model.dataset_io import NamedArrays, Variable
from jaxfil.model.parameter import get_parameter, replace_parameter
from jaxfil.model.system import System
from jaxfil.orbits.branch import Branch, SpecialPoint
from jaxfil.orbits.branch_arrays import TAKEN as BRANCH_TAKEN
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.orbit_arrays import OPTIONS, ORBIT, TAKEN
from jaxfil.orbits.shooting import ShootingOptions
from jaxfil.xla.known import stacked


def orbit_from(data: NamedArrays, system: System | None) -> Orbit:
    """The orbit."""
    return _orbit(data, system_from(data, system, data.array("x0").dtype, TAKEN))


def branch_from(data: NamedArrays, system: System | None) -> Branch:
    """The branch."""
    told, parameter = data.attributes, str(data.attributes["swept"])
    dtype = data.array("x0").dtype
    one = system_from(data, system, dtype, BRANCH_TAKEN, skip=parameter)
    get_parameter(one, parameter)
    values = data.array(key_of(parameter, BRANCH_TAKEN))
    # One by one, because `jax.vmap` would compile a program.
    systems = stacked([replace_parameter(one, parameter, value) for value in values])
    return record(
        Branch,
        parameter=parameter,
        values=values,
        orbits=_orbit(data, systems),
        points=_points(data, one, parameter),
        sequences=tuple(map(_sequence, data.array("sequence").tolist())),
        ended=(str(told["ended_before"]), str(told["ended_after"])),
        periods=int(told["periods"]),
        result=outcomes_from(data, "branch_outcome"),
    )


def _points(data: NamedArrays, one: System, parameter: str) -> list[SpecialPoint]:
    """The special points of a branch, in order."""
    if "special_kind" not in data:
        return []
    found = []
    for i in range(len(data.array("special_kind"))):
        row = _row(data, "special_", i)
        value = float(row.array("value"))
        found.append(
            SpecialPoint(
                kind=str(row.array("kind")),
                value=value,
                orbit=_orbit(row, replace_parameter(one, parameter, value)),
                index=int(row.array("index")),
                before=_sequence(str(row.array("before"))),
                after=_sequence(str(row.array("after"))),
                direction=row.array("direction"),
            )
        )
    return found


def _row(data: NamedArrays, prefix: str, i: int) -> NamedArrays:
    """Row i of the arrays with a prefix, without the prefix."""
    rows: dict[str, Variable] = {
        name.removeprefix(prefix): (dims[1:], np.asarray(array[i]))
        for name, (dims, array, *_) in data.variables.items()
        if name.startswith(prefix)
    }
    return NamedArrays(rows, {}, data.attributes)


def _orbit(data: NamedArrays, system: System) -> Orbit:
    """An orbit, or a batch of orbits, of a given system."""
    steps, arcs, max_events, compact = (int(data.attributes[name]) for name in OPTIONS)
    options = record(
        ShootingOptions,
        t0=exact_array(data.array("t0")),
        steps=steps,
        arcs=arcs,
        stepper=stepper_from(data),
        max_events=max_events,
        compact=bool(compact),
    )
    return record(
        Orbit,
        **fields_from(data, ORBIT),
        events=events_from(data),
        result=outcomes_from(data),
        system=system,
        options=options,
    )


def _sequence(text: str) -> tuple:
    """The contacts of an orbit, each with its surfaces and the modes after it."""
    return tuple((tuple(met), tuple(after)) for met, after in json.loads(text))
