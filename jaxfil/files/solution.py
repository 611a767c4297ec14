"""A solution from its data set."""

import functools as ft
import re

import diffrax
import numpy as np

from jaxfil.integrate.run.dataset import CROSSINGS, DENSE, EVENTS, SOLUTION, STATS, TAKEN
from jaxfil.integrate.run.solution import Crossings, Dense, Events, Solution
from jaxfil.integrate.steppers.adaptive import Adaptive
from jaxfil.integrate.steppers.explicit import (
    OWN_METHODS,
    Stepper,
    checked_stepper,
    controlled,
)
from jaxfil.integrate.steppers.taylor import Taylor
from jaxfil.model.dataset import (
    exact_array,
    fields_from,
    labels_from,
    outcomes_from,
    record,
    system_from,
)
from jaxfil.model.dataset_io import NamedArrays
from jaxfil.model.system import System


def solution_from(data: NamedArrays, system: System | None) -> Solution:
    """The solution."""
    compact = bool(data.attributes["compact"])
    return record(
        Solution,
        **fields_from(data, SOLUTION),
        events=events_from(data),
        result=outcomes_from(data),
        stats={name: exact_array(data.array(name)) for name in STATS},
        crossings=record(Crossings, **fields_from(data, CROSSINGS))
        if "crossing_t" in data
        else None,
        observed=exact_array(data.array("observed")) if "observed" in data else None,
        _dense=_dense(data, system, compact) if "step_t" in data else None,
        labels=labels_from(data),
        compact=compact,
    )


def events_from(data: NamedArrays) -> Events | None:
    """The contacts, if a table was saved."""
    return record(Events, **fields_from(data, EVENTS)) if "event_t" in data else None


def stepper_from(data: NamedArrays) -> Stepper:
    """The stepper with the name in the data set."""
    name = str(data.attributes["stepper"])
    method, _, tolerance = name.partition(", ")
    order = re.fullmatch(r"Taylor\((\d+)\)", method)
    own = ft.partial(Taylor, int(order[1])) if order else OWN_METHODS.get(method)
    cls = own or getattr(diffrax, method, None)
    if cls is None:
        raise ValueError(
            "`path` must be of a run by a stepper of jaxfil or diffrax, since others are not known "
            f"by name, got {name!r}."
        )
    if not tolerance:
        return checked_stepper(cls())
    numbers = dict(re.findall(r"(\w+)=([^,)]+)", tolerance))
    return controlled(Adaptive(**{key: float(v) for key, v in numbers.items()}), cls())


def _dense(data: NamedArrays, system: System | None, compact: bool) -> Dense:
    dtype: np.dtype = data.array("step_x").dtype
    return record(
        Dense,
        system=system_from(data, system, dtype, TAKEN),
        **fields_from(data, DENSE),
        stepper=stepper_from(data),
        compact=compact,
    )
