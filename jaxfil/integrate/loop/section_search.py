"""Crossings of sections: located in steps that the loop has accepted, and recorded.

If a section is crossed in a trial step that the loop would accept, the step is taken back, and the
next trial steps search for the crossing:

    S0 ╲           ┼           ┼          1. a full step, crossed: taken back
        ╲__ ℓ      h                      2. a step to ℓ, from Hermite's cubic: Newton, step again
    ───────╲┼──────┼─── 0                 3. close enough: t = t0 + τ + ℓ + δ, x + δ f, δ = −S/Ṡ
             ╲_____╲                      4. the full step again, watched from ℓ on

Sections do not change the loop's own steps, bit for bit, except that a tolerance refuses steps too
long for the cubics (`error_of_sections`). Each lane searches independently, so that
a batch pays for a crossing as much as its lane. The state at a crossing is computed by a step of
the method, without interpolation. Since the lengths ℓ are constants and δ is not, it has the exact
derivative.

Values of S within rounding are ignored: a section counts as crossed when S has been beyond its
rounding on both sides. A section that is zero where a piece of the motion begins, as at a contact
with a surface that it coincides with, is crossed there if S continues to the other side, and only
there. A crossing at t1 belongs to the run, as a contact does, and not to one that starts there.

Of several maps at one time, as in an avalanche of resets, each may carry S across zero, and each of
these crossings is recorded before the next map is applied. A section that depends on the mode jumps
once, from the mode before all maps to the one after them.
"""

import dataclasses

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import NEVER, stays_off, stays_within
from jaxfil.integrate.lane.extension import Extension, Step, Verdict
from jaxfil.integrate.lane.problem import Look, Problem
from jaxfil.integrate.lane.recording import entered, mode_codes
from jaxfil.integrate.lane.state import CrossingTable, LoopState, Motion, is_running, later
from jaxfil.integrate.lane.step_length import typical_step
from jaxfil.integrate.loop.section_cubic import (
    error_of_sections,
    first_of_one,
    is_unresolved,
    is_wanted,
    nothing,
    resolved,
    sides_from,
)
from jaxfil.integrate.loop.section_state import (
    SectionState,
    Seen,
    Watch,
    empty_crossings,
    unwatched,
)
from jaxfil.integrate.loop.section_updates import after_crossing, after_minimum, after_step, in_half
from jaxfil.integrate.surfaces.sections import Sight, WatchedSections, beyond_newton, see
from jaxfil.integrate.system.components import (
    Components,
    all_finite,
    any_of,
    first_set,
    least,
    on_each,
    pack,
    total,
    where,
)
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.second_derivative import add_second_derivative
from jaxfil.xla.select import select, select_all

# Number of Newton steps before the search continues by bisection, and of trial steps in total.
_NEWTON, _TRIES = 12, 60


class SectionSearch(Extension):
    """The search for crossings of sections."""

    watched: WatchedSections

    def before_step(self, problem: Problem, own: SectionState | None) -> Problem:
        if own is None:
            return problem
        # A problem has one probe at a time; a second search would have to wait for the first.
        assert problem.look is None
        return dataclasses.replace(problem, look=Look(own.watch.seeking, own.watch.length))

    def begin(self, problem: Problem, state: LoopState) -> tuple[LoopState, SectionState]:
        return _begin(self.watched, problem, state)

    def error(
        self,
        problem: Problem,
        state: LoopState,
        own: SectionState,
        h: Array,
        end: Motion,
        path: Polynomial | None,
    ) -> Array:
        return error_of_sections(self.watched, problem, state, own.watch, h, end, path)

    def at_end(self, problem: Problem, state: LoopState, own: SectionState, step: Step) -> Verdict:
        passes, delta = step.lands | step.accepted, select(step.lands, step.delta, 0.0)
        end, between = step.end.motion, step.end.between
        if between is not None:
            # Crossings by the last map are recorded where that map has led.
            owes = state.pending.waits & any_of(own.watch.owed)
            passes, end = passes | owes, select_all(owes, state.motion, end)
        last = step.gridded & (state.counts.index + 1 >= problem.grid.num_steps)
        ahead = select(last, typical_step(problem, state), 0.0)
        would = step.length.h + delta, delta, passes, ahead * problem.grid.direction
        seen = _look(self.watched, problem, state, own.watch, end, would, step.path)
        seen = dataclasses.replace(seen, seeks=seen.seeks & is_running(problem.grid, state))
        # A trial step that is rejected or refused is not a part of the motion.
        judged = own.watch.seeking | step.moved | step.lands
        infinite = ~on_each(jnp.isfinite, seen.sight.value)
        if between is not None:
            infinite = infinite & ~(between & Components(self.watched.need_mode))
        failure = RESULTS.nonfinite, judged & any_of(infinite)
        return Verdict(seen.seeks, (failure,), seen)

    def after_step(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: SectionState,
        step: Step,
        verdict: Verdict | None,
    ) -> tuple[LoopState, SectionState]:
        assert verdict is not None
        return _follow(self.watched, problem, after, own, step, verdict.note)


def _begin(
    watched: WatchedSections, problem: Problem, state: LoopState
) -> tuple[LoopState, SectionState]:
    """A lane at t0, watched from there on."""
    motion = state.motion
    false = jnp.zeros((), bool)
    watch = unwatched(watched.bounds, jnp.zeros_like(motion.tau))
    at = problem.grid.t0 + motion.tau, motion.x
    dt = typical_step(problem, state)
    sight = see(watched, problem.system, at, (motion.mode, motion.f), motion.scale, dt)
    watch = after_step(watched, problem, watch, sight, false, None)
    result, (_, noises) = state.result, resolved(problem, sight)
    for bound, value, noise in zip(watched.bounds, sight.value.parts, noises.parts, strict=True):
        outside = bound & (value < -noise) & (result == RESULTS.successful)
        result = RESULTS.where(outside, RESULTS.out_of_bounds, result)
    table = empty_crossings(problem.system, problem.recording.num_crossings)
    return dataclasses.replace(state, result=result), SectionState(watch, table)


def _look(
    watched: WatchedSections,
    problem: Problem,
    state: LoopState,
    watch: Watch,
    end: Motion,
    would: tuple[Array, Array, Array, Array],
    path: Polynomial | None,
) -> Seen:
    """The sections at the end of a trial step, on a path if it is known. `would` has the length of
    the step including the correction of its landing, this correction, whether the loop would accept
    the step, and the time by which the motion is followed further (`_find`)."""
    h, correction, passes, ahead = would
    at = problem.grid.t0 + end.tau, end.x
    dt = typical_step(problem, state)
    sight = see(watched, problem.system, at, (end.mode, end.f), end.scale, dt)
    # At a landing S is evaluated at the corrected time, so that a section that coincides with the
    # surface is zero there.
    correction = select(watch.seeking, 0.0, correction)
    landed = sight.value + stop_gradient(correction * sight.rate)
    sight = dataclasses.replace(sight, value=landed)
    here = select(watch.seeking, watch.length, h)
    looks = watch.seeking & ~any_of(watch.aim)
    # The next watch is one of four: a search that starts, one that comes closer, one that has
    # located its crossing, or one that has examined a minimum.
    found, begun = _begun(watched, problem, watch, sight, (here, ahead))
    if path is not None:
        doubt = is_unresolved(watched, problem, (state.motion, end), (watch, sight), here, path)
        found, begun = found | doubt, select_all(doubt, in_half(begun, watch.start), begun)
    # A search for a known crossing is completed first; the look at a minimum may make one known.
    begins = found & (looks | (passes & ~watch.seeking))
    closer, delta, done = _approach(problem, state, watch, sight, end.tau)
    located = watch.aim & ~watch.owed
    linear, given = (delta, end.x + delta * end.f), (watched, problem.system)
    delta, x = add_second_derivative(beyond_newton, linear, *given, at, end.mode, located)
    tau, tau_low = later(state.motion.tau, state.tau_low, watch.length + delta)
    counts = True if watched.since is None else problem.grid.t0 + tau >= watched.since
    recorded, behind = after_crossing(watched, problem, closer, sight, (done, counts))
    sought = select_all(done, behind, closer)
    sought = select_all(looks, after_minimum(problem, watch, sight), sought)
    finite = all_finite(end.x, sight.value, sight.rate)
    return Seen(
        sight=sight,
        mode=end.mode,
        seeks=(begins | watch.seeking) & finite,
        watch=select_all(begins, begun, sought),
        recorded=recorded & finite,
        number=total(Components(range(len(watch.aim.parts))) * watch.aim.astype(jnp.int32)),
        tau=tau,
        tau_low=tau_low,
        x=x,
    )


def _begun(
    watched: WatchedSections,
    problem: Problem,
    watch: Watch,
    sight: Sight,
    up_to: tuple[Array, Array],
) -> tuple[Array, Watch]:
    """Whether there is a crossing or a minimum of |S| to examine, and the watch of a lane that
    starts to search for it. `up_to` is as in `_find`."""
    found, length, aim = _find(watched, problem, watch, sight, up_to)
    begun = dataclasses.replace(
        watch,
        seeking=jnp.ones_like(found),
        length=length,
        aim=aim,
        low=select(length * problem.grid.direction > 0, watch.start, 0.0),
        high=stop_gradient(up_to[0]),
        tries=jnp.zeros_like(watch.tries),
    )
    return found, begun


def _find(
    watched: WatchedSections,
    problem: Problem,
    watch: Watch,
    sight: Sight,
    up_to: tuple[Array, Array],
) -> tuple[Array, Array, Components]:
    """Whether there is a crossing or a minimum to examine between the start of the watch and a
    length, at which length, and the section crossed there. `up_to` has the length, and at the end
    of the run a time by which the motion is followed further; 0 before."""
    h, ahead = stop_gradient(up_to[0]) - watch.start, up_to[1]
    sides, (_, noises) = sides_from(problem, watch, sight, h), resolved(problem, sight)
    wanted = is_wanted(watched, problem, sides)
    start = where(watch.away, sides * watch.value, 0.0)
    end = sides * stop_gradient(sight.value)
    ends = start, sides * h * watch.rate, end, sides * h * sight.rate
    near = ~(watch.away & on_each(stays_off, *ends, noises)) & (sides != 0)
    # A section that stays within its rounding, as along a slide or a rest, is not crossed.
    near = near & ~on_each(stays_within, *ends, noises)
    # A run that ends on a section crosses it if the motion goes on to its other side.
    over = (abs(end) <= noises) & (sides * ahead * sight.rate < -noises)
    near, ends = near | over, (*ends[:2], where(over, -2 * noises, end), ends[3])
    thetas, lows = [], []
    for each in zip(*(v.parts for v in (near, *ends, watch.away, noises, wanted)), strict=True):
        theta, low = problem.system.where_any(each[0], first_of_one, nothing, *each[1:])
        thetas.append(theta)
        lows.append(low)
    thetas = where(near, where(watch.owed, 0.0, Components(thetas)), NEVER)
    first, lowest = least(thetas), least(where(near, Components(lows), NEVER))
    # Minima are examined one at a time, and only before the first known crossing.
    lowest = select(watch.seeking, NEVER, lowest)
    crossed = (first < NEVER) & (first <= lowest)
    theta = jnp.minimum(first, lowest)
    aim = first_set(crossed & (thetas <= first))
    return theta < NEVER, watch.start + theta * h, aim


def _approach(
    problem: Problem, state: LoopState, watch: Watch, sight: Sight, tau: Array
) -> tuple[Watch, Array, Array]:
    """The search after a trial step to the expected place of a crossing: the next watch, Newton's
    step in time from here, and whether the search is complete."""
    grid, small = problem.grid, problem.system.eps ** (2 / 3)
    known = small * typical_step(problem, state)
    sides = sides_from(problem, watch, sight, watch.length - watch.start)
    of_aim = (
        sides * sight.value,
        sides * sight.rate,
        sides * watch.rate,
        resolved(problem, sight)[1],
    )
    g, rate, rate0, noise = (total(where(watch.aim, v, 0.0)) for v in of_aim)
    owed = any_of(watch.aim & watch.owed)
    falls = grid.direction * rate < 0
    delta = select(falls, -g / select(falls, rate, 1.0), 0.0)
    at, size = watch.length, abs(stop_gradient(delta))
    g = stop_gradient(g)
    # A bracket of lengths around the crossing, by the sign of S.
    low, high = select(g > 0, at, watch.low), select(g < 0, at, watch.high)
    newton = at + stop_gradient(delta)
    inside = ((newton - low) * grid.direction >= 0) & ((high - newton) * grid.direction >= 0)
    # Newton's error is of order δ² S̈/Ṡ, bounded as for contacts in `locate.land`.
    bend = size * abs(rate - rate0) <= small * abs(rate * (at - watch.start))
    close = falls & inside & (size <= known) & bend
    narrow = abs(high - low) <= problem.same_time(tau)
    done = close | (abs(g) <= noise) | narrow | owed | (watch.tries >= _TRIES)
    halved = ~inside | (watch.tries >= _NEWTON)
    length = select(halved, 0.5 * (low + high), newton)
    closer = dataclasses.replace(
        watch, side=sides, length=length, low=low, high=high, tries=watch.tries + 1
    )
    # Where S only touches zero, its rate does not determine the time.
    timed = (inside | (size <= known)) & ~owed
    # By rounding Newton may lead to before the step, where a run that goes on from the crossing
    # would have the contact or the tick at the start of the step again.
    early = stop_gradient(at + delta) * grid.direction < 0
    delta = select(early, delta - stop_gradient(at + delta), delta)
    return closer, select(timed, delta, 0.0), done & watch.seeking & any_of(watch.aim)


def _follow(
    watched: WatchedSections,
    problem: Problem,
    after: LoopState,
    own: SectionState,
    step: Step,
    seen: Seen,
) -> tuple[LoopState, SectionState]:
    """The lane and its sections after a step."""
    sight, watch, end = seen.sight, own.watch, step.end.motion
    there = after_step(watched, problem, watch, sight, step.switched, step.between)
    watch = select_all(step.moved | step.lands, there, watch)
    watch = select_all(seen.seeks, seen.watch, watch)
    recorded, table = seen.recorded & seen.seeks, own.table
    # A run that ends at a crossing has all maps at that time, and its state is the one after them.
    ended = (recorded | step.switched) & ~after.pending.waits
    ended = ended & (after.result == RESULTS.successful)
    if problem.tick is not None:
        tau = select(recorded, seen.tau, after.motion.tau)
        ended = ended & ~(problem.ticks_at(tau) & (problem.grid.direction > 0))
    result = watched.outcome(after.result, watch.counts, ended)
    if table is not None:
        size, i = table.ts.shape[0], own.watch.total
        i = i if watched.unseen is None else i - watched.unseen
        t, x = problem.grid.t0 + seen.tau, pack(seen.x, problem.system.dtype)
        entry = CrossingTable(ts=t, xs=x, sections=seen.number, modes=mode_codes(seen.mode))
        table = entered(table, jnp.clip(i, 0, size - 1), recorded & (i >= 0) & (i < size), entry)
        result = RESULTS.where(recorded & (i >= size), RESULTS.max_events_reached, result)
    ends, motion = recorded & (result != RESULTS.successful), after.motion
    here = seen.tau, seen.tau_low, seen.x, end.f
    tau, tau_low, x, f = select_all(ends, here, (motion.tau, after.tau_low, motion.x, motion.f))
    motion = dataclasses.replace(motion, tau=tau, x=x, f=f)
    after = dataclasses.replace(after, motion=motion, tau_low=tau_low, result=result)
    return after, SectionState(watch, table)
