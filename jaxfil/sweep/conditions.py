"""The conditions of a sweep, that is, its arguments other than the swept values.

A data set stores them as attributes, and larger ones as arrays.
"""

from collections.abc import Collection, Sequence
from dataclasses import fields
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.model.dataset import name_of, parameter_entries
from jaxfil.model.dataset_io import Attribute, NamedArrays, Variable
from jaxfil.model.parameter import parameters
from jaxfil.sweep.identity import (
    identity_of_averaging,
    identity_of_observable,
    identity_of_section,
)
from jaxfil.sweep.plan import SweepPlan
from jaxfil.version import __version__


class Conditions(eqx.Module):
    """The conditions of a sweep: its numbers, and the section, the observed function and the
    stepper by name."""

    parameters: dict[str, np.ndarray]
    """The parameters that were not swept, by name."""
    x0: Float[np.ndarray, "*lanes n"]
    """The initial state, shape (n,), or one for each lane."""
    transient: int = eqx.field(static=True)
    """Forcing periods, or crossings of the section, before the first sample."""
    steps: int = eqx.field(static=True)
    """Steps per forcing period; for an autonomous system per unit of time."""
    stepper: str = eqx.field(static=True)
    """The stepper's name."""
    follow: str | None = eqx.field(static=True)
    """"up" or "down" if each value began at the end of the previous one; None if all began at
    `x0`."""
    version: str = eqx.field(static=True)
    """The version of jaxfil that computed it."""
    compact: bool = eqx.field(static=True, default=False)
    """Whether the program was compact (see `solve`)."""
    section: str | None = eqx.field(static=True, default=None)
    """The sampled section; None for once a forcing period."""
    max_return: float | None = eqx.field(static=True, default=None)
    """The bound of the mean time of a return to the section."""
    transient_time: float | None = eqx.field(static=True, default=None)
    """The time before which no crossing counted; None if all did."""
    observe: str | None = eqx.field(static=True, default=None)
    """The function stored at the samples; None for the states themselves."""
    average: str | None = eqx.field(static=True, default=None)
    """The averages, by name; None without averages."""


# Fields that are attributes of the same name, absent for None.
_ATTRIBUTES = [v.name for v in fields(Conditions) if v.name not in ("parameters", "x0", "version")]
# Names of a data set that are not parameters.
CONDITIONS = {"jaxfil_type", "jaxfil_version", "system", "x0", *_ATTRIBUTES}


def conditions_of(plan: SweepPlan) -> Conditions:
    """The conditions in the diagram of a plan."""
    each, state = plan.sampling, np.zeros(plan.x0.shape[-1:], plan.x0.dtype)
    others = {k: np.asarray(v) for k, v in parameters(each.system).items() if k not in each.names}
    section, observable = each.section, each.observable
    longest, before, averaging = each.max_return, each.transient_time, each.averaging
    # Identities are those of a system of the sweep, not of the one with the values before it.
    first, _ = each.at(jnp.asarray(plan.grid.rows[0]))
    return Conditions(
        parameters=others,
        x0=plan.x0,
        transient=int(each.transient),
        steps=int(each.steps),
        stepper=tableau_of(each.stepper).name,
        follow=plan.follow,
        version=__version__,
        compact=each.compact,
        section=None if section is None else identity_of_section(section, first, state),
        max_return=None if longest is None else float(longest),
        transient_time=None if before is None else float(before),
        average=None if averaging is None else identity_of_averaging(averaging, first, state),
        observe=None
        if observable is None
        else identity_of_observable(observable, each.system, state),
    )


def condition_entries(
    given: Conditions, taken: Collection[str], lanes: Sequence[str]
) -> tuple[dict[str, Variable], dict[str, Attribute]]:
    """The entries of a data set whose lanes have these dimensions."""
    variables, attributes = parameter_entries(given.parameters, taken)
    if given.x0.ndim > 1:
        last = "component" if given.observe is None else "x0_component"
        variables["x0"] = (*lanes, last), given.x0
    else:
        attributes["x0"] = given.x0
    told = {name: getattr(given, name) for name in _ATTRIBUTES}
    attributes |= {name: value for name, value in told.items() if value is not None}
    attributes |= {"compact": int(given.compact), "jaxfil_version": given.version}
    return variables, attributes


def conditions_from(data: NamedArrays, dtype: np.dtype, taken: Collection[str]) -> Conditions:
    """The conditions stored by `condition_entries`."""
    told = data.attributes
    # An attribute of one number is read as a number, and one of float32 as float64.
    x0 = data.array("x0") if "x0" in data else np.reshape(told["x0"], (-1,)).astype(dtype)
    # `item`, since these fields are static and must be numbers and strings of Python.
    known: dict[str, Any] = {"follow": None, "compact": False}
    known |= {name: np.asarray(told[name]).item() for name in _ATTRIBUTES if name in told}
    known["compact"] = bool(known["compact"])
    version = str(told["jaxfil_version"])
    return Conditions(_parameters(data, dtype, taken), x0, version=version, **known)


def _parameters(
    data: NamedArrays, dtype: np.dtype, taken: Collection[str]
) -> dict[str, np.ndarray]:
    """The parameters that were not swept, by name."""
    scalars = {key: np.asarray(v, dtype) for key, v in data.attributes.items() if key not in taken}
    arrays = {key: v[1] for key, v in data.variables.items() if key not in taken}
    return {name_of(key, taken): value for key, value in sorted((scalars | arrays).items())}
