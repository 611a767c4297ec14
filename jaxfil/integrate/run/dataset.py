"""Solutions and events by name: the arrays of a solution, of one lane or a batch, in a data set."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.model.dataset import (
    OTHERS,
    Fields,
    component_coordinates,
    header,
    label_attributes,
    outcome_variables,
    system_entries,
    variables_of,
)
from jaxfil.model.dataset_io import NamedArrays, Variable
from jaxfil.model.labels import Labels
from jaxfil.model.outcomes import EventKind

SOLUTION: Fields = {
    "t": ("ts", "time"),
    "x": ("xs", "time component"),
    "mode": ("modes", "time surface"),
    "num_events": ("num_events", ""),
    "t_final": ("t_final", ""),
    "x_final": ("x_final", "component"),
    "mode_final": ("mode_final", "surface"),
    "error": ("errors", "time component"),
    "num_crossings": ("num_crossings", ""),
}
EVENTS: Fields = {
    "event_t": ("ts", "event"),
    "event_x": ("xs", "event component"),
    "event_surface": ("surfaces", "event"),
    "event_member": ("members", "event surface"),
    "event_kind_code": ("kinds", "event"),
    "event_mode": ("modes", "event surface"),
}
CROSSINGS: Fields = {
    "crossing_t": ("ts", "crossing"),
    "crossing_x": ("xs", "crossing component"),
    "crossing_section": ("sections", "crossing"),
}
DENSE: Fields = {
    "step_t": ("ts", "step"),
    "step_x": ("xs", "step component"),
    "step_mode": ("modes", "step surface"),
    "step_begin": ("t0", ""),
    "step_end": ("t1", ""),
}
STATS = ("num_steps", "num_halvings", "num_iterations", "num_saved")
# Names in its data set that parameters must not use.
TAKEN = {*SOLUTION, *EVENTS, *CROSSINGS, *DENSE, *STATS, "event_kind", "outcome", "outcome_code"}
TAKEN |= {
    OTHERS,
    "component",
    "unit",
    "jaxfil_type",
    "jaxfil_version",
    "system",
    "symbols",
    "units",
}
TAKEN |= {"stepper", "compact", "observed", "time", "event", "surface", "crossing", "step", "lane"}
# Variables that become coordinates.
_TIMES = ("t", "event_t", "crossing_t", "step_t")


def batch_dims(shape: Sequence[int]) -> tuple[str, ...]:
    """The names of the dimensions of a batch."""
    return ("lane",) if len(shape) == 1 else tuple(f"lane_{i}" for i in range(len(shape)))


def event_variables(events: Any, batch: Sequence[str]) -> dict[str, Variable]:
    """The variables of an `Events`, with the kinds in words; empty for None."""
    if events is None:
        return {}
    # The kinds are numbered from 0 in their order, so a code is the index of its word.
    words = np.array([kind.name for kind in EventKind])
    kinds = words[np.asarray(events.kinds)]
    return {**variables_of(events, EVENTS, batch), "event_kind": ((*batch, "event"), kinds)}


def solution_arrays(sol: Any) -> NamedArrays:
    """The named arrays of a `Solution`."""
    labels: Labels = sol.labels
    # The final state is never None, so the batch is known from its leading axes.
    *shape, n = np.shape(sol.x_final)
    batch = batch_dims(shape)
    variables = variables_of(sol, SOLUTION, batch)
    variables |= outcome_variables(sol.result, batch)
    variables |= {name: (batch, np.asarray(sol.stats[name])) for name in STATS}
    variables |= event_variables(sol.events, batch)
    if sol.crossings is not None:
        variables |= variables_of(sol.crossings, CROSSINGS, batch)
    if sol.observed is not None:
        # Axes after the batch and the time belong to the observable.
        own_dims = np.ndim(sol.observed) - len(batch) - 1
        own = (f"observed_{i}" for i in range(own_dims))
        variables["observed"] = (*batch, "time", *own), np.asarray(sol.observed)
    attributes = header("Solution") | {"compact": int(sol.compact)} | label_attributes(labels)
    # Only dense output evaluates the system again, so only its file has the parameters.
    if sol._dense is not None:
        variables |= variables_of(sol._dense, DENSE, batch)
        arrays, known = system_entries(sol._dense.system, TAKEN, batch, shape)
        variables |= arrays
        attributes |= known | {"stepper": tableau_of(sol._dense.stepper).name}
    coordinates = component_coordinates(labels, n)
    unit = {"units": labels.unit("t")} if labels.unit("t") else {}
    for name in _TIMES:
        if name in variables:
            dims, values = variables.pop(name)[:2]
            coordinates[name] = dims, values, unit
    return NamedArrays(variables, coordinates, attributes)
