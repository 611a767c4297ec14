"""The variational equation: an orbit and a frame of tangent vectors through the loop.

A lane and n vectors enter; the lane at a later grid point and the orthonormalised frame leave, with
the logarithms of how much each direction has grown. Lanes of a batch wait for nobody on the way.

Between contacts a tangent is carried by the derivative of the iteration with respect to the state
at fixed time. At a contact whose time moves by dt* with the initial state it jumps by the saltation
matrix: v⁺ = R_x v + (R_x f⁻ + R_t − f⁺) dt*, dt* = −(∇g·v)/ġ, with R the reset (the identity where
there is none) and f∓ the fields before and after. Leine and Nijmeijer, Dynamics and Bifurcations of
Non-Smooth Mechanical Systems (2004).
"""

import dataclasses
import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate import filippov
from jaxfil.integrate.components import (
    Components,
    ComponentSystem,
    axpy,
    constant,
    dot,
    number,
    where,
)
from jaxfil.integrate.guards import stays_on
from jaxfil.integrate.loop import advance
from jaxfil.integrate.normals import products, project
from jaxfil.integrate.problem import Problem
from jaxfil.integrate.state import LoopState, is_running

# A direction to which those before it leave less than this many eps of its length is lost.
_LOST = 1e4


class Variation(eqx.Module):
    """A lane with n tangent vectors."""

    state: LoopState
    frame: tuple[Components, ...]
    """The tangent vectors."""
    delay: Components
    """dt* of each while a switch is pending."""
    left: Array
    """Steps to the next orthonormalisation."""
    dropped: Array
    """Whether a slide or a reset may have taken a direction away since the last one."""
    growth: Components
    """Σ log R_ii."""


def generic_frame(system: ComponentSystem) -> tuple[Components, ...]:
    """n orthonormal vectors, none of which is likely to be special to the system."""
    # The axes would be special: where a slide loses x', the axis of x' is lost at once.
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(system.n, system.n)))
    return tuple(constant(column, system.dtype) for column in q.T)


def vary(system: ComponentSystem, state: LoopState, every: Array) -> Variation:
    """A lane with a generic frame, to be orthonormalised every `every` steps."""
    dropped = jnp.zeros((), bool)
    zeros = (jnp.zeros((), system.dtype),) * system.n
    return Variation(state, generic_frame(system), zeros, every, dropped, zeros)


def propagate(problem: Problem, every: Array, variation: Variation, stop: Array) -> Variation:
    """Carry an orbit and its frame to step number `stop`; `growth` starts at zero."""
    still = tuple(jnp.zeros_like(g) for g in variation.growth)

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

    def through(x: Components, tau: Array = state.tau) -> tuple:
        f = filippov.field(system, problem.grid.t0 + tau, x, state.mode)
        after = advance(problem, dataclasses.replace(state, x=x, f=f, tau=tau))
        return (after.x, after.tau), after

    # A reset may take place at a time that differs; without one a switch leaves the state alone.
    given = (state.x, state.tau) if system.resets else (state.x,)
    _, derivative, after = jax.linearize(through, *given, has_aux=True)
    frame, delay = [], []
    for v, dt in zip(variation.frame, variation.delay, strict=True):
        pushed, late = derivative(*(v, dt)[: len(given)])
        if system.m > 0:
            switched = state.pending & ~after.pending
            met, moment = (pushed, late) if system.resets else (v, dt)
            pushed = where(switched, _apply_saltation(problem, after, met, moment), pushed)
            late = jnp.where(after.pending, late, 0.0)
        frame.append(pushed)
        delay.append(late)
    # A slide takes directions away, and so may a reset: only then is a lost one of length zero.
    moved = after.held
    if system.resets:
        moved = moved | after.pending
    return Variation(
        after,
        tuple(frame),
        tuple(delay),
        variation.left - (after.index - state.index),
        variation.dropped | moved,
        variation.growth,
    )


def _apply_saltation(problem: Problem, after: LoopState, v: Components, dt: Array) -> Components:
    """A tangent after a switch. It was carried to the contact itself, whose time moves by dt, and
    through its resets: it holds f⁻ dt already, and gives up f⁺ dt to be at a fixed time again."""
    system, t = problem.system, problem.grid.t0 + after.tau
    v = axpy(v, -dt, after.f)
    if system.slides or system.resets:
        _, _, normals = system.gradients(t, after.x)
        # On a surface a tangent has no component across it: two motions that slide there differ
        # along it alone. What is removed is the direction that sticking takes away.
        on = stays_on(system, after.mode)
        v = project(system, v, products(system, normals, v), normals, on)
    return v


def _orthonormalised(
    system: ComponentSystem, every: Array, before: LoopState, variation: Variation
) -> Variation:
    """The same, with its frame orthonormalised where that is due."""
    due = (variation.left <= 0) & (variation.state.index > before.index)
    # `once`: without it the first vector would be computed again for every number after it.
    orthonormal = ft.partial(gram_schmidt, system)
    frame, lengths = system.once(orthonormal, variation.frame, variation.dropped)
    growth = tuple(
        g + jnp.where(due, log, 0.0) for g, log in zip(variation.growth, lengths, strict=True)
    )
    return dataclasses.replace(
        variation,
        frame=tuple(where(due, q, v) for q, v in zip(frame, variation.frame, strict=True)),
        left=jnp.where(due, every, variation.left),
        dropped=variation.dropped & ~due,
        growth=growth,
    )


def gram_schmidt(
    system: ComponentSystem, frame: tuple[Components, ...], dropped: Array
) -> tuple[tuple[Components, ...], Components]:
    """An orthonormal frame, and log R_ii of each vector.

    A vector of which the ones before it leave nothing but rounding is replaced by one that is
    orthogonal to them. Its logarithm is −inf where a slide or a reset may have `dropped` it, which
    has then no length at all, and NaN elsewhere: it is too small to be told.
    """
    # Modified Gram–Schmidt, every vector a tuple of scalars: a QR factorisation of LAPACK would end
    # the kernel, and n is small.
    done: list[Components] = []
    logs = []
    for v in frame:
        size = _norm(v)
        rest = v
        for _ in range(2):  # the second time removes what rounding left
            for q in done:
                rest = axpy(rest, -dot(q, rest), q)
        length = _norm(rest)
        lost = length <= _LOST * system.eps * size
        length = jnp.where(lost, 1.0, length)
        unit = tuple(a / length for a in rest)
        done.append(where(lost, _complement(system, done), unit))
        nothing = jnp.where(dropped, -jnp.inf, jnp.nan)
        logs.append(jnp.where(lost, nothing, jnp.log(length)))
    return tuple(done), tuple(logs)


def _norm(v: Components) -> Array:
    square = jnp.asarray(dot(v, v))
    zero = square == 0  # the square root has no derivative there
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))


def _complement(system: ComponentSystem, done: list[Components]) -> Components:
    """A unit vector orthogonal to orthonormal ones: what they leave of the axis they leave most."""
    eye = np.eye(system.n)
    best, most = constant(0 * eye[0], system.dtype), jnp.zeros((), system.dtype)
    for j in range(system.n):
        axis = constant(eye[j], system.dtype)
        for q in done:
            axis = axpy(axis, -number(q, j), q)
        square = number(axis, j)  # a projection's diagonal is the square of its column
        best, most = where(square > most, axis, best), jnp.maximum(most, square)
    return tuple(v / jnp.sqrt(most) for v in best)
