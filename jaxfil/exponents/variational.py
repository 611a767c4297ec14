"""The variational equation: an orbit and a frame of tangent vectors through the loop.

The result is the lane at a later grid point, with the orthonormalised frame and the logarithms of
the growth of each direction. Lanes of a batch do not wait for each other.

Between contacts the derivative of the iteration with respect to the state at fixed time propagates
a tangent. At a contact whose time moves by dt* with the initial state it jumps by the saltation
matrix: v⁺ = R_x v + (R_x f⁻ + R_t − f⁺) dt*, dt* = −(∇g·v)/ġ, with R the reset (the identity
without one) and f∓ the fields before and after. Leine and Nijmeijer, Dynamics and Bifurcations of
Non-Smooth Mechanical Systems (2004).
"""

import dataclasses
import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.exponents.frame import Frame, for_each, generic_frame, gram_schmidt, zeros
from jaxfil.integrate.contacts.guards import stays_on
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, is_running
from jaxfil.integrate.loop.iterate import advance
from jaxfil.integrate.surfaces import filippov
from jaxfil.integrate.surfaces.normals import project
from jaxfil.integrate.system.components import Components, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select


class Variation(eqx.Module):
    """A lane with n tangent vectors."""

    state: LoopState
    frame: Frame
    """The tangent vectors."""
    delay: Components
    """dt* of each vector while a switch is pending."""
    left: Array
    """Number of steps to the next orthonormalisation."""
    dropped: Array
    """Whether a slide or a reset may have removed a direction since the last orthonormalisation."""
    growth: Components
    """Σ log R_ii of each vector."""


def vary(system: ComponentSystem, state: LoopState, every: Array) -> Variation:
    """A lane with a generic frame, to be orthonormalised every `every` steps."""
    dropped = jnp.zeros((), bool)
    zero = zeros(system)
    return Variation(state, generic_frame(system), zero, every, dropped, zero)


def propagate(problem: Problem, every: Array, variation: Variation, stop: Array) -> Variation:
    """Propagate an orbit and its frame to step number `stop`; `growth` starts at zero."""
    still = zeros(problem.system)

    def step(v: Variation) -> Variation:
        return _orthonormalised(problem.system, every, v.state, _push(problem, v))

    return jax.lax.while_loop(
        lambda v: is_running(problem.grid, v.state, stop),
        step,
        dataclasses.replace(variation, growth=still),
    )


def _push(problem: Problem, variation: Variation) -> Variation:
    """One iteration of the loop."""
    system, state = problem.system, variation.state

    def through(x: Components, tau: Array = state.motion.tau) -> tuple:
        f = filippov.field(system, problem.grid.t0 + tau, x, state.motion.mode)
        motion = dataclasses.replace(state.motion, x=x, f=f, tau=tau)
        after = advance(problem, dataclasses.replace(state, motion=motion))
        return (after.motion.x, after.motion.tau), after

    # A map may act at a time that differs, as may the second of several contacts; without
    # these a switch does not change the state.
    moves = system.resets or system.ticks or system.m > 1
    # Where it does not, the derivative by the time is not computed, and the tangent after a switch
    # is the one before it.
    given = (state.motion.x, state.motion.tau) if moves else (state.motion.x,)
    _, derivative, after = jax.linearize(through, *given, has_aux=True)

    def push(v: Components, dt: Array) -> tuple[Components, Array]:
        pushed, late = derivative(*(v, dt)[: len(given)])
        if system.m > 0:
            switched = state.pending.waits & ~after.pending.waits
            met, moment = (pushed, late) if moves else (v, dt)
            pushed = where(switched, _apply_saltation(problem, after, met, moment), pushed)
            late = select(after.pending.waits, late, 0.0)
        return pushed, late

    frame, delay = for_each(push, variation.frame, variation.delay)
    # Only a slide or a reset removes directions exactly; a lost one then has the length zero.
    moved = after.held
    if system.resets or system.ticks:
        moved = moved | after.pending.waits
    return Variation(
        after,
        frame,
        delay,
        variation.left - (after.counts.index - state.counts.index),
        variation.dropped | moved,
        variation.growth,
    )


def _apply_saltation(problem: Problem, after: LoopState, v: Components, dt: Array) -> Components:
    """A tangent after a switch. It was propagated to the contact itself, whose time moves by dt,
    and through its resets, so that it is R_x (v + f⁻ dt) + R_t dt with the tangent v before it.
    f⁺ dt is subtracted to return to a fixed time."""
    system, t = problem.system, problem.grid.t0 + after.motion.tau
    v = v + -dt * after.motion.f
    if system.slides or system.resets:
        _, _, normals = system.gradients(t, after.motion.x)
        # On a surface a tangent has no component across it, because two motions that slide there
        # differ along it alone. Sticking removes this component.
        on = stays_on(system, after.motion.mode)
        v = project(system, v, normals @ v, normals, on)
    return v


def _orthonormalised(
    system: ComponentSystem, every: Array, before: LoopState, variation: Variation
) -> Variation:
    """The same, with its frame orthonormalised where that is due."""
    due = (variation.left <= 0) & (variation.state.counts.index > before.counts.index)

    def as_it_is(frame: Frame, _: Array) -> tuple[Frame, Components]:
        return frame, zeros(system)

    orthonormal = ft.partial(gram_schmidt, system)
    frame, lengths = system.where_any(
        due, orthonormal, as_it_is, variation.frame, variation.dropped
    )
    growth = variation.growth + where(due, lengths, 0.0)
    return dataclasses.replace(
        variation,
        frame=jax.tree.map(lambda q, v: select(due, q, v), frame, variation.frame),
        left=select(due, every, variation.left),
        dropped=variation.dropped & ~due,
        growth=growth,
    )
