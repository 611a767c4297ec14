"""Impacts: the motion after a reset.

From H and its rates at the state after a reset follow the surfaces that need another reset, those
that the motion rests on, and the duration of a chattering that ends in rest.

For surfaces reached together resets are applied one at a time, the lowest number first, and
repeated for every surface that the motion runs into because of another's reset, until there are no
more, as for a ball in a corner or a wave through balls that touch. Each is an event of its own, at
the same time. After a reset a surface is off (H ≠ 0); or the motion continues on the side that the
rate points to (thrown back or let through); or, if the rate is zero too, the acceleration decides
whether the motion rests on the surface.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.guards import Surfaces, is_close, stays_on
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.lane.step_length import Length, typical_step
from jaxfil.integrate.surfaces import filippov, unilateral
from jaxfil.integrate.surfaces.corners import steered
from jaxfil.integrate.surfaces.unilateral import Constraints, ResetEffect
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

# The longest time, in sqrt(eps) steps, over which the state is moved along a constant field; the
# neglected change is quadratic in it.
_LEAP = 64


class Reset(eqx.Module):
    """A reset just applied. Components are m."""

    x: Components
    """The state after it, n components."""
    heard: Components
    """The surface whose reset was due."""
    acted: Components
    """The same surface if its reset has changed the state."""
    waits: Components
    """Other surfaces reached at the same time, whose resets wait."""
    h: Components
    """H before the reset, on lanes where one was due."""

    @property
    def moved(self) -> Array:
        """Whether it has changed the state."""
        return any_of(self.acted)


class Impact(eqx.Module):
    """The consequences of a reset. Components are m."""

    next: Components
    """The surfaces that need a reset or a choice of mode next, at the same time."""
    walls: Components
    """Surfaces that throw back, on which the motion cannot slide."""
    still: Components
    """Surfaces with zero rate, which the motion rests on or leaves with zero rate."""
    rests: Components
    """Surfaces that the motion rests on; for several surfaces, in the fields before."""
    pushed: Components
    """Resting surfaces from which another one's reset has pushed the motion away."""
    consistent: Array
    """Whether these reactions are consistent (see `unilateral.pressed`); for several surfaces,
    whether they hold the state at the limit of turns."""
    ends: Array
    """Whether a chattering ends here."""
    jump: Array
    """The time for which the motion is moved to its end; 0 without one."""
    kick: Components
    """The displacement of the state in that time beyond the field's, n components."""
    constraints: Constraints | None
    """The surfaces as constraints, if several are decided together; otherwise None."""
    links: Rows | None
    """Sizes of the changes of H_i and of its rate by an impulse at surface j, m numbers each; None
    for one surface."""
    by_time: Components | None
    """∂ψ/∂t of the constraints."""


class View(eqx.Module):
    """The surfaces as constraints, and their accelerations along the field."""

    constraints: Constraints
    effect: ResetEffect
    a: Components
    by_time: Components
    """∂ψ/∂t, m components."""
    noise: Components
    """Rounding of the rates."""


def make_reset(system: ComponentSystem, state: LoopState, t: Array, x: Components) -> Reset:
    """The reset of the first surface for which one is due. It is applied even if it leaves the
    state unchanged, since a kick of zero has a derivative."""
    assert state.settled is not None
    due = state.pending.waits & ~state.pending.grazes & ~state.settled
    # The end of a rest or a slide is not an impact.
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
    """The state with zero rates at the surfaces that it rests on, and the consequences of a reset,
    evaluated only for lanes that rest or wait for a switch."""
    system = problem.system

    def led(t: Array, x: Components, *given: Any) -> tuple[Components, Impact]:
        state, length, reset, at = given
        seen = _view(problem, state, t, x, (at.h_t, at.normals))
        x, seen = _held(system, state, reset, seen, x, at)
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
    if together:
        # Rates include the rounding of terms that cancel: of reactions, and of the two sides of a
        # friction, also where its slide has just ended.
        for side in sides, where(steered(system), -sides, sides):
            terms = abs(system.field(t, x, side))
            fast = maximum(fast, where(terms < jnp.inf, terms, 0.0))
    inside, dt = system.rate_rounding(t, x, sides), typical_step(problem, state)
    by_time = a - c.gradients @ f
    noise = unilateral.rate_noise(system, t, size, inside, dt, fast, c, by_time, surfaces)
    ahead = problem.grid.direction * system.eps**0.5 * dt
    later = stop_gradient((t + ahead, x + ahead * f))
    effect = unilateral.reset_effect(system, t, x, c, surfaces[1], later)
    return View(c, effect, a, by_time, noise)


def _held(
    system: ComponentSystem, state: LoopState, reset: Reset, seen: View, x: Components, at: Surfaces
) -> tuple[Components, View]:
    """The state with zero rates at its resting surfaces, and the view from there."""
    c, limit = seen.constraints, at_limit(state)
    # A rate caused by a reset or a jump is not rounding, and is kept.
    thrown = reset.moved | (state.pending.jumped & (abs(stop_gradient(c.rate)) > seen.noise))
    # At the limit of turns the rates at the surfaces reached have died out.
    rests = (unilateral.rests_of(state.motion.mode) & ~thrown) | (limit & seen.effect.throws_back)
    by, on, rate = c.impulse, rests, c.rate
    if filippov.holds_together(system):
        # The state stays on the surfaces that it slides on, or has reached at the limit. One that
        # is brought to rest by impulses alone would leave a friction that holds it.
        slid = ((state.motion.mode == 0) | (limit & ~seen.effect.throws_back)) & ~at.off
        directions = at.normals.where_each(slid, by.directions)
        by = unilateral.Response(directions, c.gradients.products(directions))
        gains = at.normals.where_each(slid, c.gradients).products(directions)
        on, rate = rests | slid, where(rests, c.rate, 0.0)
    else:
        gains = by.gains
    push = unilateral.multipliers(gains, rate, on)
    c = dataclasses.replace(c, rate=by.answered(c.rate, push))
    seen = dataclasses.replace(seen, constraints=c)
    return by.directions.added(x, push), seen


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
    """The consequences of a reset, given the surfaces after it."""
    system, c, direction = problem.system, seen.constraints, problem.grid.direction
    assert state.settled is not None
    switching = state.pending.waits & ~state.pending.grazes
    sides, resting = unilateral.sides_of(state.motion.mode), unilateral.rests_of(state.motion.mode)
    limit, (rate, noise) = at_limit(state), (stop_gradient(c.rate), seen.noise)
    reverses = seen.effect.throws_back
    # A surface just hit counts as reached even if |H| exceeds its rounding, since the rounding of
    # the contact's time is larger.
    here = reset.heard | (state.settled & state.pending.surfaces)
    there = ((abs(stop_gradient(at.h)) <= at.reached) | here) & ~at.off
    on = switching & reverses & there
    leaves = state.pending.surfaces & resting & ~reset.moved & ~limit
    still = on & ((abs(rate) <= noise) | limit) & ~leaves
    outward = direction * sides * rate
    # A rest ends where a map throws the state off, or leaves a reset that lets it pass.
    away = (reset.moved | state.pending.jumped) & resting & ((outward > noise) | ~reverses)
    jumped = reset.moved | state.settled | state.pending.jumped
    # A map may also leave the state exactly on a surface that lets it pass, and that it then moves
    # across; or that surface would be reached at the same rounded time. A surface whose reset has
    # no effect, as of dry friction, is decided with the others.
    close = is_close(problem, state, at.h)
    passed = switching & ~reverses & ~stays_on(system, state.motion.mode) & seen.effect.changes
    due = (jumped & on) | (passed & ((jumped & there) | (close & ~at.off)))
    acts = due & (outward < -noise) & ~reset.heard
    walls = reverses & ~(reset.heard & unilateral.lets_through(outward, noise))
    # A surface that a map has carried the state across has a contact at this time.
    across = switching & at.off & (state.motion.mode * at.h < 0) & ~reset.heard
    # A waiting reset is dropped if the state was moved back, or no longer moves to its surface,
    # where it may also have come to rest.
    back = at.off & (state.motion.mode * at.h > 0)
    parts = reverses & there & (outward > noise)
    spared = reset.waits & (back | (reset.moved & parts) | still)
    owed = (reset.waits & ~spared) | acts | across
    rests, consistent = unilateral.pressed(c.reaction, seen.a, sides, still)
    if system.m > 1:
        # Reactions of several surfaces are decided later (`decide`), but not the rates that have
        # died out at a limit of turns, where all surfaces rest.
        alive = outward < -noise / system.eps**0.5
        consistent = ~any_of(limit & reverses & alive)
    # Whether a surface holds a motion that arrives slowly is unknown without the derivative of its
    # reset.
    slow = state.pending.surfaces & there & (abs(rate) <= noise)
    consistent = consistent & ~any_of(slow & ~c.known & ~stays_on(system, state.motion.mode))
    more = any_of(owed)
    links = None
    if system.m > 1:
        links = abs(c.impulse.gains).plus(abs(at.normals.products(c.impulse.directions)))
    ends, jump, kick = _chattering(problem, state, length, reset, seen, at, rests, links, more)
    # A surface that the motion leaves has no impact: a reset would throw it back through it.
    others = more & state.pending.surfaces & ~reset.heard & ~spared & ~(parts & ~limit)
    upcoming = where(ends, reset.acted, owed | others)
    return Impact(
        next=upcoming,
        walls=walls,
        still=still,
        rests=rests,
        pushed=away,
        consistent=consistent | ~switching,
        ends=ends,
        jump=jump,
        kick=kick,
        constraints=c if system.m > 1 else None,
        links=links,
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
    links: Rows | None,
    more: Array,
) -> tuple[Array, Array, Components]:
    """Whether impacts on the surface just reset die out in a time so short that the field is
    constant, or with a height within the rounding of H; the time for which the motion is moved to
    their end; and the displacement of the state in that time beyond the field's."""
    system, grid, c = problem.system, problem.grid, seen.constraints
    sides = unilateral.sides_of(state.motion.mode)
    same = problem.same_time(state.motion.tau)
    # The neglected error is a part T ȧ/a of T.
    longest = jnp.maximum(same, system.eps**0.5 * typical_step(problem, state))
    forces = unilateral.multipliers(c.reaction.gains, seen.a, rests)
    held = c.reaction.answered(seen.a, forces)
    # The flights last 2ψ/(|a| (1 − e)) in all; `fall` is |a| (1 − e), with 1 − e = 2 − ∇ψ·d.
    away, fall = sides * c.rate, -sides * held * (2 - c.impulse.gains.diagonal())
    bounces = reset.acted & seen.effect.throws_back & (away > seen.noise) & (fall > 0) & ~more
    times = 2 * away / where(bounces, fall, 1)
    low = away * away <= 2 * abs(held) * at.gathered
    # If a grid point, saving time or tick comes before the rest, an ordinary step goes there first.
    # Backward in time impacts do not die out.
    ends = bounces & (low | (times <= longest)) & (times <= abs(length.room) + same)
    ends = ends & (grid.direction > 0)
    # If low bounces last longer than the limit, the rest begins earlier, by a time that only these
    # bounces would show, and the field moves the state only as far as it is constant to rounding.
    # Only one surface has been reset.
    time = total(where(ends, minimum(times, _LEAP * longest), 0.0))
    slid = state.motion.mode == 0

    def is_clear(time: Array, aside: Components) -> Array:
        ahead = sides * (at.h + time * (c.rate + 0.5 * time * held))
        # A slide stays on its surface, unless the reset has moved the state off it, to either side.
        left = where(abs(at.h) > at.gathered, abs(at.h) - time * abs(c.rate), 0.0)
        ahead = where(slid, left, ahead)
        return ~any_of(~((ahead >= -at.gathered) | rests | aside))

    # The chattering is not completed if another surface would be reached in that time, as by a
    # friction that sticks again in each flight. Where H cannot resolve the flights, the impulse of
    # all impacts is applied at once, which leaves the same velocities once the other is reached.
    once = total(where(ends & low, minimum(times, same), 0.0))
    clear = alone = is_clear(time, ends)
    if links is not None:
        apart = ~ends & (effects(links, ends) <= 0) & seen.effect.throws_back
        alone = is_clear(time, ends | apart)
    # Another wall, on which these impacts have no effect, has impacts of its own in that time. The
    # motion is not moved in time then, but put where the one at rest leads to the same state.
    still = alone & ~clear
    time = select(alone, time, once)
    found = any_of(ends) & (alone | ((once > 0) & is_clear(once, ends)))
    # The limit may be past a grid point by its rounding, which must not become a step back from
    # the wall in the motion after it.
    total_time = select(found, time - length.beyond(time), 0.0)
    # All impacts together remove the remaining rate, ψ_i + T a_i + Σ_k p_k ∇ψ_i·d_k = 0, including
    # the impulses from the surfaces that the motion rests on.
    stopped = found & (rests | ends)
    left = c.rate + total_time * held
    impulses = unilateral.multipliers(c.impulse.gains, left, stopped)
    kick = state.motion.x.like(jnp.zeros_like(state.motion.tau))
    if system.m > 1:
        # The field of the motion has the reactions of its mode alone, not yet those of surfaces
        # that have just come to rest.
        resting = unilateral.rests_of(state.motion.mode) | (still & (rests | ends))
        known = unilateral.multipliers(c.reaction.gains, seen.a, resting)
        kick = c.reaction.directions.added(kick, total_time * (forces - known))
    moved = select(still, 0.0, total_time)
    return found & (total_time > 0), moved, c.impulse.directions.added(kick, impulses)


def effects(links: Rows, some: Components) -> Components:
    """Sizes of the effects (`Impact.links`) of impulses at some surfaces on each, and of an impulse
    at each on these, m components."""
    flags = where(some, 1.0, 0.0)
    return links.added(links @ flags, flags)
