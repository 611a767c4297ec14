"""The switch-model loop: one lane from a state to a later one, through every contact.

A `Problem` and an initial state enter; the `LoopState` at the end leaves, with what was kept on the
way. Batches come from `vmap`: every lane has its own clock in the one loop and waits for nobody.

An iteration takes one smooth step in the current mode and does one of four things with it:

    accept    it can be trusted, and meets nothing
    reject    it has run over a contact: the next one is cut there
    land      it has ended on a contact: one Newton correction in time, t += δ, x += δ f
    switch    after a landing, by a step of length zero: reset, and choose the mode at the
              corrected state

Nothing else is in the body, so that lanes which meet nothing pay for one step and some forty
operations around it, and a contact costs its lane two or three iterations more.

Derivatives. The lengths found by the search for contacts are constants; the Newton correction
x += δf, t += δ, δ = −g/ġ is not. Differentiating it, with the new mode's field taken at the
corrected state, is the saltation matrix. What it lacks to second order is added in the programs of
second derivatives alone (`second_order`).
"""

import dataclasses
import functools as ft
from collections.abc import Callable

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.guards import rearm_guards
from jaxfil.integrate.contacts.locate import Contact, Landing, find_contact, land, missing_time
from jaxfil.integrate.contacts.switch import evaluate_step_end
from jaxfil.integrate.lane import clocks
from jaxfil.integrate.lane.forcing_phase import next_period
from jaxfil.integrate.lane.problem import Problem, TimeGrid
from jaxfil.integrate.lane.recording import keep_sample, record_event, save_state
from jaxfil.integrate.lane.state import FreeStep, LoopState, StepEnd, is_running, later
from jaxfil.integrate.lane.step_length import Length, choose_length
from jaxfil.integrate.loop import section_search
from jaxfil.integrate.loop.start import initial_state
from jaxfil.integrate.steppers.error_estimate import Step, is_too_long
from jaxfil.integrate.steppers.explicit import Trial, compact_step, step
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.surfaces.unilateral import rests_of, sides_of
from jaxfil.integrate.system.components import Components, Forcing, all_finite, any_of, where
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select, select_all

# This many contacts in a row, each at the time of the last, are an accumulation: more than surfaces
# that are met together, one after the other, need to settle.
_FROZEN = 12
# Resets of surfaces that are met together follow one another at one time, so many at most: three
# balls on each other come to rest in some hundreds, each of which takes a few percent.
_CHAIN = 4096
# What an iteration does with its trial step.
_IDLE, _REJECT, _ACCEPT, _LAND, _TOUCH, _SWITCH, _SEEK, _FAIL = map(float, range(8))
# What can go wrong in it, in the order in which it is told.
_FAILURES = (
    RESULTS.nonfinite,
    RESULTS.max_events_reached,
    RESULTS.nonunique,
    RESULTS.undeclared_sliding,
    RESULTS.irreversible_reset,
    RESULTS.reset_undecided,
    RESULTS.mode_undecided,
    RESULTS.zeno,
    RESULTS.step_too_long,
)
# Trial steps rejected in a row before the search for a contact is given up: halving alone takes an
# interval to eps in 53.
_TRIES = 60
# A cut of a step is no shorter than this part of the rounding of times: one of length zero would
# say that no contact is expected.
_LEAST_CUT = 1e-6


class _Judgement(eqx.Module):
    """What is known of a trial step when it is decided what to do with it."""

    end: StepEnd
    contact: Contact
    landing: Landing
    too_long: Array
    tries: Array
    frozen: Array


def advance(problem: Problem, state: LoopState) -> LoopState:
    """One iteration. A lane that has come to its end stays as it is."""
    problem = clocks.between_ticks(problem, state.ticks)
    length = choose_length(problem, state)
    t, times = problem.grid.t0 + state.tau, problem.tableau.times
    forcing = problem.system.forcing(t, length.h, times)
    trial = trial_step(problem, state, length, forcing)
    if problem.system.m == 0:
        return _accept_smooth(problem, state, length, trial)
    return judge(problem, state, length, trial)


def trial_step(problem: Problem, state: LoopState, length: Length, forcing: list[Forcing]) -> Trial:
    """A trial step in the lane's mode."""
    system, t = problem.system, problem.grid.t0 + state.tau

    def tried(take: Callable, held: bool) -> Trial:
        field = ModeField(system, state.mode, held=held)
        return take(problem.tableau, field, t, state.x, state.f, length.h, forcing)

    grade = compact_step if problem.compact else step
    if not system.resets:
        return tried(grade, held=False)
    # Reactions make a field large, and lanes that rest are few.
    held, free = ft.partial(tried, compact_step, True), ft.partial(tried, grade, False)
    return system.where_any(any_of(rests_of(state.mode)), held, free)


def judge(
    problem: Problem,
    state: LoopState,
    length: Length,
    trial: Trial,
    free: FreeStep | None = None,
) -> LoopState:
    """The lane after a trial step: accepted, rejected, landed or switched. `free` is as in
    `evaluate_step_end`."""
    x = where(state.pending, state.x, trial.x)
    end = evaluate_step_end(problem, state, length, x, trial.forcing[-1], free)
    contact = find_contact(problem, state, end, length)
    # A flight this short cannot be told from the correction that ends it.
    again = abs(end.tau - state.contact_tau) <= 4 * problem.grid.same_time(end.tau)
    frozen = select(state.pending, select(again, state.frozen + 1, 0), state.frozen)
    judgement = _Judgement(
        end=end,
        contact=contact,
        landing=land(problem, state, end, length),
        too_long=_too_long(problem, state, length, trial, end),
        tries=select(contact.found, state.tries + 1, 0),
        frozen=frozen,
    )
    action, seen = _action(problem, state, judgement), None
    if problem.watched is not None:
        on = is_running(problem.grid, state)
        lands = (action == _LAND) | (action == _TOUCH)
        h = length.h + select(lands, judgement.landing.delta, 0.0)
        seen = section_search.look(problem, state, end, h, lands | (action == _ACCEPT))
        seen = dataclasses.replace(seen, seeks=on & seen.seeks)
        action = select(seen.seeks, _SEEK, action)
        action = select(on & ~all_finite(seen.sight.value), _FAIL, action)
    return _carried_out(problem, state, length, judgement, action, seen)


def _too_long(
    problem: Problem, state: LoopState, length: Length, trial: Trial, end: StepEnd
) -> Array:
    """Whether the error of a trial step says that it cannot be trusted."""
    t = problem.grid.t0 + state.tau
    taken = Step(t=t, h=length.h, x0=state.x, f0=state.f, f1=end.f, trial=trial)
    return is_too_long(problem.system, problem.tableau, taken, sides_of(state.mode))


def _action(problem: Problem, state: LoopState, judged: _Judgement) -> Array:
    """What to do with a trial step, or the number of the failure it has met, as one float: all that
    follows needs nothing else of what went into it."""
    system, end, found = problem.system, judged.end, judged.contact.found
    # Where a slide nears a singular point, the end of a long step says nothing of its contacts.
    landed, touched = judged.landing.landed & ~judged.contact.singular, judged.landing.touched
    if system.m > 1:
        # A step that has run over one surface is not taken because it ends on another.
        landed = landed & ~any_of(judged.contact.all & ~judged.landing.surfaces)
    action = select(found, _REJECT, _ACCEPT)
    action = select(landed, select(touched, _TOUCH, _LAND), action)
    action = select(state.pending, _SWITCH, action)
    failures = [~all_finite(end.x, end.f, end.g, judged.contact.theta)]
    most = problem.recording.max_events
    full = (
        jnp.zeros((), bool)
        if most is None
        else clocks.is_contact(state) & (state.num_events >= most)
    )
    failures.append(full)
    failures.append((end.num_modes > 1) & (~found | state.pending))
    slid = jnp.zeros((), bool) if system.slides else any_of(end.mode == 0)
    failures.append(slid)
    failures.append(end.moved & (problem.grid.direction < 0))
    failures.append((end.num_modes == 0) & end.moved)
    # A limit of turns at which no mode goes on is none.
    limit = jnp.zeros((), bool) if state.turn is None else state.turn.completed & state.pending
    failures.append(((end.num_modes == 0) & ~limit) | (judged.tries > _TRIES))
    chains = system.resets and system.m > 1
    frozen = judged.frozen >= (_CHAIN if chains else _FROZEN)
    failures.append(frozen | ((end.num_modes == 0) & limit))
    failures.append(judged.too_long & ~state.pending & (landed | ~found))
    for number, failed in reversed(list(enumerate(failures))):
        action = select(failed, _FAIL + number, action)
    action = select(is_running(problem.grid, state), action, _IDLE)
    return system.hold(action.astype(system.dtype))


def _outcome(action: Array, result: RESULTS) -> RESULTS:
    for number, outcome in enumerate(_FAILURES):
        result = RESULTS.where(action == _FAIL + number, outcome, result)
    return result


def _carried_out(
    problem: Problem,
    state: LoopState,
    length: Length,
    judged: _Judgement,
    action: Array,
    seen: section_search.Seen | None,
) -> LoopState:
    """The lane after what `action` says: accepted, rejected, landed or switched, or taken back to
    look for what is `seen` of its sections."""
    grid, end, landing = problem.grid, judged.end, judged.landing
    lands, rejected = (action == _LAND) | (action == _TOUCH), action == _REJECT
    accepted, switched = action == _ACCEPT, action == _SWITCH
    # A step to a saving time that is no grid point is looked at and taken back.
    saving, gridded = length.saving & accepted, length.gridded & accepted
    moved = (switched | accepted) & ~(saving & ~gridded)

    g, rate, armed, noise = rearm_guards(problem, state, end)
    landed_noise = where(action == _TOUCH, end.touch, end.noise)
    h = select(lands, length.h + landing.delta, select(moved, length.h, 0.0))
    pending, hit, settled = lands | (state.pending & ~moved), state.hit, state.settled
    if end.jump is not None and end.next is not None:
        h = h + select(switched, end.jump, 0.0)
        pending = pending | (switched & any_of(end.next))
        hit = where(switched, end.next, hit)
        settled = None if settled is None else switched & (end.jump > 0)
    tau, rest = later(state.tau, state.rest, h)
    ticking = None if length.ticking is None else length.ticking & accepted & moved
    exact = gridded | (lands & landing.jumped) | (ticking if ticking is not None else False)
    made = switched & clocks.is_contact(state)
    after = dataclasses.replace(
        state,
        tau=select(exact, end.tau, tau),
        rest=select(exact, 0.0, rest),
        x=where(moved, end.x, where(lands, landing.x, state.x)),
        size=where(moved, end.size, state.size),
        f=where(moved, end.f, state.f),
        mode=where(moved, end.mode, state.mode),
        g=where(moved, g, state.g),
        rate=where(moved, rate, where(lands, end.rate, state.rate)),
        determinant=select_all(moved, end.determinant, state.determinant),
        armed=where(moved, armed, state.armed),
        noise=where(lands, landed_noise, where(moved, noise, state.noise)),
        cut=_next_cut(grid, state, length, judged, rejected, accepted, moved),
        aim=where(rejected, judged.contact.surfaces, state.aim),
        pending=pending,
        hit=where(lands, landing.surfaces, hit),
        graze=select(lands, action == _TOUCH, state.graze),
        jumped=select(lands, landing.jumped, state.jumped & ~switched),
        settled=settled,
        turn=select_all(switched, end.turn, state.turn),
        index=state.index + gridded.astype(jnp.int32),
        tries=select(rejected, state.tries + 1, 0),
        frozen=select(switched, judged.frozen, state.frozen),
        contact_tau=select(switched, stop_gradient(end.tau), state.contact_tau),
        num_iterations=state.num_iterations + is_running(grid, state).astype(jnp.int32),
        num_accepted=state.num_accepted + (moved & accepted).astype(jnp.int32),
        num_events=state.num_events + made.astype(jnp.int32),
        result=_outcome(action, state.result),
        table=record_event(problem, state, end, made),
    )
    if ticking is not None:
        after = clocks.follow(problem, state, after, end, (ticking, switched))
    after = _keep(problem, state, after, end, moved, gridded, saving)
    after = next_period(grid, after)
    went = moved, lands, switched, landing.delta
    return section_search.follow(problem, state, after, end, seen, went)


def _next_cut(
    grid: TimeGrid,
    state: LoopState,
    length: Length,
    judged: _Judgement,
    rejected: Array,
    accepted: Array,
    moved: Array,
) -> Array:
    """The signed length to where a contact is expected after this trial step."""
    least = _LEAST_CUT * grid.same_time(state.tau) * grid.direction
    cut = judged.contact.theta * length.h
    cut = select(abs(cut) < abs(least), least, cut)
    # A step that has ended just short of its contact: Newton says how much is missing.
    missing = missing_time(grid, state, judged.end)
    ahead = select(length.cutting & accepted, missing, 0.0)
    return stop_gradient(select(rejected, cut, select(moved, ahead, state.cut)))


def _accept_smooth(problem: Problem, state: LoopState, length: Length, trial: Trial) -> LoopState:
    """The whole of an iteration where there are no surfaces."""
    end = evaluate_step_end(problem, state, length, trial.x, trial.forcing[-1])
    on = is_running(problem.grid, state)
    finite = all_finite(end.x, end.f)
    ok = finite & ~_too_long(problem, state, length, trial, end) & on
    seen = None
    if problem.watched is not None:
        seen = section_search.look(problem, state, end, length.h, ok)
        seen = dataclasses.replace(seen, seeks=seen.seeks & on)
        finite = finite & all_finite(seen.sight.value)
        ok = ok & ~seen.seeks & finite
    saving, gridded = length.saving & ok, length.gridded & ok
    moved, false = ok & ~(saving & ~gridded), jnp.zeros((), bool)
    fine = ok if seen is None else ok | seen.seeks
    failure = RESULTS.where(finite, RESULTS.step_too_long, RESULTS.nonfinite)
    ticks, x, f = clocks.tick(problem, state, end, length.ticking, moved)
    after = dataclasses.replace(
        state,
        tau=select(moved, end.tau, state.tau),
        x=where(moved, x, state.x),
        f=where(moved, f, state.f),
        ticks=ticks,
        size=where(moved, end.size, state.size),
        index=state.index + gridded.astype(jnp.int32),
        num_iterations=state.num_iterations + on.astype(jnp.int32),
        num_accepted=state.num_accepted + moved.astype(jnp.int32),
        result=RESULTS.where(fine | ~on, state.result, failure),
    )
    after = _keep(problem, state, after, end, moved, gridded, saving)
    after = next_period(problem.grid, after)
    went = moved, false, false, 0 * length.h
    return section_search.follow(problem, state, after, end, seen, went)


def _keep(
    problem: Problem,
    state: LoopState,
    after: LoopState,
    end: StepEnd,
    moved: Array,
    gridded: Array,
    saving: Array,
) -> LoopState:
    """`after` with the state at the end of the step saved, if that is to be kept."""
    save = problem.recording.save
    if save == "none":
        return after
    if save == "samples":
        return keep_sample(problem, state, after, end.x, gridded)
    return save_state(problem, state, after, end, moved if save == "steps" else saving)


def integrate(problem: Problem, x0: Components) -> LoopState:
    """Run the loop from x0 to the end of the grid, or to the first failure."""
    on = ft.partial(is_running, problem.grid)
    state = jax.lax.while_loop(
        lambda state: eqxi.unvmap_any(on(state)),
        ft.partial(advance, problem),
        initial_state(problem, x0),
    )
    return finish(problem.grid, state)


def integrate_with_checkpoints(
    problem: Problem, x0: Components, max_iterations: int, checkpoints: int | None
) -> LoopState:
    """`integrate`, for derivatives in reverse mode, in at most `max_iterations` iterations of which
    so many are kept: by default Equinox's own choice."""
    first = initial_state(problem, x0)
    records = [name for name in ("table", "saves", "crossings") if getattr(first, name) is not None]

    def buffers(state: LoopState) -> list:
        return [v for name in records for v in vars(getattr(state, name)).values()]

    state = eqxi.while_loop(
        ft.partial(is_running, problem.grid),
        ft.partial(advance, problem),
        first,
        kind="checkpointed",
        buffers=buffers,
        max_steps=max_iterations,
        checkpoints=checkpoints,
    )
    return finish(problem.grid, state)


def finish(grid: TimeGrid, state: LoopState) -> LoopState:
    """A lane that no longer runs, told why if it has not come to its end."""
    spent = (state.index < grid.num_steps) & (state.result == RESULTS.successful)
    result = RESULTS.where(spent, RESULTS.max_steps_reached, state.result)
    return dataclasses.replace(state, result=result)
