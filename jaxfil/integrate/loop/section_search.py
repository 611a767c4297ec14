"""Crossings of sections: found in steps that the loop has made, and recorded.

A trial step that the loop would go on with enters; if a section is crossed in it, it is taken back,
and the next trial steps look for the crossing:

    S0 ╲           ┼           ┼          1. a full step, crossed: taken back
        ╲__ ℓ      h                      2. a step to ℓ, from Hermite's cubic: Newton, step again
    ───────╲┼──────┼─── 0                 3. close enough: t = t0 + τ + ℓ + δ, x + δ f, δ = −S/Ṡ
             ╲_____╲                      4. the full step again, watched from ℓ on

The loop's own steps stay as they are to the last bit, whatever is watched. Each lane looks by
itself, so that a batch pays for a crossing what its lane does. The state at a crossing is that of
a step of the method, with no interpolation, and as the lengths ℓ are constants and δ is not, it
has the exact derivative.

Rounding tells nothing of S: a section counts as crossed when S has been beyond its rounding on both
sides. One that is zero where a piece of the motion begins, as at a contact with a surface that it
coincides with, is crossed there if S goes on to the other side, and there alone.
"""

import dataclasses
import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.guards import NOISE
from jaxfil.integrate.contacts.locate import NEVER, first_contact, stays_off
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.recording import entered, mode_codes
from jaxfil.integrate.lane.state import CrossingTable, LoopState, StepEnd, Watch, later
from jaxfil.integrate.surfaces.sections import Sight, WatchedSections, beyond_newton, see
from jaxfil.integrate.system.components import Components, all_finite, any_of, axpy, pack, where
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.second_derivative import add_second_derivative
from jaxfil.xla.select import select

# Newton's steps before the search goes on by halves, and trial steps at most.
_NEWTON, _TRIES = 12, 60


class Seen(eqx.Module):
    """What is known of the sections at the end of a trial step."""

    sight: Sight
    seeks: Array
    """Whether the trial step only looks for a crossing, or is taken back to do so."""
    watch: Watch
    """How the search goes on."""
    recorded: Array
    """Whether a crossing has been located,"""
    number: Array
    """of which section,"""
    tau: Array
    """at what elapsed time,"""
    rest: Array
    """what its rounding has left out,"""
    x: Components
    """in what state,"""
    result: RESULTS
    """and what that makes of the run."""


def begin(problem: Problem, state: LoopState) -> LoopState:
    """A lane at t0, watched from there on."""
    watched = problem.watched
    if watched is None:
        return state
    zero, false = jnp.zeros_like(state.tau), jnp.zeros((), bool)
    none, nothing = jnp.zeros((), jnp.int32), (zero,) * len(watched.functions)
    flags = (false,) * len(watched.functions)
    watch = Watch(
        side=nothing,
        value=nothing,
        rate=nothing,
        away=flags,
        owed=flags,
        start=zero,
        seeking=false,
        length=zero,
        aim=flags,
        low=zero,
        high=zero,
        tries=none,
        counts=(none,) * len(watched.functions),
        total=none,
    )
    at, motion = (problem.grid.t0 + state.tau, state.x), (state.mode, state.f)
    sight = see(watched, problem.system, at, motion, state.size)
    watch = _moved_on(problem, watch, sight, false)
    result, (_, noises) = state.result, _told(problem, sight)
    for bound, value, noise in zip(watched.bounds, sight.value, noises, strict=True):
        outside = bound & (value < -noise) & (result == RESULTS.successful)
        result = RESULTS.where(outside, RESULTS.out_of_bounds, result)
    size = problem.recording.num_crossings
    table = None
    if size is not None:
        table = CrossingTable(
            ts=jnp.full((size,), jnp.inf, problem.system.dtype),
            xs=jnp.full((size, problem.system.n), jnp.inf, problem.system.dtype),
            sections=jnp.full((size,), -1, jnp.int32),
            modes=jnp.zeros((size, problem.system.m), jnp.int8),
        )
    return dataclasses.replace(state, watch=watch, crossings=table, result=result)


def look(problem: Problem, state: LoopState, end: StepEnd, h: Array, passes: Array) -> Seen:
    """The sections at the end of a trial step. `passes`: the loop would go on with it to the
    length h, which its landing has corrected."""
    watched, watch = problem.watched, state.watch
    assert watched is not None and watch is not None
    at, motion = (problem.grid.t0 + end.tau, end.x), (end.mode, end.f)
    sight = see(watched, problem.system, at, motion, end.size)
    here = select(watch.seeking, watch.length, h)
    found, length, aim = _find(problem, watch, sight, here)
    aimed = any_of(watch.aim)
    looks = watch.seeking & ~aimed
    begins = found & (looks | (passes & ~watch.seeking))
    begun = dataclasses.replace(
        watch,
        seeking=jnp.ones_like(found),
        length=length,
        aim=aim,
        low=select(length * problem.grid.direction > 0, watch.start, 0.0),
        high=stop_gradient(here),
        tries=jnp.zeros_like(watch.tries),
    )
    closer, delta, done = _approach(problem, state, sight, end)
    located = tuple(a & ~owed for a, owed in zip(watch.aim, watch.owed, strict=True))
    linear, given = (delta, axpy(end.x, delta, end.f)), (watched, problem.system)
    delta, x = add_second_derivative(beyond_newton, linear, *given, at, end.mode, located)
    tau, rest = later(state.tau, state.rest, watch.length + delta)
    counts = True if watched.since is None else problem.grid.t0 + tau >= watched.since
    recorded, after = _crossed(problem, closer, sight, done, counts)
    goes_on = dataclasses.replace(
        watch,
        value=sight.value,
        rate=sight.rate,
        away=_told(problem, sight)[0],
        start=watch.length,
        seeking=jnp.zeros_like(found),
    )
    sought = _chosen(done, after, closer)
    sought = _chosen(looks, goes_on, sought)
    finite = all_finite(end.x, sight.value, sight.rate)
    return Seen(
        sight=sight,
        seeks=(begins | watch.seeking) & finite,
        watch=_chosen(begins, begun, sought),
        recorded=recorded & finite,
        number=sum((j * a.astype(jnp.int32) for j, a in enumerate(watch.aim)), jnp.int32(0)),
        tau=tau,
        rest=rest,
        x=x,
        result=_result(watched, state.result, watch.aim, after.counts, recorded & finite),
    )


def _chosen(flag: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(ft.partial(select, flag), new, old)


def _told(problem: Problem, sight: Sight) -> tuple[Components, Components]:
    """Whether each S is told from zero, and what rounding does to it."""
    noises = tuple(NOISE * problem.system.eps * v for v in sight.terms)
    values = zip(sight.value, noises, strict=True)
    return tuple(abs(stop_gradient(v)) > noise for v, noise in values), noises


def _wanted(problem: Problem, side: Components) -> Components:
    """Whether a crossing from these sides, along the motion, is in the section's direction."""
    assert problem.watched is not None
    each = zip(problem.watched.directions, side, strict=True)
    forward = problem.grid.direction
    return tuple((s * forward * d < 0) | (d == 0) for d, s in each)


def _sides(problem: Problem, watch: Watch, sight: Sight, h: Array) -> Components:
    """The sides that sections start from: of one that the motion starts on, the one it takes."""
    least, sides = problem.system.eps**0.5, []
    each = zip(watch.side, watch.rate, sight.value, sight.rate, strict=True)
    for side, rate, then, last in each:
        then = stop_gradient(then)
        tells = abs(h * rate) > least * (abs(then) + abs(h * last))
        sides.append(select(side == 0, jnp.sign(select(tells, h * rate, then)), side))
    return tuple(sides)


def _find(
    problem: Problem, watch: Watch, sight: Sight, length: Array
) -> tuple[Array, Array, Components]:
    """Whether there is something to be looked at between the start of the watch and a `length`, at
    which length, and the section that is crossed there."""
    h = stop_gradient(length) - watch.start
    sides, (_, noises) = _sides(problem, watch, sight, h), _told(problem, sight)
    first = lowest = jnp.asarray(NEVER, h.dtype)
    thetas = []
    for j, wanted in enumerate(_wanted(problem, sides)):
        side, away = sides[j], watch.away[j]
        g0 = select(away, side * watch.value[j], 0.0)
        g1 = side * stop_gradient(sight.value[j])
        ends = g0, side * h * watch.rate[j], g1, side * h * sight.rate[j]
        near = ~(away & stays_off(*ends, noises[j])) & (side != 0)
        find = ft.partial(_first_of_one, wanted=wanted)
        args = (*ends, away, noises[j])
        theta, low = problem.system.where_any(near, find, _nothing, *args)
        theta = select(near, select(watch.owed[j], 0.0, theta), NEVER)
        thetas.append(theta)
        first = jnp.minimum(first, theta)
        lowest = jnp.minimum(lowest, select(near, low, NEVER))
    # One look at a time, and none before a crossing that is known.
    lowest = select(watch.seeking, NEVER, lowest)
    crossed = (first < NEVER) & (first <= lowest)
    aim, left = [], crossed
    for theta in thetas:
        aim.append(left & (theta <= first))
        left = left & ~aim[-1]
    theta = jnp.minimum(first, lowest)
    return theta < NEVER, watch.start + theta * h, tuple(aim)


def _first_of_one(
    g0: Array, d0: Array, g1: Array, d1: Array, away: Array, noise: Array, wanted: Array
) -> tuple[Array, Array]:
    """θ of the first crossing of one section, S times the side that it comes from, and of a minimum
    to be looked at."""
    theta, low = first_contact(g0, d0, g1, d1, away, noise)
    over = g1 < -noise
    # Zero at the start and falling: the crossing is there.
    theta = select((g0 < -noise) | (~away & (d0 <= 0) & over), 0.0, theta)
    # A crossing in the other direction, after which nothing comes, need not be located.
    passed = ~wanted & over
    return select(passed, NEVER, theta), select(passed, NEVER, low)


def _nothing(g0: Array, *_: Array) -> tuple[Array, Array]:
    return jnp.full_like(g0, NEVER), jnp.full_like(g0, NEVER)


def _approach(
    problem: Problem, state: LoopState, sight: Sight, end: StepEnd
) -> tuple[Watch, Array, Array]:
    """After a trial step to where a crossing was expected: the next one, Newton's step in time from
    here, and whether that is all that is missing."""
    system, grid, watch = problem.system, problem.grid, state.watch
    assert watch is not None
    small, zero = system.eps ** (2 / 3), jnp.zeros_like(state.tau)
    g, rate, rate0, noise = zero, zero, zero, zero
    owed, sides = jnp.zeros((), bool), _sides(problem, watch, sight, watch.length - watch.start)
    _, noises = _told(problem, sight)
    for j, aimed in enumerate(watch.aim):
        g = select(aimed, sides[j] * sight.value[j], g)
        rate = select(aimed, sides[j] * sight.rate[j], rate)
        rate0 = select(aimed, sides[j] * watch.rate[j], rate0)
        noise = select(aimed, noises[j], noise)
        owed = owed | (aimed & watch.owed[j])
    falls = grid.direction * rate < 0
    delta = select(falls, -g / select(falls, rate, 1.0), 0.0)
    at, size = watch.length, abs(stop_gradient(delta))
    g = stop_gradient(g)
    low, high = select(g > 0, at, watch.low), select(g < 0, at, watch.high)
    newton = at + stop_gradient(delta)
    inside = ((newton - low) * grid.direction >= 0) & ((high - newton) * grid.direction >= 0)
    bend = size * abs(rate - rate0) <= small * abs(rate * (at - watch.start))
    close = falls & inside & (size <= small * abs(grid.dt)) & bend
    narrow = abs(high - low) <= grid.same_time(end.tau)
    done = close | (abs(g) <= noise) | narrow | owed | (watch.tries >= _TRIES)
    halved = ~inside | (watch.tries >= _NEWTON)
    length = select(halved, 0.5 * (low + high), newton)
    closer = dataclasses.replace(
        watch, side=sides, length=length, low=low, high=high, tries=watch.tries + 1
    )
    # Where S only touches zero, its rate says nothing of the time.
    told = (inside | (size <= small * abs(grid.dt))) & ~owed
    return closer, select(told, delta, 0.0), done & watch.seeking & any_of(watch.aim)


def _crossed(
    problem: Problem, watch: Watch, sight: Sight, done: Array, counts: Array | bool
) -> tuple[Array, Watch]:
    """Whether a crossing that is `done` counts, if one at this time `counts`, and the watch behind
    it."""
    assert problem.watched is not None and watch is not None
    wanted, (away, _) = _wanted(problem, watch.side), _told(problem, sight)
    counted = tuple(a & w & done & counts for a, w in zip(watch.aim, wanted, strict=True))
    recorded = any_of(counted)
    zero = jnp.zeros_like(watch.length)
    # What has jumped is on its other side at once.
    settled = tuple(a & ~owed for a, owed in zip(watch.aim, watch.owed, strict=True))
    after = dataclasses.replace(
        watch,
        side=tuple(select(a, -s, s) for a, s in zip(watch.aim, watch.side, strict=True)),
        value=tuple(
            select(a, zero, stop_gradient(v)) for a, v in zip(settled, sight.value, strict=True)
        ),
        rate=sight.rate,
        away=tuple(far & ~a for far, a in zip(away, settled, strict=True)),
        owed=tuple(o & ~a for o, a in zip(watch.owed, watch.aim, strict=True)),
        start=stop_gradient(watch.length),
        seeking=jnp.zeros_like(watch.seeking),
        counts=tuple(
            c + one.astype(jnp.int32) for c, one in zip(watch.counts, counted, strict=True)
        ),
        total=watch.total + recorded.astype(jnp.int32),
    )
    return recorded, after


def _result(
    watched: WatchedSections,
    result: RESULTS,
    aim: Components,
    counts: Components,
    recorded: Array,
) -> RESULTS:
    """What a crossing makes of the run."""
    each = zip(aim, counts, watched.terminal, watched.bounds, strict=True)
    for aimed, count, last, bound in each:
        if last is not None:
            outcome = RESULTS.out_of_bounds if bound else RESULTS.section_reached
            result = RESULTS.where(recorded & aimed & (count >= last), outcome, result)
    return result


def _moved_on(problem: Problem, watch: Watch, sight: Sight, jumped: Array) -> Watch:
    """The watch of a lane that has gone on to where the sections are seen so; `jumped`: at once, by
    a reset or another mode."""
    away, _ = _told(problem, sight)
    value = tuple(stop_gradient(v) for v in sight.value)
    across = tuple(
        jumped & far & (s * v < 0) for far, s, v in zip(away, watch.side, value, strict=True)
    )
    owed = tuple(a & w for a, w in zip(across, _wanted(problem, watch.side), strict=True))
    side = tuple(
        select(far & ~due, jnp.sign(v), s)
        for far, due, v, s in zip(away, owed, value, watch.side, strict=True)
    )
    return dataclasses.replace(
        watch,
        side=side,
        value=value,
        rate=sight.rate,
        away=away,
        owed=owed,
        start=jnp.zeros_like(watch.start),
        seeking=jnp.zeros_like(watch.seeking),
        tries=jnp.zeros_like(watch.tries),
    )


def follow(
    problem: Problem,
    state: LoopState,
    after: LoopState,
    end: StepEnd,
    seen: Seen | None,
    went: Components,
) -> LoopState:
    """`after`, to which `state` has gone on, with its sections: `went` says whether it has moved to
    the end of the step, landed near it by the time δ, or switched there, and δ."""
    if seen is None:
        return after
    moved, lands, switched, delta = went
    system, watch = problem.system, state.watch
    assert watch is not None
    total, sight = watch.total, seen.sight
    corrected = tuple(
        select(lands, stop_gradient(v + delta * r), v)
        for v, r in zip(sight.value, sight.rate, strict=True)
    )
    sight = dataclasses.replace(sight, value=corrected)
    there = _moved_on(problem, watch, sight, switched)
    watch = _chosen(seen.seeks, seen.watch, _chosen(moved | lands, there, watch))
    result = RESULTS.where(seen.recorded & seen.seeks, seen.result, after.result)
    recorded = seen.recorded & seen.seeks
    table = after.crossings
    if table is not None:
        assert problem.watched is not None and problem.recording.num_crossings is not None
        size, unseen = problem.recording.num_crossings, problem.watched.unseen
        i = total if unseen is None else total - unseen
        t, x = problem.grid.t0 + seen.tau, pack(seen.x, system.dtype)
        entry = CrossingTable(ts=t, xs=x, sections=seen.number, modes=mode_codes(end.mode))
        table = entered(table, jnp.clip(i, 0, size - 1), recorded & (i >= 0) & (i < size), entry)
        full = recorded & (i >= size)
        result = RESULTS.where(full, RESULTS.max_events_reached, result)
    ends = recorded & (result != RESULTS.successful)
    return dataclasses.replace(
        after,
        tau=select(ends, seen.tau, after.tau),
        rest=select(ends, seen.rest, after.rest),
        x=where(ends, seen.x, after.x),
        f=where(ends, end.f, after.f),
        watch=watch,
        crossings=table,
        result=result,
    )
