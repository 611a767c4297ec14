"""Named arrays of a branch in a data set, with orbits along one dimension and special points along
another."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxfil.model.dataset import (
    axis_of,
    component_coordinates,
    header,
    key_of,
    outcome_variables,
    system_entries,
)
from jaxfil.model.dataset_io import NamedArrays, Variable
from jaxfil.model.labels import labels_of
from jaxfil.orbits.orbit_arrays import TAKEN as ORBIT_TAKEN, option_attributes, orbit_variables
from jaxfil.xla.known import part_of, stacked

_ALONG, _SPECIAL, _UNKNOWN = "orbit", "special", "unknown"
_POINT = ("kind", "value", "index", "before", "after")
# Names of its data set that are not parameters.
TAKEN = {*ORBIT_TAKEN, "sequence", "branch_outcome", "branch_outcome_code", "ended_before"}
TAKEN |= {"ended_after", "periods", "swept", _ALONG, _SPECIAL, _UNKNOWN}
TAKEN |= {f"special_{name}" for name in {*_POINT, "direction", *ORBIT_TAKEN}}


def branch_arrays(branch: Any) -> NamedArrays:
    """The named arrays of a `Branch`."""
    orbits, parameter = branch.orbits, branch.parameter
    system = part_of(orbits.system, 0)
    n = orbits.x0.shape[-1]
    labels = labels_of(system, n)
    arrays, told = system_entries(system, TAKEN, skip=parameter)
    variables: dict[str, Variable] = {
        **orbit_variables(orbits, (_ALONG,)),
        "sequence": (_ALONG, np.array([json.dumps(s) for s in branch.sequences])),
        **_prefixed("branch_", outcome_variables(branch.result, ())),
        **_points(branch.points),
        **arrays,
    }
    key = key_of(parameter, TAKEN)
    coordinates = component_coordinates(labels, n)
    coordinates[key] = axis_of(labels, parameter, _ALONG, np.asarray(branch.values))
    attributes = header("Branch") | told | option_attributes(orbits)
    attributes |= {"swept": parameter, "periods": branch.periods}
    attributes |= {"ended_before": branch.ended[0], "ended_after": branch.ended[1]}
    return NamedArrays(variables, coordinates, attributes)


def _points(points: list[Any]) -> dict[str, Variable]:
    """The special points of a branch."""
    if not points:
        return {}  # netCDF has no dimension of length zero
    orbits = stacked([point.orbit for point in points])
    named: dict[str, Variable] = {
        name: (_SPECIAL, np.array([_plain(getattr(point, name)) for point in points]))
        for name in _POINT
    }
    named["direction"] = ((_SPECIAL, _UNKNOWN), np.array([point.direction for point in points]))
    return _prefixed("special_", orbit_variables(orbits, (_SPECIAL,)) | named)


def _plain(value: Any) -> Any:
    """Contacts as text; numbers and strings unchanged."""
    return json.dumps(value) if isinstance(value, tuple) else value


def _prefixed(prefix: str, variables: Mapping[str, Variable]) -> dict[str, Variable]:
    return {prefix + name: variable for name, variable in variables.items()}
