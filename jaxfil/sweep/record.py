"""The record of a sweep, by which a checkpoint or another process identifies the same sweep."""

import hashlib
from collections.abc import Mapping

import jax
import numpy as np

from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.sweep.conditions import conditions_of
from jaxfil.sweep.identity import equations
from jaxfil.sweep.plan import SweepPlan

Record = Mapping[str, str | int | np.ndarray]
"""Every argument of a sweep by name."""


def record_of(plan: SweepPlan) -> Record:
    """All arguments that affect the numbers of a sweep, by their public names."""
    grid, sampling, given = plan.grid, plan.sampling, conditions_of(plan)
    # The coefficients as well as the name, because another version of diffrax may differ in digits.
    coefficients = repr(tableau_of(sampling.stepper)).encode()
    # The values of each parameter: the axes of a grid, or the columns of a list of points.
    columns = grid.values if isinstance(grid.values, tuple) else grid.rows.T
    return {
        "system": type(sampling.system).__name__,
        "equations": equations(sampling.system, np.zeros(given.x0.shape[-1:], given.x0.dtype)),
        **{f"system.{key}": value for key, value in given.parameters.items()},
        "parameter": ", ".join(grid.names),
        "points": str(grid.shape),
        **{f"values of {key}": v for key, v in zip(grid.names, columns, strict=True)},
        "x0": given.x0,
        "transient": given.transient,
        "samples": sampling.samples,
        "steps": given.steps,
        "stepper": given.stepper,
        "coefficients": hashlib.sha256(coefficients).hexdigest()[:16],
        "follow": str(given.follow),
        "compact": str(given.compact),
        "section": f"{given.section}, {given.max_return}",
        "observe": str(given.observe),
        "average": str(given.average),
        "transient_time": str(given.transient_time),
        "jaxfil": given.version,
        # Other versions and other machines give other last bits, and a diagram of two halves that
        # differ in them would be reproducible on neither.
        "jax": jax.__version__,
        "backend": jax.default_backend(),
    }


def digest(record: Record) -> bytes:
    """A hash of all arguments."""
    sha = hashlib.sha256()  # not `hash`, which differs between processes
    for name, value in sorted(record.items()):
        sha.update(f"{name} {shown(value)} ".encode())
        sha.update(value.tobytes() if isinstance(value, np.ndarray) else b"")
    return sha.digest()


def shown(value: str | int | np.ndarray) -> str:
    """A description of an argument; for an array its shape and dtype."""
    if isinstance(value, np.ndarray):
        return f"of shape {value.shape} and dtype {value.dtype}"
    return str(value)
