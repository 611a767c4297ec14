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
from jaxfil.integrate.loop.iterate import advance, problem_of_step
from jaxfil.integrate.surfaces import filippov
from jaxfil.integrate.surfaces.normals import project
from jaxfil.integrate.system.components import Components, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select, select_all


class Variation(eqx.Module):
    """A lane with n tangent vectors."""

    state: LoopState
    frame: Frame
    """The tangent vectors."""
    delay: Components
    """dt* of each vector while a switch is pending."""
    left: Array
    """Number of steps to the next regular orthonormalisation."""
    free: Array
    """Whether a step away from contacts and slides has been taken since the last
    orthonormalisation."""
    projected: Array
    """The same of a step along surfaces that the motion slides or rests on."""
    growth: Components
    """Σ log R_ii of each vector."""


def vary(system: ComponentSystem, state: LoopState, every: Array) -> Variation:
    """A lane with a generic frame, to be orthonormalised every `every` steps."""
    zero, no = zeros(system), jnp.zeros((), bool)
    return Variation(state, generic_frame(system), zero, every, no, no, zero)


def propagate(problem: Problem, every: Array, variation: Variation, stop: Array) -> Variation:
    """Propagate an orbit and its frame to step number `stop`; `growth` starts at zero."""
    still = zeros(problem.system)

    def step(before: Variation) -> Variation:
        after, repeats = _from_orthonormal(problem.system, before, _push(problem, before))
        return _orthonormalised(problem.system, every, before.state, after, repeats)

    return jax.lax.while_loop(
        lambda v: is_running(problem.grid, v.state, stop),
        step,
        dataclasses.replace(variation, growth=still),
    )


def _push(problem: Problem, variation: Variation) -> Variation:
    """One iteration of the loop."""
    system, state = problem.system, variation.state
    between = problem_of_step(problem, state).system

    def through(x: Components, tau: Array = state.motion.tau) -> tuple:
        f = filippov.field(between, problem.grid.t0 + tau, x, state.motion.mode)
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
    left = variation.left - (after.counts.index - state.counts.index)
    free = variation.free | ~(_in_contact(state) | after.pending.waits)
    projected = variation.projected | (state.held & ~state.pending.waits)
    return Variation(after, frame, delay, left, free, projected, variation.growth)


def _in_contact(state: LoopState) -> Array:
    """Whether the next iteration may remove directions exactly, at a switch or along a surface."""
    return state.held | state.pending.waits


def _from_orthonormal(
    system: ComponentSystem, before: Variation, after: Variation
) -> tuple[Variation, Array]:
    """The variation after an iteration, and whether the iteration has to be repeated because it has
    reached a contact from a frame that was not orthonormal."""
    # Contacts and slides alone remove directions exactly, to a length of rounding. A direction that
    # has contracted on the way has that length too, so each contact starts from a new frame.
    if not _removes_directions(system):
        return after, jnp.zeros((), bool)
    repeats = after.state.pending.waits & ~before.state.pending.waits & before.free
    return select_all(repeats, before, after), repeats


def _removes_directions(system: ComponentSystem) -> bool:
    return bool(system.slides or system.resets or system.ticks)


def _apply_saltation(problem: Problem, after: LoopState, v: Components, dt: Array) -> Components:
    """A tangent after a switch. It was propagated to the contact itself, whose time moves by dt,
    and through its resets, so that it is R_x (v + f⁻ dt) + R_t dt with the tangent v before it.
    f⁺ dt is subtracted to return to a fixed time."""
    system = problem_of_step(problem, after).system
    t = problem.grid.t0 + after.motion.tau
    v = v + -dt * after.motion.f
    if system.slides or system.resets:
        _, _, normals = system.gradients(t, after.motion.x)
        # On a surface a tangent has no component across it, because two motions that slide there
        # differ along it alone. Sticking removes this component.
        on = stays_on(system, after.motion.mode)
        v = project(system, v, normals @ v, normals, on)
    return v


def _orthonormalised(
    system: ComponentSystem,
    every: Array,
    before: LoopState,
    variation: Variation,
    repeats: Array,
) -> Variation:
    """The same, with its frame orthonormalised where that is due."""
    state = variation.state
    regular = (variation.left <= 0) & (state.counts.index > before.counts.index)
    due = regular | repeats
    if _removes_directions(system):
        due = due | (_in_contact(before) & ~state.pending.waits)

    def as_it_is(frame: Frame, *_: Array) -> tuple[Frame, Components]:
        return frame, zeros(system)

    orthonormal = ft.partial(gram_schmidt, system)
    removed = ~variation.free, variation.projected
    frame, lengths = system.where_any(due, orthonormal, as_it_is, variation.frame, *removed)
    lengths = where(due, lengths, 0.0)
    growth = variation.growth + lengths
    # A direction that is lost once has lost all, also if it is not resolved at other times.
    lost = (variation.growth == -jnp.inf) | (lengths == -jnp.inf)
    return dataclasses.replace(
        variation,
        frame=jax.tree.map(lambda q, v: select(due, q, v), frame, variation.frame),
        left=select(regular, every, variation.left),
        free=variation.free & ~due,
        projected=variation.projected & ~due,
        growth=where(lost, -jnp.inf, growth),
    )
