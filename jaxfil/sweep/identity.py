"""Identities of functions: hashes of equations, sections and observed functions.

A hash of the computation is the same in other processes and on other days.
"""

import hashlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.run.averaging import Averaging
from jaxfil.integrate.run.observed import Observable
from jaxfil.model import check
from jaxfil.model.observe import asked_of
from jaxfil.model.parameter import is_parameter
from jaxfil.model.quantity import KINDS, EventSum
from jaxfil.model.section import Section
from jaxfil.model.system import System, field_of


def equations(system: System, x: np.ndarray) -> str:
    """A hash of the computation of a system from its parameters, a time and a state.

    It hashes the program lowered for XLA, which includes all operations and constants of the
    functions of the system, and is the same in every process.
    """
    # Parameters are arguments of the program instead of constants; a record has their values.
    leaves, static = eqx.partition(system, is_parameter)
    state = jnp.asarray(x)
    h = check.shapes(system, state)

    def everything(leaves: System, t: Array, x: Array) -> tuple[Any, ...]:
        s = eqx.combine(leaves, static)
        field = field_of(s, t, x, jnp.ones(h, x.dtype))
        after = s.reset(t, x, jnp.zeros((), jnp.int32)) if s.resets else None
        ticked = s.tick(t, x, jnp.zeros((), jnp.int32)) if s.ticks else None
        return field, s.switching(t, x), after, ticked, s.period, s.clocks

    text = jax.jit(everything).lower(leaves, jnp.zeros((), state.dtype), state).as_text()
    return hashlib.sha256(f"{text} {system.slides}".encode()).hexdigest()[:16]


def identity_of_section(section: Section, system: System, x: np.ndarray) -> str:
    """A section in words, and a hash of its function and of that function's numbers."""
    sha = _of_motion(section.function, system, jnp.asarray(x))
    rate = ", of its rate" if section.of_rate else ""
    return f"function {sha}{rate}, direction {section.direction}"


def identity_of_observable(observable: Observable, system: System, x: np.ndarray) -> str:
    """The name of the observed function, and its identity."""
    sha = _of_motion(observable.function, system, jnp.asarray(x))
    return f"{observable.name}, function {sha}"


def _of_motion(function: Any, system: System, x: Array) -> str:
    """`_fingerprint` of a function of the motion, with what it asks for besides sides: numbers of
    one shape, which no program tells apart."""
    side, asked = jnp.ones(check.shapes(system, x), x.dtype), asked_of(function)
    sha = _fingerprint(function, jnp.zeros((), x.dtype), x, *(side for _ in asked))
    return f"{sha} of {', '.join(asked)}" if set(asked) - {"side"} else sha


def identity_of_averaging(averaging: Averaging, system: System, x: np.ndarray) -> str:
    """The names and kinds of averaged quantities, and the identities of their functions."""
    state, told = jnp.asarray(x), []
    for one in averaging.each:
        name, quantity, function = one.name, one.quantity, one.function(system)
        if isinstance(quantity, EventSum):
            side = jnp.ones(averaging.h_shape, x.dtype)
            sha = _fingerprint(function, jnp.zeros((), x.dtype), state, state, side)
        else:
            sha = _of_motion(function, system, state)
        kind = type(quantity).__name__ if isinstance(quantity, KINDS) else "mean"
        told.append(f"{name}: {kind}, function {sha}")
    return "; ".join(told)


def _fingerprint(function: Any, *example: Array) -> str:
    """A hash of a function of arrays like these, and of its numbers."""
    leaves, static = eqx.partition(function, is_parameter)

    def call(leaves: Any, *args: Array) -> Any:
        return eqx.combine(leaves, static)(*args)

    text = jax.jit(call).lower(leaves, *example).as_text()
    numbers = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(leaves)]
    return hashlib.sha256(f"{text} {numbers}".encode()).hexdigest()[:16]
