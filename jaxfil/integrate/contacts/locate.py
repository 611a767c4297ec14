"""Event location: the first contact inside a step.

From the guards' values and rates at both ends of a trial step follows the fraction θ of the step at
which one of them first becomes negative, and, when a step has ended on a contact, the remaining
time δ to it.

A guard is positive in the current mode. Within a step it is interpolated by the cubic through its
values and rates at the ends (Hermite's). The values are available from the trial itself, so that no
dense output of the stepper is needed. A step that is cut at a root of the cubic is repeated, so
that the cubic's error of order four costs iterations, not accuracy:

    g0 ╲                                 the trial step, H at both ends: g < 0 at its end
        ╲___     θ h          h          1. reject, cut at the cubic's first root θ
    ────────╲────┼────────────┼─── 0     2. step again to θ h: close enough for Newton
             ╲___╱ dip         ╲         3. land: t += δ, x += δ f, δ = −g/ġ

The cubic's minimum is examined too, so that a dip below zero and back inside one step is detected.
A surface that the lane has just left starts at exactly zero with a rate that is zero or positive;
its contact is a root after the cubic's maximum, never the one at the start.

Three tolerances separate a contact from rounding, each with a scale: the noise of a guard, a
multiple of eps and of the size of its terms (`guards.surface_noise`); the rounding of times
(`Problem.same_time`); and eps^(2/3), up to which one Newton correction in time is exact to
rounding in the state and in its derivative.
"""

import functools as ft

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import NEVER, first_contact, quotient, stays_off
from jaxfil.integrate.lane.problem import Problem, TimeGrid
from jaxfil.integrate.lane.state import LoopState, StepEnd
from jaxfil.integrate.lane.step_length import Length, typical_step
from jaxfil.integrate.surfaces.second_order import beyond_newton
from jaxfil.integrate.system.components import (
    Components,
    any_of,
    first_set,
    least,
    maximum,
    minimum,
    on_each,
    total,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.second_derivative import add_second_derivative
from jaxfil.xla.select import select

# Offset that encodes "minimum to examine" in the same number as a contact, so that the search of a
# surface has one result, and its cubic is computed once.
_LOOK = 4.0
# Number of consecutive rejections after which the search is modified.
_STALLED = 12
# A slide approaches a singular point in a step in which its determinant falls below the first
# factor. The step is then cut to the second factor of the distance, but not below the third factor
# of itself.
_FADED, _NEARER, _LEAST_NEARER = 0.25, 0.7, 1e-3
# The point counts as reached at this multiple of the rounding of times; much closer to it the
# weights are dominated by rounding.
_LAST_LOOK = 64
# A step to a grid point is brief if it is below this multiple of the rounding of times, and below
# this part of the grid's step.
_BRIEF, _BRIEF_PART = 4, 1 / 16
# Contacts closer than this part of the time to the first are one event.
_TOGETHER = 1e-6


def _found(g0: Array, d0: Array, g1: Array, d1: Array, armed: Array, noise: Array) -> Array:
    """The results of `first_contact` as one number."""
    theta, low = first_contact(g0, d0, g1, d1, armed, noise)
    return select(theta < NEVER, theta, low + _LOOK)


def _nothing(g0: Array, *_: Array) -> Array:
    return jnp.full_like(g0, NEVER + _LOOK)


def _searched(system: ComponentSystem, near: Array, *guard: Array) -> Array:
    """`_found` if the guard of any lane comes near zero."""
    return system.where_any(near, _found, _nothing, *guard)


def _searched_to(state: LoopState, end: StepEnd) -> Components:
    """The rounding assumed by the search. For a guard not armed it is the noise of the landing; for
    an armed one it may be all rounding accumulated since t0 in the state."""
    return maximum(end.motion.noise, where(state.armed, end.gathered, state.motion.noise))


class Contact(eqx.Module):
    """The contacts within a trial step: θ of the earliest contact or minimum to be examined
    (`NEVER` without one), the surfaces of that contact (empty for a minimum), and all surfaces
    crossed."""

    theta: Array
    surfaces: Components
    all: Components
    singular: Array
    """Whether θ only approaches a point at which a slide ceases to be unique."""

    @property
    def found(self) -> Array:
        """Whether there is a contact or a minimum."""
        return self.theta < NEVER


def met_together(thetas: Components, first: Array) -> Components:
    """The surfaces whose contacts, at these θ, are one event with the first."""
    return thetas <= first * (1 + _TOGETHER)


def find_contact(
    problem: Problem,
    state: LoopState,
    end: StepEnd,
    length: Length,
    searched: Components | None = None,
) -> Contact:
    """The earliest contact of a trial step, over all surfaces. θ is NaN where guards are too large
    to locate one. For surfaces already `searched` only the end is examined.

    A slide that repels at the end of the step is followed to where it ceases to attract.
    """
    system, h = problem.system, stop_gradient(length.h)  # the search has no derivatives
    # A slide or a rest that ends at a grid point ends next to it, by the rounding of times. In the
    # brief step to the grid point the field may still point back, which is not a new contact.
    rounding, dt = problem.same_time(end.motion.tau), typical_step(problem, state)
    brief = length.known & (abs(h) <= jnp.minimum(_BRIEF * rounding, _BRIEF_PART * dt))
    noise = _searched_to(state, end)
    ends = state.motion.g, h * state.motion.rate, stop_gradient(end.motion.g), h * end.motion.rate
    near = ~(state.armed & on_each(stays_off, *ends, noise))
    if searched is not None:
        near = near & ~(searched & (ends[2] >= -noise))
    search = ft.partial(_searched, system)
    found = on_each(search, near, *ends, state.armed, noise)
    if searched is not None:
        found = where(near, found, NEVER + _LOOK)
    found = system.hold(where(brief & ~state.armed, NEVER + _LOOK, found))
    # The earliest counts, in any order of the surfaces; contacts have priority over minima at the
    # same θ.
    thetas = minimum(found, NEVER)
    contact = least(thetas)
    lowest = jnp.minimum(least(where(found < _LOOK, NEVER, found - _LOOK)), NEVER)
    # A dip may be just before the end of a step that was cut at its bottom. Each further step to
    # its bottom would find one again, ever closer, so minima are ignored after many rejections.
    lowest = select(state.search.rejections >= _STALLED, NEVER, lowest)
    singular = jnp.zeros((), bool)
    if system.slides:
        singular, theta = _to_singular_point(problem, state, end, h)
        lowest = select(singular, jnp.minimum(lowest, theta), lowest)
    first = (contact < NEVER) & (contact <= lowest)
    surfaces = first & met_together(thetas, contact)
    # A search that does not converge from one side is helped by a shorter step.
    theta = jnp.minimum(contact, lowest)
    stalled = (
        (theta < NEVER) & (state.search.rejections >= _STALLED) & (state.search.rejections % 4 == 3)
    )
    return Contact(select(stalled, 0.5 * theta, theta), surfaces, thetas < NEVER, singular)


def _to_singular_point(
    problem: Problem, state: LoopState, end: StepEnd, h: Array
) -> tuple[Array, Array]:
    """Whether a step is too long for a slide that repels at its end, or whose weights are nearly
    undetermined there, and θ of a shorter one.

    No guard is zero where a slide becomes repelling. At a two-fold the determinant of its weights
    vanishes, and in a step across it they are 0/0. The point is approached by steps of a part of
    the distance. The last of them is long compared with rounding, and passes over the point.
    """
    assert state.motion.determinant is not None and end.motion.determinant is not None
    least = _LAST_LOOK * problem.same_time(end.motion.tau)
    repels, fades = end.num_modes > 1, end.motion.determinant < _FADED * state.motion.determinant
    singular = (repels | fades) & ~state.pending.waits & (abs(h) > least)
    then = select(repels, -end.motion.determinant, end.motion.determinant)
    known = state.motion.determinant, then, jnp.maximum(_LEAST_NEARER * abs(h), 0.5 * least), abs(h)
    return singular, problem.system.where_any(singular, _nearer, _not_nearer, *known)


def _nearer(now: Array, then: Array, least: Array, h: Array) -> Array:
    """θ of a step towards the zero of a determinant that is `now` here and `then` after h."""
    return jnp.clip(_NEARER * quotient(now, now - then), least / h, _NEARER)


def _not_nearer(now: Array, *_: Array) -> Array:
    return jnp.full_like(now, NEVER)


# Relations of the end of a step to a surface.
_NOTHING, _BRUSHED, _HIT, _HERE, _JUMPED = 0.0, 1.0, 2.0, 3.0, 4.0


class Landing(eqx.Module):
    """The landing of a step on a contact: whether it has landed, on which surfaces, whether it only
    grazes them, the signed time δ from the end of the step to the contact, the state there, n
    components, and whether H has jumped, in which case the contact is exactly at the end."""

    landed: Array
    surfaces: Components
    touched: Array
    delta: Array
    x: Components
    jumped: Array


def land(problem: Problem, state: LoopState, end: StepEnd, length: Length) -> Landing:
    """The landing of a step, if it has ended on a contact.

    δ is one Newton step. With g the guard, its error is of order δ² g̈/ġ, and the error of its
    derivative of order δ g̈/ġ, which is bounded here. Second derivatives are added by
    `beyond_newton`.
    """
    system, direction = problem.system, problem.grid.direction
    kinds, times = _kinds_of_end(problem, state, end, length)
    # One number for each surface, computed once, since all later values use it.
    kinds = system.hold(kinds)
    hits = kinds >= _HIT
    landed = any_of(hits)
    touched = any_of(kinds == _BRUSHED) & ~landed
    # A contact that is `_HERE` has δ = 0, with the derivative of its time.
    times = on_each(_time_of, kinds, times)
    # Contacts within the rounding of times of the first are reached with it; a later one needs a
    # step of its own.
    best = least(where(hits, direction * stop_gradient(times), jnp.inf))
    same = problem.same_time(end.motion.tau)
    hits = hits & ((kinds >= _HERE) | (direction * stop_gradient(times) <= best + same))
    # The surfaces are switched in the order of their numbers.
    first = first_set(hits)
    delta = total(where(first, times, 0.0))
    # Rounding can put a contact just past the end of its span. The state there is on the surface.
    x, room = end.motion.x + delta * end.motion.f, length.room
    late = (stop_gradient(delta) - room) * direction > 0
    late_delta = delta - stop_gradient(delta) + stop_gradient(room)
    delta = system.hold(select(late, late_delta, delta))
    linear, moves = (delta, x), first & (kinds != _JUMPED)
    delta, x = add_second_derivative(
        beyond_newton,
        linear,
        system,
        problem.grid.t0 + end.motion.tau,
        end.motion.x,
        end.motion.mode,
        moves,
    )
    surfaces, jumped = hits | (touched & (kinds == _BRUSHED)), any_of(hits & (kinds == _JUMPED))
    return Landing(landed | touched, surfaces, touched, delta, x, jumped)


def _time_of(kind: Array, missing: Array) -> Array:
    """δ of a contact. It is 0 for one that is here, with the derivative of its time; without a
    derivative if H has jumped, since that time is fixed."""
    here = select(kind == _HERE, missing - stop_gradient(missing), missing)
    return select(kind == _JUMPED, 0.0, here)


def _kinds_of_end(
    problem: Problem, state: LoopState, end: StepEnd, length: Length
) -> tuple[Components, Components]:
    """The relation of the end of a step to each surface, as floats, and the times to contacts."""
    system, grid, h = problem.system, problem.grid, length.h
    direction, same = grid.direction, problem.same_time(end.motion.tau)
    small = system.eps ** (2 / 3)
    rate, aimed = end.motion.rate, length.cutting & state.search.surfaces
    falls = direction * rate < 0
    # Where a guard does not fall, a rate of the right sign keeps the quotient finite.
    missing = -end.motion.g / where(falls, rate, -direction)
    size = abs(stop_gradient(missing))
    # g̈ h, from the rates at both ends; the error of Newton's step is of the order of δ g̈/ġ.
    bend = direction * (rate - state.motion.rate)
    known = small * typical_step(problem, state)
    close = (size <= known) & (size * abs(bend) <= small * abs(rate * h))
    inside = (length.room - stop_gradient(missing)) * direction >= 0
    # For the end of a slide or a rest, whose guard consists of fields, the remaining time is hidden
    # by the rounding of t. For H the state is more accurate: it is on the surface when g is within
    # its own rounding.
    g = stop_gradient(end.motion.g)
    bound = end.motion.mode == 0 if system.slides else end.motion.mode.like(jnp.zeros((), bool))
    if system.resets:
        bound = bound | (abs(end.motion.mode) == 2)
    zero = abs(g) <= end.motion.noise
    past = (g < 0) & (-g <= maximum(end.gathered, _searched_to(state, end)))
    # A graze: the vertex of the guard is here, and its value is within rounding.
    vertex = (bend > 0) & (0.5 * rate * rate * abs(h) <= end.gathered * bend)
    touch = state.armed & (abs(g) <= end.gathered) & ~bound & vertex
    # At the end of a run every contact within rounding is one of this run: one that starts there
    # would start on the surface (see `start`).
    last = length.gridded & (state.counts.index + 1 >= grid.num_steps)
    beside = zero | past
    if problem.same_end is not None:
        beside = beside | (size <= problem.same_end)
    at_end = last & beside & ~bound & ~touch
    # With several surfaces, contacts within the rounding of times are reached together, and a state
    # saved at the time of a contact is the one after it. At a grid point one contact keeps its
    # time, however close.
    loose = bound | (system.m > 1) | length.saving | last
    reached = (size <= same) & (inside | zero | loose) | (length.cutting & close & inside)
    reached = reached | (at_end & close)
    # The contact aimed at is here, with δ = 0, if rounding hides the remaining time, or if the step
    # has passed it by no more than the rounding that the search assumes.
    here = aimed & (zero | past | loose & (abs(h) <= same)) & ~reached
    here = here | (at_end & state.armed & ~reached)
    hit = falls & (here | ((state.armed | aimed) & reached))
    # H may jump at a fixed time, as with a ramp or a clock; however short the step, its end is past
    # the jump.
    across = aimed & (abs(h) <= same) & (g < -end.gathered - 2 * same * abs(rate)) & state.armed
    jumped = across & (abs(g) > 2 * same * abs(state.motion.rate)) & ~bound
    kinds = where(hit, where(here, _HERE, _HIT), where(touch, _BRUSHED, _NOTHING))
    return where(jumped, _JUMPED, kinds).astype(h.dtype), missing


def missing_time(grid: TimeGrid, state: LoopState, end: StepEnd) -> Array:
    """The signed time from here to the contact aimed at, by Newton; 0 if it is not ahead."""
    falls = grid.direction * end.motion.rate < 0
    ahead = stop_gradient(end.motion.g / abs(where(falls, end.motion.rate, 1.0)))
    first = least(where(state.search.surfaces & falls & (end.motion.g > 0), ahead, jnp.inf))
    return select(first < jnp.inf, grid.direction * first, 0.0)
