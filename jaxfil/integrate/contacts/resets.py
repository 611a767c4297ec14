"""Impacts: what a reset leads to.

A lane that waits for its switch and the state there enter; the state after the reset leaves, and
what H and its rates say there: which surface asks for a reset next, which the motion rests on, and
how long a chattering lasts that ends in rest.

Of surfaces met together the reset hears one at a time, the lowest number first, and again of every
one that another's reset has made the motion run into, until none is left: a ball in a corner, a
wave through balls that touch. Each is an event of its own, at the same time. A surface that has
been reset is then off (H ≠ 0: the motion goes on where it is), left (on the side that the rate
points to: thrown back or let through) or, where the rate is zero too, rested on or left as the
acceleration says.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.guards import Surfaces, stays_on
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.lane.step_length import Length, typical_step
from jaxfil.integrate.surfaces import filippov, unilateral
from jaxfil.integrate.surfaces.unilateral import Constraints
from jaxfil.integrate.system.components import (
    Components,
    any_of,
    first_set,
    index_of,
    maximum,
    minimum,
    total,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.rows import Rows
from jaxfil.xla.select import select

# How far a field carries the state at once, in sqrt(eps) steps: what it changes by is their square.
_LEAP = 64


class Reset(eqx.Module):
    """A reset just made. Components are m."""

    x: Components
    """The state after it, n components."""
    heard: Components
    """The surface that it was of, if one was due."""
    acted: Components
    """The same if it has moved the state, otherwise none."""
    waits: Components
    """Surfaces met with it that wait for theirs."""
    h: Components
    """H before it, where something was due."""

    @property
    def moved(self) -> Array:
        """Whether it has moved the state."""
        return any_of(self.acted)


class Impact(eqx.Module):
    """What a reset has led to. Components are m."""

    next: Components
    """The surfaces that ask for a reset or a choice of mode next, at once."""
    walls: Components
    """Surfaces that throw back, which are not slid on."""
    still: Components
    """Surfaces where the rate is zero too: rested on, or left with a rate of zero."""
    rests: Components
    """Those of them that the motion rests on; of several surfaces in the fields before."""
    pushed: Components
    """Surfaces rested on that another one's reset has pushed it away from."""
    consistent: Array
    """Whether these reactions are all that is needed."""
    jump: Array
    """The time that a chattering takes that ends here; 0: there is none."""
    kick: Components
    """How far it carries the state besides the field, n components."""
    constraints: Constraints | None
    """The surfaces as constraints, where several are decided together; otherwise None."""
    by_time: Components | None
    """∂ψ/∂t of these."""


class View(eqx.Module):
    """The surfaces as constraints, and their accelerations along the field."""

    constraints: Constraints
    a: Components
    by_time: Components
    """∂ψ/∂t, m components."""
    noise: Components
    """Rounding of the rates."""


def make_reset(system: ComponentSystem, state: LoopState, t: Array, x: Components) -> Reset:
    """The reset of the first surface that is due for it. It is made whether or not it moves the
    state: a kick of zero has a derivative."""
    assert state.settled is not None
    due = state.pending.waits & ~state.pending.grazes & ~state.settled
    # What ends a rest or a slide is no impact.
    asked = due & state.pending.surfaces & ~stays_on(system, state.motion.mode)

    def made(t: Array, x: Components, asked: Components) -> Reset:
        heard = first_set(asked)
        after = where(any_of(heard), system.reset(t, x, index_of(heard)), x)
        acted = heard & any_of(after != x)
        return Reset(after, heard, acted, asked & ~heard, system.switching(t, x))

    def none(t: Array, x: Components, asked: Components) -> Reset:
        no = asked.like(jnp.zeros((), bool))
        return Reset(x, no, no, no, asked.like(jnp.zeros_like(t)))

    return system.where_any(any_of(asked), made, none, t, x, asked)


def lead(
    problem: Problem,
    state: LoopState,
    length: Length,
    reset: Reset,
    t: Array,
    x: Components,
    at: Surfaces,
) -> tuple[Components, Impact]:
    """The state with no rate against the surfaces that it rests on, and what follows from a reset;
    nothing of a lane that neither rests nor waits for its switch."""
    system = problem.system

    def led(t: Array, x: Components, *given: Any) -> tuple[Components, Impact]:
        state, length, reset, at = given
        seen = _view(problem, state, t, x, (at.h_t, at.normals))
        x, seen = _held(state, reset, seen, x)
        return x, _follow(problem, state, length, reset, seen, at)

    def nothing(t: Array, x: Components, *_: Any) -> tuple[Components, Impact]:
        shapes = jax.eval_shape(led, t, x, state, length, reset, at)
        _, none = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
        return x, dataclasses.replace(none, consistent=jnp.ones((), bool))

    engaged = state.pending.waits | any_of(unilateral.rests_of(state.motion.mode))
    return system.where_any(engaged, led, nothing, t, x, state, length, reset, at)


def _view(
    problem: Problem,
    state: LoopState,
    t: Array,
    x: Components,
    surfaces: tuple[Components, Rows],
) -> View:
    """The surfaces as constraints."""
    system, sides = problem.system, unilateral.sides_of(state.motion.mode)
    c = unilateral.constraints(system, t, x, sides)
    together = filippov.holds_together(system)
    field = filippov.field if together else filippov.free_field
    f = field(system, t, x, state.motion.mode)
    a = unilateral.accelerations(system, t, x, sides, f)
    size, fast = (
        maximum(abs(now), abs(old)) for now, old in ((x, state.motion.x), (f, state.motion.f))
    )
    if together:  # rounding of what reactions cancel is in the rates, however small the rest
        fast = maximum(fast, abs(system.field(t, x, sides)))
    inside, dt = system.rate_rounding(t, x, sides), typical_step(problem, state)
    by_time = a - c.gradients @ f
    return View(
        c, a, by_time, unilateral.rate_noise(t, size, inside, dt, fast, c, by_time, surfaces)
    )


def _held(state: LoopState, reset: Reset, seen: View, x: Components) -> tuple[Components, View]:
    """The state with no rate against the surfaces that it rests on, and how they see it then."""
    c = seen.constraints
    # What has just been thrown against them, or off, is no rounding.
    thrown = reset.moved | (state.pending.jumped & (abs(stop_gradient(c.rate)) > seen.noise))
    # Impacts that have died out by turns have left no rates against the surfaces met.
    rests = (unilateral.rests_of(state.motion.mode) & ~thrown) | (at_limit(state) & c.throws_back)
    push = unilateral.multipliers(c.impulse.gains, c.rate, rests)
    c = dataclasses.replace(c, rate=c.impulse.answered(c.rate, push))
    seen = dataclasses.replace(seen, constraints=c)
    return c.impulse.directions.added(x, push), seen


def at_limit(state: LoopState) -> Components:
    """The surfaces at which the impacts of a lane have just died out by turns."""
    if state.turn is None:
        return state.pending.surfaces.like(jnp.zeros((), bool))
    return state.turn.completed & state.pending.waits & state.pending.surfaces


def _follow(
    problem: Problem,
    state: LoopState,
    length: Length,
    reset: Reset,
    seen: View,
    at: Surfaces,
) -> Impact:
    """What follows from a reset, given the surfaces after it."""
    system, c, direction = problem.system, seen.constraints, problem.grid.direction
    assert state.settled is not None
    switching = state.pending.waits & ~state.pending.grazes
    sides, resting = unilateral.sides_of(state.motion.mode), unilateral.rests_of(state.motion.mode)
    limit, (rate, noise) = at_limit(state), (stop_gradient(c.rate), seen.noise)
    # Rounding of the time of a contact is more than that of H.
    here = reset.heard | (state.settled & state.pending.surfaces)
    there = ((abs(stop_gradient(at.h)) <= at.gathered) | here) & ~at.off
    on = switching & c.throws_back & there
    leaves = state.pending.surfaces & resting & ~reset.moved & ~limit
    still = on & ((abs(rate) <= noise) | limit) & ~leaves
    outward = direction * sides * rate
    away = (reset.moved | state.pending.jumped) & resting & (outward > noise)
    jumped = reset.moved | state.settled | state.pending.jumped
    acts = jumped & on & (outward < -noise) & ~reset.heard
    # A reset may let a fast motion through, whatever it does to slow ones.
    walls = c.throws_back & ~(reset.heard & (outward < -noise))
    # What a map has carried the state across has a contact there, at this time.
    across = switching & at.off & (state.motion.mode * at.h < 0) & ~reset.heard
    # What waits for its reset and has been led back, or is no longer run into, is none any more.
    back = at.off & (state.motion.mode * at.h > 0)
    parts = c.throws_back & there & (outward > noise)
    spared = reset.waits & (back | (reset.moved & parts))
    owed = (reset.waits & ~spared) | acts | across
    rests, consistent = unilateral.pressed(c.reaction, seen.a, sides, still)
    more = any_of(owed)
    jump, kick = _chattering(problem, state, length, reset, seen, at, rests, more)
    others = more & state.pending.surfaces & ~reset.heard & ~spared
    upcoming = where(jump > 0, reset.acted, owed | others)
    return Impact(
        next=upcoming,
        walls=walls,
        still=still,
        rests=rests,
        pushed=away,
        consistent=consistent | ~switching,
        jump=jump,
        kick=kick,
        constraints=c if system.m > 1 else None,
        by_time=seen.by_time if system.m > 1 else None,
    )


def _chattering(
    problem: Problem,
    state: LoopState,
    length: Length,
    reset: Reset,
    seen: View,
    at: Surfaces,
    rests: Components,
    more: Array,
) -> tuple[Array, Components]:
    """The time in which impacts on the surface just reset die out, if that is so short that the
    field does not change, or their height within rounding of H, and how far they carry the state
    besides the field."""
    system, grid, c = problem.system, problem.grid, seen.constraints
    sides = unilateral.sides_of(state.motion.mode)
    same = grid.same_time(state.motion.tau)
    # What is left out is a part T ȧ/a of T.
    longest = jnp.maximum(same, system.eps**0.5 * typical_step(problem, state))
    held = c.reaction.answered(seen.a, unilateral.multipliers(c.reaction.gains, seen.a, rests))
    away, fall = sides * c.rate, -sides * held * (2 - c.impulse.gains.diagonal())  # that is 1 − e
    bounces = reset.acted & c.throws_back & (away > seen.noise) & (fall > 0) & ~more
    times = 2 * away / where(bounces, fall, 1)
    low = away * away <= 2 * abs(held) * at.gathered
    ends = bounces & (low | (times <= longest)) & (times <= abs(length.room) + same)
    ends = ends & (grid.direction > 0)
    # Bounces that are low for longer are left out: rest begins earlier, by a time that nothing but
    # these could tell, and the field carries the state no further than it is constant to rounding.
    # It is one surface that has been reset.
    time = total(where(ends, minimum(times, _LEAP * longest), 0.0))
    # Unless another surface is met before.
    ahead = sides * (at.h + time * (c.rate + 0.5 * time * held))
    found = any_of(ends) & ~any_of(~((ahead >= -at.gathered) | rests | ends))
    total_time = select(found, time, 0.0)
    # All impacts together take away the rate that is left, ψ_i + T a_i + Σ_k p_k ∇ψ_i·d_k = 0,
    # with those by which the surfaces that are rested on answer them.
    stopped = found & (rests | ends)
    left = c.rate + total_time * held
    impulses = unilateral.multipliers(c.impulse.gains, left, stopped)
    return total_time, c.impulse.directions.added(
        state.motion.x.like(jnp.zeros_like(state.motion.tau)), impulses
    )
