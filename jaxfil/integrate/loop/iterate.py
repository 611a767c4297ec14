"""The switch-model loop: one lane from a state to a later one, through every contact.

Batches come from `vmap`: every lane has its own clock in the one loop and does not wait for others.

An iteration takes one smooth step in the current mode, with one of these consequences, or a
failure that ends the lane (`judge`):

    accept      it can be trusted, and is without contact
    refuse      it cannot be trusted: the next one is half as long (`halving`)
    reject      it has passed a contact: the next one is cut there
    land        it has ended on a contact: one Newton correction in time, t += δ, x += δ f
    touch       the same at a graze, after which the mode is the same
    switch      after a landing, by a step of length zero: reset, and choose the mode at the
                corrected state
    take back   it stays at its start: an extension has found a crossing of a section within it, or
                surfaces must be decided together

Lanes without contact therefore pay for one step and some forty operations around it, and a contact
costs its lane two or three iterations more.

Derivatives. The lengths from the search for contacts are constants; the Newton correction
x += δf, t += δ, δ = −g/ġ is not. Differentiating it, with the new mode's field taken at the
corrected state, is the saltation matrix. The missing terms of second order are added only in the
programs of second derivatives (`second_order`).
"""

import dataclasses
import functools as ft

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.guards import rearmed
from jaxfil.integrate.contacts.locate import Landing
from jaxfil.integrate.lane.extension import Step, Verdict, extensions_of
from jaxfil.integrate.lane.forcing_phase import next_period
from jaxfil.integrate.lane.problem import Problem, TimeGrid
from jaxfil.integrate.lane.recording import record_event
from jaxfil.integrate.lane.state import (
    ContactSearch,
    Counts,
    FreeStep,
    LoopState,
    Pending,
    StepEnd,
    is_running,
    later,
    tables_of,
)
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.loop import judge as judging
from jaxfil.integrate.loop.halving import doubted, next_trust
from jaxfil.integrate.loop.judge import Judgement
from jaxfil.integrate.loop.start import initial_state
from jaxfil.integrate.loop.trial import Tried, end_of, try_step, try_step_in_reverse
from jaxfil.integrate.steppers.explicit import Trial
from jaxfil.integrate.system.components import Components, all_finite, any_of, maximum, where
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select, select_all
from jaxfil.xla.valid_derivative import only_if_valid


def problem_of_step(problem: Problem, state: LoopState) -> Problem:
    """The problem of the next iteration, with functions of time kept between two ticks."""
    for extension, own in extensions_of(problem, state):
        problem = extension.before_step(problem, own)
    return problem


def advance(problem: Problem, state: LoopState) -> LoopState:
    """One iteration. A lane that has ended is unchanged."""
    problem = problem_of_step(problem, state)
    if problem.system.transposed:
        tried, infinite = try_step_in_reverse(problem, state)
    else:
        tried, infinite = try_step(problem, state), None
    state = dataclasses.replace(state, search=tried.search)
    if problem.system.m == 0:
        return _go_on_smoothly(problem, state, tried, infinite)
    return _judge_tried(problem, state, tried, infinite)


def judge(
    problem: Problem,
    state: LoopState,
    length: Length,
    trial: Trial,
    free: FreeStep | None = None,
) -> LoopState:
    """The lane after a trial step: accepted, rejected, landed or switched. `free` is as in
    `evaluate_step_end`."""
    end = end_of(problem, state, length, trial, free)
    return _judge_tried(problem, state, Tried(state.search, length, trial, end))


def _judge_tried(
    problem: Problem, state: LoopState, tried: Tried, infinite: Array | None = None
) -> LoopState:
    """The lane after a trial step, which may be known to be `infinite`."""
    length, trial = tried.length, tried.trial
    judgement = judging.judged(problem, state, length, trial, tried.end, infinite)
    action = judging.action_of(problem, state, judgement)
    taken, action, verdicts = _heard(
        problem, state, length, tried.end, action, trial.path, judgement.landing
    )
    after = _carried_out(problem, state, judgement, taken, action)
    return _followed(problem, state, after, taken, verdicts)


def _go_on_smoothly(
    problem: Problem, state: LoopState, tried: Tried, infinite: Array | None
) -> LoopState:
    """The lane after a trial step in a system without surfaces."""
    length, trial, end, pending = tried.length, tried.trial, tried.end, state.pending
    if infinite is None:
        infinite = ~all_finite(end.motion.x, end.motion.f)
    doubt = doubted(problem, state, length, trial, end, infinite)
    action = judging.smooth_action_of(problem, state, end, doubt)
    taken, action, verdicts = _heard(problem, state, length, end, action, trial.path)
    if problem.tick is not None:
        pending = dataclasses.replace(pending, waits=pending.waits & ~taken.switched)
    counts = _counted(problem.grid, state, taken)
    after = dataclasses.replace(
        state,
        motion=select_all(taken.moved, end.motion, state.motion),
        trust=next_trust(problem, state, taken, action == judging.REFUSE, doubt),
        pending=pending,
        # Ticks are no contacts, and without surfaces there is no table of events.
        counts=dataclasses.replace(counts, num_events=state.counts.num_events),
        result=judging.outcome(action, state.result),
    )
    return _followed(problem, state, after, taken, verdicts)


def _heard(
    problem: Problem,
    state: LoopState,
    length: Length,
    end: StepEnd,
    action: Array,
    path: Polynomial | None,
    landing: Landing | None = None,
) -> tuple[Step, Array, list[Verdict | None]]:
    """The decision about a trial step, after the verdicts of the extensions."""
    intended, verdicts = judging.step_of(state, length, end, action, landing, path), []
    before, on = action, is_running(problem.grid, state)
    for extension, own in extensions_of(problem, state):
        verdict = extension.at_end(problem, state, own, intended)
        verdicts.append(verdict)
        if verdict is not None:
            # A lane that has ended stays idle, whatever an extension detects at its state.
            action = select(on & verdict.takes_back, judging.TAKE_BACK, action)
            action = judging.failing(action, [(r, on & v) for r, v in verdict.failures])
    # Without verdicts the action is the same object, and the step need not be decided twice.
    if action is before:
        return intended, action, verdicts
    return judging.step_of(state, length, end, action, landing, path), action, verdicts


def _carried_out(
    problem: Problem, state: LoopState, judgement: Judgement, taken: Step, action: Array
) -> LoopState:
    """The lane after the action: accepted, rejected, landed, switched or taken back."""
    grid, end, landing, before = problem.grid, judgement.end, judgement.landing, state.pending
    length, lands, moved, switched = taken.length, taken.lands, taken.moved, taken.switched
    touches, rejected = action == judging.TOUCH, action == judging.REJECT
    start, armed = rearmed(problem, state, end)
    h = select(lands, length.h + landing.delta, select(moved, length.h, 0.0))
    waits, surfaces, settled = lands | (before.waits & ~moved), before.surfaces, state.settled
    jumped, across = before.jumped & ~switched, before.across & ~switched
    if end.next is not None:
        more = switched & any_of(end.next)
        waits, surfaces = waits | more, where(switched, end.next, surfaces)
        # The flag of a jump stays set until all switches that follow from it are done. A surface
        # that a reset has moved the state off is left, also after a chattering, but not where turns
        # have led to it.
        left = more if end.turn is None else more & ~end.turn.completed
        across = across | (left & end.off)
        if end.jump is not None:  # time has passed, at the end of chattering or of turns
            more = more & ~(end.jump > 0)
        jumped = jumped | (more & (before.jumped | end.moved))
    if end.jump is not None:
        h = h + select(switched, end.jump, 0.0)
        # The switch at a limit of chattering or of turns applies no reset, and only chooses a mode.
        settled = None if settled is None else switched & (end.jump > 0)
    if end.again is not None:
        # The next switch has no contact of its own. As after a jump, it decides all surfaces.
        waits = waits | (switched & end.again)
        surfaces = surfaces & ~(switched & end.again)
        jumped, across = jumped | (switched & end.again), across | (switched & end.again & end.off)
    planned, plan = before.planned, before.plan
    if planned is not None:
        planned = planned & ~switched
        if end.plan is not None and end.planned is not None:
            planned = planned | (switched & end.planned)
            plan = where(switched, end.plan, plan)
    together = before.together
    if together is not None and end.misfit is not None:
        # A switch that is a misfit is taken back, and repeated with its surfaces decided together.
        together = (together | (before.waits & end.misfit)) & ~switched
    tau, tau_low = later(state.motion.tau, state.tau_low, h)
    # The end of a step that is not a contact is a known time, and needs no low-order part.
    exact = (taken.accepted & moved & length.known) | (lands & landing.jumped)
    motion = select_all(moved, start, state.motion)
    # A graze is within the accumulated rounding, which its guard must exceed to be armed again.
    noise = where(touches, end.gathered, end.motion.noise)
    noise = maximum(noise, where(state.armed, 0.0, state.motion.noise))
    # The switch needs the rate at the contact, by which it distinguishes a jump of H from rounding.
    at_landing = landing.x, end.motion.rate, noise
    x, rate, noise = select_all(lands, at_landing, (motion.x, motion.rate, motion.noise))
    tau = select(exact, end.motion.tau, tau)
    return dataclasses.replace(
        state,
        motion=dataclasses.replace(motion, tau=tau, x=x, rate=rate, noise=noise),
        tau_low=select(exact, 0.0, tau_low),
        armed=where(moved, armed, state.armed),
        search=ContactSearch(
            length=judging.next_search_length(problem, state, judgement, taken, action),
            surfaces=where(rejected, judgement.contact.surfaces, state.search.surfaces),
            rejections=select(rejected, state.search.rejections + 1, 0),
        ),
        trust=next_trust(problem, state, taken, action == judging.REFUSE, judgement.doubt),
        pending=Pending(
            waits=waits,
            surfaces=where(lands, landing.surfaces, surfaces),
            grazes=select(lands, touches, before.grazes),
            jumped=select(lands, landing.jumped, jumped),
            across=where(lands, landing.jumped, across),
            together=together,
            planned=planned,
            plan=plan,
            repeats=select(switched, judgement.repeats, before.repeats),
            tau=select(switched, stop_gradient(end.motion.tau), before.tau),
        ),
        counts=_counted(grid, state, taken),
        result=judging.outcome(action, state.result),
        table=record_event(problem, state, end, taken.made),
        settled=settled,
        turn=select_all(switched, end.turn, state.turn),
    )


def _counted(grid: TimeGrid, state: LoopState, taken: Step) -> Counts:
    counts = state.counts

    def one(flag: Array) -> Array:
        return flag.astype(jnp.int32)

    ticks, end = counts.num_ticks, taken.end
    if ticks is not None and end.ticked is not None:
        ticks = ticks + one(taken.made & end.ticked & ~any_of(end.members))
    return dataclasses.replace(
        counts,
        index=counts.index + one(taken.gridded),
        # The loop goes on for other lanes after this one has ended.
        num_iterations=counts.num_iterations + one(is_running(grid, state)),
        # A step of length zero, from a tick to a state saved at its time, does not count.
        num_accepted=counts.num_accepted
        + one(taken.moved & taken.accepted & (taken.length.h != 0)),
        num_events=counts.num_events + one(taken.made),
        num_ticks=ticks,
    )


def _followed(
    problem: Problem,
    state: LoopState,
    after: LoopState,
    taken: Step,
    verdicts: list[Verdict | None],
) -> LoopState:
    """`after`, with the step's states saved, and the extensions' states updated."""
    after, following = problem.recording.recorder.record(problem, state, after, taken), []
    each = zip(problem.extensions, state.extensions, verdicts, strict=True)
    for extension, own, verdict in each:
        after, following_own = extension.after_step(problem, state, after, own, taken, verdict)
        following.append(following_own)
        # Later extensions see what earlier ones have found.
        own_states = *following, *state.extensions[len(following) :]
        after = dataclasses.replace(after, extensions=own_states)
    # Elapsed times restart last, since extensions take differences of the times before and after.
    return next_period(problem.grid, after)


def integrate(problem: Problem, x0: Components) -> LoopState:
    """The lane at the end of the grid, or at the first failure, from the initial state x0."""
    on = ft.partial(is_running, problem.grid)
    state = jax.lax.while_loop(
        # One flag for all lanes. With a flag for each, JAX would add a selection of every number of
        # the state to each iteration, although `advance` does not change lanes that have ended.
        lambda state: eqxi.unvmap_any(on(state)),
        ft.partial(advance, problem),
        initial_state(problem, x0),
    )
    return finish(problem.grid, state)


def integrate_with_checkpoints(
    problem: Problem, x0: Components, max_iterations: int, checkpoints: int | None
) -> LoopState:
    """`integrate` for reverse-mode derivatives, with at most `max_iterations` iterations, of which
    `checkpoints` are stored; None leaves the number to equinox."""
    first = only_if_valid(_valid_start, problem, x0)

    # Buffers are written in place. Of tables that are plain arrays, reverse mode would store a copy
    # for every step.
    def buffers(state: LoopState) -> list:
        return [v for table in tables_of(state) for v in vars(table).values()]

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


def _valid_start(problem: Problem, x0: Components) -> tuple[Array, LoopState]:
    """Whether a lane has finite numbers at t0, and the lane."""
    state = initial_state(problem, x0)
    return state.result != RESULTS.nonfinite, state


def finish(grid: TimeGrid, state: LoopState) -> LoopState:
    """A lane that has stopped, with an outcome if it has not reached the end."""
    # A lane that stops before its last step without a failure has used up its iterations.
    spent = (state.counts.index < grid.num_steps) & (state.result == RESULTS.successful)
    result = RESULTS.where(spent, RESULTS.max_steps_reached, state.result)
    return dataclasses.replace(state, result=result)
