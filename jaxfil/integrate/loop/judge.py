"""The judgement of a trial step: what an iteration does with it, as one number.

Accept, reject, land and switch are explained in `iterate`; a landing may be a touch, a lane that
has ended is idle, and extensions may take a step back. The decision is one float, so that it is
computed once (`ComponentSystem.hold`) and not again by everything that asks for it.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.locate import Contact, Landing, find_contact, land, missing_time
from jaxfil.integrate.lane.extension import Step
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, StepEnd, is_running
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.loop.halving import Doubt, doubted
from jaxfil.integrate.steppers.explicit import Trial
from jaxfil.integrate.system.components import all_finite, any_of
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select

# This many contacts in a row, each at the time of the last, are an accumulation: more than surfaces
# that are met together, one after the other, need to settle.
_FROZEN = 12
# Resets of surfaces that are met together follow one another at one time, so many at most: three
# balls on each other come to rest in some hundreds, each of which takes a few percent.
_CHAIN = 4096
# A flight that has led no further from its surface than this multiple of rounding: one that is four
# times as high as rounding, which has hidden its start and its end.
_LOW = 16
# What an iteration does with its trial step.
IDLE, REJECT, ACCEPT, LAND, TOUCH, SWITCH, TAKE_BACK, REFUSE, FAIL = map(float, range(9))
# What can go wrong in it, in the order in which it is told.
FAILURES = (
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


class Judgement(eqx.Module):
    """What is known of a trial step when it is decided what to do with it."""

    end: StepEnd
    contact: Contact
    landing: Landing
    doubt: Doubt
    rejections: Array
    """Trial steps rejected in a row, if this one is."""
    repeats: Array
    """Contacts in a row at one and the same time, with the one that a switch is made of here."""
    hidden: Array
    """Whether rounding hides that there was a flight between the last two of these."""


def judged(
    problem: Problem, state: LoopState, length: Length, trial: Trial, end: StepEnd
) -> Judgement:
    """What is known of a trial step."""
    contact = find_contact(problem, state, end, length, trial.searched)
    waits = state.pending.waits
    motion = end.motion
    infinite = ~all_finite(motion.x, motion.f, motion.g, contact.theta)
    # A flight this short cannot be told from the correction that ends it.
    tau, repeats = end.motion.tau, state.pending.repeats
    flight = abs(tau - state.pending.tau)
    again, hidden = flight <= 4 * problem.grid.same_time(tau), jnp.zeros((), bool)
    if problem.system.resets and problem.system.m > 1:
        # Nor one that leads no further from its surface than rounding.
        low = flight * abs(state.motion.rate) <= _LOW * state.motion.noise
        hidden = ~again & ~any_of(state.pending.surfaces & ~low)
        again = again | hidden
    return Judgement(
        end=end,
        contact=contact,
        landing=land(problem, state, end, length),
        doubt=doubted(problem, state, length, trial, end, infinite),
        rejections=select(contact.found, state.search.rejections + 1, 0),
        repeats=select(waits, select(again, repeats + 1, 0), repeats),
        hidden=hidden,
    )


def action_of(problem: Problem, state: LoopState, judgement: Judgement) -> Array:
    """What to do with a trial step, or `FAIL` and the number of the failure it has met."""
    contact, landing = judgement.contact, judgement.landing
    # Where a slide nears a singular point, the end of a long step says nothing of its contacts.
    landed = landing.landed & ~contact.singular
    if problem.system.m > 1:
        # A step that has run over one surface is not taken because it ends on another.
        landed = landed & ~any_of(contact.all & ~landing.surfaces)
    action = select(contact.found, REJECT, ACCEPT)
    action = select(landed, select(landing.touched, TOUCH, LAND), action)
    action = select(state.pending.waits, SWITCH, action)
    misfit = judgement.end.misfit
    failures = _failures(problem, state, judgement, landed)
    # The first one counts.
    for failure, failed in reversed(failures):
        action = select(failed, FAIL + FAILURES.index(failure), action)
    # Of one that cannot be trusted it is not known where it has run over a contact, or whether.
    action = select(judgement.doubt.refuses & ~state.pending.waits, REFUSE, action)
    if misfit is not None:
        action = select(misfit, TAKE_BACK, action)
    action = select(is_running(problem.grid, state), action, IDLE)
    return problem.system.hold(action.astype(problem.system.dtype))


def _failures(
    problem: Problem, state: LoopState, judgement: Judgement, landed: Array
) -> list[tuple[RESULTS, Array]]:
    """Each of `FAILURES`, and whether a trial step has met it."""
    system, end, waits = problem.system, judgement.end, state.pending.waits
    motion, found, no = end.motion, judgement.contact.found, jnp.zeros((), bool)
    most, undecided = problem.recording.max_events, end.num_modes == 0
    # A limit of turns at which no mode goes on is none.
    limit = no if state.turn is None else state.turn.completed & waits
    chain = _CHAIN if system.resets and system.m > 1 else _FROZEN + 2 * system.m
    full = no if most is None else _is_event(state, end) & (state.counts.num_events >= most)
    # Contacts that fill the table with flights that rounding hides are an accumulation.
    many = full & judgement.hidden & (judgement.repeats >= _FROZEN)
    lost = (undecided & ~limit) | (judgement.rejections > _TRIES)
    return [
        (RESULTS.nonfinite, judgement.doubt.infinite),
        (RESULTS.max_events_reached, full & ~many),
        (RESULTS.nonunique, (end.num_modes > 1) & (~found | waits)),
        (RESULTS.undeclared_sliding, no if system.slides else any_of(motion.mode == 0)),
        (RESULTS.irreversible_reset, end.moved & (problem.grid.direction < 0)),
        (RESULTS.reset_undecided, undecided & end.moved),
        (RESULTS.mode_undecided, lost),
        (RESULTS.zeno, (judgement.repeats >= chain) | many | (undecided & limit)),
        (RESULTS.step_too_long, judgement.doubt.too_long & ~waits & (landed | ~found)),
    ]


def smooth_action_of(problem: Problem, state: LoopState, doubt: Doubt) -> Array:
    """The same where there are no surfaces."""
    action = select(doubt.too_long, FAIL + FAILURES.index(RESULTS.step_too_long), ACCEPT)
    action = select(doubt.infinite, FAIL + FAILURES.index(RESULTS.nonfinite), action)
    action = select(doubt.refuses, REFUSE, action)
    return select(is_running(problem.grid, state), action, IDLE)


def outcome(action: Array, result: RESULTS) -> RESULTS:
    """The outcome of a lane after an action, given that before it."""
    for number, failure in enumerate(FAILURES):
        result = RESULTS.where(action == FAIL + number, failure, result)
    return result


def _is_event(state: LoopState, end: StepEnd) -> Array:
    """Whether a switch does something, and is not one of a clock that changes no mode."""
    return state.pending.waits & (any_of(end.members) | end.moved)


def step_of(
    state: LoopState, length: Length, end: StepEnd, action: Array, landing: Landing | None
) -> Step:
    """What an action does with a trial step."""
    lands, accepted = (action == LAND) | (action == TOUCH), action == ACCEPT
    # A step to a saving time that is no grid point is looked at and taken back.
    saving, gridded, switched = (
        length.saving & accepted,
        length.gridded & accepted,
        action == SWITCH,
    )
    return Step(
        end=end,
        length=length,
        accepted=accepted,
        saving=saving,
        gridded=gridded,
        moved=(switched | accepted) & ~(saving & ~gridded),
        lands=lands,
        delta=0 * length.h if landing is None else landing.delta,
        switched=switched,
        made=switched & _is_event(state, end),
    )


def next_search_length(
    problem: Problem, state: LoopState, judgement: Judgement, step: Step, action: Array
) -> Array:
    """The signed length to where a contact is expected after this trial step; 0 where none is, or
    where the step cannot be trusted."""
    grid = problem.grid
    least = _LEAST_CUT * grid.same_time(state.motion.tau) * grid.direction
    cut = judgement.contact.theta * step.length.h
    cut = select(abs(cut) < abs(least), least, cut)
    # A step that has ended just short of its contact: Newton says how much is missing.
    missing = missing_time(grid, state, judgement.end)
    ahead = select(step.length.cutting & step.accepted, missing, 0.0)
    length = select(action == REJECT, cut, select(step.moved, ahead, state.search.length))
    return stop_gradient(select(action == REFUSE, 0.0, length))
