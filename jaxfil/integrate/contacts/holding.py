"""The rounding of H by forces that hold the state on surfaces.

A force that holds has the rounding of the terms that cancel in it, eps F, however small the state.
In a step of length h it moves a velocity by h eps F and a position by h² eps F, and so on; a guard
within the sum is not known to be away from its surface.
"""

import dataclasses
import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.guards import NOISE, Surfaces, stays_on
from jaxfil.integrate.contacts.resets import Impact
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.lane.step_length import Length, typical_step
from jaxfil.integrate.steppers.error_estimate import terms_in_step
from jaxfil.integrate.surfaces import unilateral
from jaxfil.integrate.surfaces.corners import Corners, are_coupled
from jaxfil.integrate.system.components import Components, any_of, maximum, pack, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select


def with_rounding_of_forces(
    problem: Problem,
    state: LoopState,
    length: Length,
    at: Surfaces,
    fields: Corners,
    x: Components,
    led: Impact | None,
) -> Surfaces:
    """The surfaces with the rounding of forces that hold the state on one, or have just held it,
    however small the state. One that it cannot leave, because others hold it, causes no contact."""
    system, t = problem.system, problem.grid.t0 + length.end
    left = select(any_of(~state.armed), abs(stop_gradient(length.h)), 0.0)
    # While a state is held, rounding accumulates over many steps.
    since, size = select(state.held, typical_step(problem, state), left), fields.sizes()
    if not are_coupled(system):
        size = stop_gradient(since * size)
    else:
        size = stop_gradient(where(_held_numbers(system, state, led), since, left) * size)
        # The rounding of a force moves the position too, whose rate is zero but for this.
        given = stop_gradient((t, x, since, size, unilateral.sides_of(state.motion.mode)))
        size = system.where_any(since > 0, ft.partial(_passed_on, system), _as_it_is, *given)
    more = NOISE * problem.system.eps * (abs(stop_gradient(at.normals)) @ size)
    return dataclasses.replace(at, noise=at.noise + more)


def _held_numbers(system: ComponentSystem, state: LoopState, led: Impact | None) -> Components:
    """The numbers of the field in which the forces that hold the state are, n flags."""
    held = where(stays_on(system, state.motion.mode), 1.0, 0.0)
    switched = system.structure.switched
    if state.motion.x.is_array:
        table = np.zeros((system.n, system.m), system.dtype)
        for i, sides in enumerate(switched):
            table[i, list(sides)] = 1
        acts = Components([table @ pack(held, system.dtype)])
    else:
        zero = jnp.zeros((), system.dtype)
        acts = Components(sum((held.number(j) for j in sides), zero) for sides in switched)
    if led is not None and led.constraints is not None:
        acts = abs(led.constraints.reaction.directions).added(acts, held)
    return stop_gradient(acts) > 0


def _passed_on(
    system: ComponentSystem, t: Array, x: Components, h: Array, size: Components, sides: Components
) -> Components:
    """Changes of the state in a step of length h, of these sizes, with what they change in turn."""
    _, push = jax.linearize(lambda t, x: system.field(t, x, sides), t, x)
    at = 0 * t, 0 * x, size / select(h > 0, h, 1)
    return maximum(size, terms_in_step(system.n, h, at, push))


def _as_it_is(t: Array, x: Components, h: Array, size: Components, sides: Components) -> Components:
    return size
