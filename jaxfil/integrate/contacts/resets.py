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
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.surfaces import filippov, unilateral
from jaxfil.integrate.surfaces.unilateral import Constraints
from jaxfil.integrate.system.components import Components, any_of, dot, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select

# Rounding of H, in eps of its terms.
_NOISE = 64
# How far a field carries the state at once, in sqrt(eps) steps: what it changes by is their square.
_LEAP = 64


class Reset(eqx.Module):
    """A reset just made. Components are m."""

    x: Components
    """The state after it, n components."""
    acted: Components
    """The surface that it was of; none: nothing has moved."""
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
    still: Components
    """Surfaces where the rate is zero too: rested on, or left with a rate of zero."""
    rests: Components
    """Those of them that the motion rests on."""
    pushed: Components
    """Surfaces rested on that another one's reset has pushed it away from."""
    consistent: Array
    """Whether these reactions are all that is needed."""
    jump: Array
    """The time that a chattering takes that ends here; 0: there is none."""
    kick: Components
    """How far it carries the state besides the field, n components."""


class View(eqx.Module):
    """The surfaces as constraints, and their accelerations along the field."""

    constraints: Constraints
    a: Components
    noise: Components
    """Rounding of the rates."""


def make_reset(system: ComponentSystem, state: LoopState, t: Array, x: Components) -> Reset:
    """The reset of the first surface met on which it moves the state."""
    assert state.settled is not None
    due = state.pending & ~state.graze & ~state.settled
    # What ends a rest is no impact.
    resting = unilateral.rests_of(state.mode)
    asked = tuple(due & hit & ~rests for hit, rests in zip(state.hit, resting, strict=True))

    def made(t: Array, x: Components, asked: Components) -> Reset:
        acted, waits, after, found = [], [], x, jnp.zeros((), bool)
        for j, ask in enumerate(asked):
            y = system.reset(t, x, jnp.int32(j))
            moves = ask & any_of(tuple(a != b for a, b in zip(y, x, strict=True)))
            first = moves & ~found
            after = where(first, y, after)
            acted.append(first)
            waits.append(moves & found)
            found = found | moves
        return Reset(after, tuple(acted), tuple(waits), system.switching(t, x))

    def none(t: Array, x: Components, asked: Components) -> Reset:
        no = (jnp.zeros((), bool),) * system.m
        return Reset(x, no, no, (jnp.zeros_like(t),) * system.m)

    return system.where_any(any_of(asked), made, none, t, x, asked)


def lead(
    problem: Problem,
    state: LoopState,
    length: Length,
    reset: Reset,
    t: Array,
    x: Components,
    surfaces: tuple[Components, tuple[Components, ...]],
    h: Components,
    touch: Components,
) -> tuple[Components, Impact]:
    """The state with no rate against the surfaces that it rests on, and what follows from a reset;
    nothing of a lane that neither rests nor waits for its switch. `surfaces` are ∂H/∂t and ∂H/∂x,
    `touch` is what rounding does to H."""
    system = problem.system

    def led(t: Array, x: Components, *given: Any) -> tuple[Components, Impact]:
        state, length, reset, surfaces, h, touch = given
        seen = _view(problem, state, t, x, surfaces)
        x, seen = _held(state, reset, seen, x)
        return x, _follow(problem, state, length, reset, seen, h, touch)

    def nothing(t: Array, x: Components, *_: Any) -> tuple[Components, Impact]:
        zero, no = jnp.zeros_like(t), (jnp.zeros((), bool),) * system.m
        return x, Impact(no, no, no, no, jnp.ones((), bool), zero, tuple(map(jnp.zeros_like, x)))

    engaged = state.pending | any_of(unilateral.rests_of(state.mode))
    given = state, length, reset, surfaces, h, touch
    return system.where_any(engaged, led, nothing, t, x, *given)


def _view(
    problem: Problem,
    state: LoopState,
    t: Array,
    x: Components,
    surfaces: tuple[Components, tuple[Components, ...]],
) -> View:
    """The surfaces as constraints."""
    system, sides = problem.system, unilateral.sides_of(state.mode)
    c = unilateral.constraints(system, t, x, sides)
    f = filippov.free_field(system, t, x, state.mode)
    a = unilateral.accelerations(system, t, x, sides, f)
    size, fast = (
        tuple(jnp.maximum(abs(u), abs(v)) for u, v in zip(now, old, strict=True))
        for now, old in ((x, state.x), (f, state.f))
    )
    return View(c, a, unilateral.rate_noise(t, size, problem.grid.dt, fast, c, a, surfaces))


def _held(state: LoopState, reset: Reset, seen: View, x: Components) -> tuple[Components, View]:
    """The state with no rate against the surfaces that it rests on, and how they see it then."""
    c = seen.constraints
    rests = tuple(r & ~reset.moved for r in unilateral.rests_of(state.mode))
    # Impacts that have died out by turns have left no rates against the surfaces met.
    each = zip(rests, at_limit(state), c.throws_back, strict=True)
    rests = tuple(r | (limit & wall) for r, limit, wall in each)
    push = unilateral.multipliers(c.gains, c.rate, rests)
    c = dataclasses.replace(c, rate=unilateral.answered(c.gains, c.rate, push))
    seen = dataclasses.replace(seen, constraints=c)
    return unilateral.pushed(x, c.directions, push), seen


def at_limit(state: LoopState) -> Components:
    """The surfaces at which the impacts of a lane have just died out by turns."""
    if state.turn is None:
        return tuple(jnp.zeros_like(hit) for hit in state.hit)
    return tuple(state.turn.completed & state.pending & hit for hit in state.hit)


def _follow(
    problem: Problem,
    state: LoopState,
    length: Length,
    reset: Reset,
    seen: View,
    h: Components,
    touch: Components,
) -> Impact:
    """What follows from a reset, given H after it and what rounding does to H."""
    system, c, direction = problem.system, seen.constraints, problem.grid.direction
    assert state.settled is not None
    switching = state.pending & ~state.graze
    sides, resting = unilateral.sides_of(state.mode), unilateral.rests_of(state.mode)
    still, owed, away, limit = [], [], [], at_limit(state)
    for j in range(system.m):
        there = (abs(stop_gradient(h[j])) <= touch[j]) | (state.settled & state.hit[j])
        on = switching & c.throws_back[j] & there
        rate, noise = stop_gradient(c.rate[j]), seen.noise[j]
        leaves = state.hit[j] & resting[j] & ~reset.moved & ~limit[j]
        still.append(on & ((abs(rate) <= noise) | limit[j]) & ~leaves)
        inward = direction * sides[j] * rate < -noise
        away.append(reset.moved & resting[j] & (direction * sides[j] * rate > noise))
        acts = (reset.moved | state.settled) & on & inward & ~reset.acted[j]
        owed.append(reset.waits[j] | acts)
    rests, consistent = unilateral.pressed(c.gains, seen.a, sides, tuple(still))
    more = any_of(tuple(owed))
    jump, kick = _chattering(problem, state, length, reset, seen, h, touch, rests, more)
    upcoming = tuple(
        select(jump > 0, acted, o | (more & hit & ~acted))
        for acted, o, hit in zip(reset.acted, owed, state.hit, strict=True)
    )
    fine = consistent | ~switching
    return Impact(upcoming, tuple(still), rests, tuple(away), fine, jump, kick)


def _chattering(
    problem: Problem,
    state: LoopState,
    length: Length,
    reset: Reset,
    seen: View,
    h: Components,
    touch: Components,
    rests: Components,
    more: Array,
) -> tuple[Array, Components]:
    """The time in which impacts on the surface just reset die out, if that is so short that the
    field does not change, or their height within rounding of H, and how far they carry the state
    besides the field."""
    system, grid, c = problem.system, problem.grid, seen.constraints
    sides = unilateral.sides_of(state.mode)
    same = grid.same_time(state.tau)
    # What is left out is a part T ȧ/a of T.
    longest = jnp.maximum(same, system.eps**0.5 * abs(grid.dt))
    held = unilateral.answered(c.gains, seen.a, unilateral.multipliers(c.gains, seen.a, rests))
    total, found, ending = jnp.zeros_like(state.tau), jnp.zeros((), bool), []
    for j, a in enumerate(held):
        away, fall = sides[j] * c.rate[j], -sides[j] * a * (2 - c.gains[j][j])  # 2 − gain = 1 − e
        bounces = reset.acted[j] & c.throws_back[j] & (away > seen.noise[j]) & (fall > 0) & ~more
        time = 2 * away / select(bounces, fall, 1)
        low = away * away <= 2 * abs(a) * touch[j]
        ends = bounces & (low | (time <= longest)) & (time <= abs(length.room) + same)
        # Bounces that are low for longer are left out: rest begins earlier, by a time that
        # nothing but these could tell, and the field carries the state no further than it is
        # constant to rounding.
        time = jnp.minimum(time, _LEAP * longest)
        ends = ends & (grid.direction > 0) & ~found
        for i, s in enumerate(sides):  # unless another surface is met before
            ahead = s * (h[i] + time * (c.rate[i] + 0.5 * time * held[i]))
            ends = ends & ((ahead >= -touch[i]) | rests[i] | (i == j))
        total, found = select(ends, time, total), found | ends
        ending.append(ends)
    # All impacts together take away the rate that is left, ψ_i + T a_i + Σ_k p_k ∇ψ_i·d_k = 0,
    # with those by which the surfaces that are rested on answer them.
    taken = tuple(found & (rest | ends) for rest, ends in zip(rests, ending, strict=True))
    left = tuple(rate + total * a for rate, a in zip(c.rate, held, strict=True))
    impulses = unilateral.multipliers(c.gains, left, taken)
    still = tuple(jnp.zeros_like(v) for v in state.x)
    return total, unilateral.pushed(still, c.directions, impulses)


class Beginning(eqx.Module):
    """How a run starts on surfaces with resets. Components are m."""

    sides: Components
    """The side to start on, where nothing else is said."""
    known: Components
    """Surfaces on which no mode is to be chosen."""
    owed: Components
    """Surfaces whose reset comes first."""
    rests: Components
    """Surfaces rested on."""
    consistent: Array
    """Whether their reactions are all that is needed."""


def begin(
    problem: Problem, x: Components, on: Components, sides: Components, rates: Components
) -> Beginning:
    """How a run starts on the surfaces marked `on`, given the rates of H on side + with the sign of
    the first derivative that does not vanish.

    A surface that throws back bounds H ≥ 0: a motion towards H < 0 is an impact at t0, one that
    has no rate and is pressed rests, any other has left. A reset that leads off its surface comes
    first if it leads to where the motion comes from; any other has been made already.
    """
    system, t, direction = problem.system, problem.grid.t0, problem.grid.direction
    above = tuple(jnp.ones_like(s) for s in sides)
    c = unilateral.constraints(system, t, x, above)
    f = system.field(t, x, above)
    a = unilateral.accelerations(system, t, x, above, f)
    _, h_t, normals = system.gradients(t, x)
    size = tuple(abs(v) for v in x)
    noise = unilateral.rate_noise(t, size, problem.grid.dt, f, c, a, (h_t, normals))
    owed, still, known, start, lean = [], [], [], [], []
    for j in range(system.m):
        flat = abs(c.rate[j]) <= noise[j]
        inward = direction * rates[j] < 0
        wall = on[j] & c.throws_back[j]
        after = system.reset(t, x, jnp.int32(j))
        led = system.switching(t, after)[j]
        terms = dot(tuple(map(abs, normals[j])), size)
        far = stop_gradient(abs(led)) > _NOISE * system.eps * terms
        side = select(led < 0, -1.0, 1.0).astype(system.dtype)
        back = on[j] & ~c.throws_back[j] & far & (direction * side * rates[j] < 0) & ~flat
        owed.append((wall & inward & ~flat) | back)
        still.append(wall & flat)
        known.append(wall | back)
        start.append(select(wall, 1.0, select(back, side, sides[j])).astype(system.dtype))
        # Where it is pressed by a derivative higher than the acceleration, that one's sign counts.
        lean.append(select(a[j] * rates[j] > 0, a[j], select(flat, rates[j], a[j])))
    rests, consistent = unilateral.pressed(c.gains, tuple(lean), above, tuple(still))
    return Beginning(tuple(start), tuple(known), tuple(owed), rests, consistent)
