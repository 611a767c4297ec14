"""Named arrays of an orbit, or of a batch of orbits, in a data set."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxfil.integrate.run.dataset import EVENTS, batch_dims, event_variables
from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.model.dataset import (
    OTHERS,
    Fields,
    component_coordinates,
    header,
    outcome_variables,
    system_entries,
    variables_of,
)
from jaxfil.model.dataset_io import Attribute, NamedArrays, Variable
from jaxfil.model.labels import labels_of

ORBIT: Fields = {
    "x0": ("x0", "component"),
    "period": ("period", ""),
    "monodromy": ("monodromy", "component by_component"),
    "residual": ("residual", ""),
    "num_events": ("num_events", ""),
    "first_mode": ("first_mode", "surface"),
    "start": ("starts", "arc component"),
    "num_steps": ("num_steps", ""),
}
# Static fields of `ShootingOptions` that are numbers.
OPTIONS = ("steps", "arcs", "max_events", "compact")
# Names of its data set that are not parameters.
TAKEN = {*ORBIT, *EVENTS, *OPTIONS, "t0", "stepper", "outcome", "outcome_code", "event_kind"}
TAKEN |= {"multiplier_real", "multiplier_imag", "stable", "component", "unit", "system", "lane"}
TAKEN |= {
    "jaxfil_type",
    "jaxfil_version",
    OTHERS,
    "by_component",
    "surface",
    "arc",
    "event",
    "multiplier",
}


def orbit_variables(orbit: Any, batch: Sequence[str]) -> dict[str, Variable]:
    """The variables of an `Orbit` without its system, with its multipliers and its stability."""
    dims = (*batch, "multiplier")
    return {
        **variables_of(orbit, ORBIT, batch),
        "t0": (batch, np.asarray(orbit.options.t0)),
        **outcome_variables(orbit.result, batch),
        **event_variables(orbit.events, batch),
        "stable": (batch, np.asarray(orbit.stable)),
        # No file format supports complex numbers.
        "multiplier_real": (dims, np.real(orbit.multipliers)),
        "multiplier_imag": (dims, np.imag(orbit.multipliers)),
    }


def option_attributes(orbit: Any) -> dict[str, Attribute]:
    """The options of the integration of an orbit."""
    told = {name: int(getattr(orbit.options, name)) for name in OPTIONS}
    return {**told, "stepper": tableau_of(orbit.options.stepper).name}


def orbit_arrays(orbit: Any) -> NamedArrays:
    """The named arrays of an `Orbit`."""
    *shape, n = np.shape(orbit.x0)
    batch = batch_dims(shape)
    arrays, told = system_entries(orbit.system, TAKEN, batch, shape)
    return NamedArrays(
        orbit_variables(orbit, batch) | arrays,
        component_coordinates(labels_of(orbit.system, n), n),
        header("Orbit") | told | option_attributes(orbit),
    )
