"""The judgement of a trial step: the action of an iteration, as one number.

Accept, reject, land and switch are explained in `iterate`. A landing may be a graze ("touch"), a
lane that has ended is idle, and extensions may take a step back. The action is one float, so that
it is computed once (`ComponentSystem.hold`); XLA would otherwise recompute it for each user.
"""

from collections.abc import Iterable

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
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select

# Number of consecutive contacts at one time that count as an accumulation. It is more than surfaces
# reached together need to settle, one after the other.
_FROZEN = 12
# The same number for surfaces with resets, whose resets follow one another at one time. Three balls
# on each other come to rest in some hundreds, each of which removes a few percent.
_CHAIN = 4096
# A flight counts as hidden if its height is below this multiple of rounding. At four times the
# rounding, its start and its end are hidden.
_LOW = 16
# Actions of an iteration. A failure is FAIL plus its index in FAILURES.
IDLE, REJECT, ACCEPT, LAND, TOUCH, SWITCH, TAKE_BACK, REFUSE, FAIL = map(float, range(9))
# Failures, the first of which has precedence where a step has several.
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
# Number of consecutive rejections after which the search for a contact is given up; bisection alone
# needs 53 to reduce an interval to eps.
_TRIES = 60
# The shortest cut of a step, as a part of the rounding of times. It must not be zero, since a
# length of zero stands for "no contact expected".
_LEAST_CUT = 1e-6


class Judgement(eqx.Module):
    """The data on which the action is decided."""

    end: StepEnd
    contact: Contact
    landing: Landing
    doubt: Doubt
    rejections: Array
    """Number of consecutive rejections, if this step is rejected."""
    repeats: Array
    """Number of consecutive contacts at one time, including the one switched here."""


def judged(
    problem: Problem,
    state: LoopState,
    length: Length,
    trial: Trial,
    end: StepEnd,
    overflowed: Array | None = None,
) -> Judgement:
    """The judgement of a trial step, before the action is chosen. A step that has `overflowed` has
    another end here."""
    contact = find_contact(problem, state, end, length, trial.searched)
    waits = state.pending.waits
    motion = end.motion
    infinite = ~all_finite(motion.x, motion.f, motion.g, contact.theta)
    infinite = infinite if overflowed is None else infinite | overflowed
    # A shorter flight is indistinguishable from the time correction at its end.
    tau, repeats = end.motion.tau, state.pending.repeats
    flight = abs(tau - state.pending.tau)
    again = flight <= 4 * problem.same_time(tau)
    # A tick that reaches no surface is no contact, and each clock has a single tick at a time.
    reached = any_of(state.pending.surfaces)
    if problem.system.resets and problem.system.m > 1:
        # The same holds for a flight that moves no further from its surface than rounding.
        low = flight * abs(state.motion.rate) <= _LOW * state.motion.noise
        again = again | (reached & ~any_of(state.pending.surfaces & ~low))
    return Judgement(
        end=end,
        contact=contact,
        landing=land(problem, state, end, length),
        doubt=doubted(problem, state, length, trial, end, infinite),
        rejections=select(contact.found, state.search.rejections + 1, 0),
        repeats=select(waits, select(again, repeats + reached.astype(repeats.dtype), 0), repeats),
    )


def action_of(problem: Problem, state: LoopState, judgement: Judgement) -> Array:
    """The action for a trial step, or `FAIL` plus the index of its failure."""
    contact, landing = judgement.contact, judgement.landing
    # If a slide approaches a singular point, the end of a long step is not evidence of a contact.
    landed = landing.landed & ~contact.singular
    if problem.system.m > 1:
        # A step that passes one surface is not accepted merely because it ends on another.
        landed = landed & ~any_of(contact.all & ~landing.surfaces)
    # Each of these selections has precedence over the ones before it.
    action = select(contact.found, REJECT, ACCEPT)
    action = select(landed, select(landing.touched, TOUCH, LAND), action)
    action = select(state.pending.waits, SWITCH, action)
    misfit = judgement.end.misfit
    action = failing(action, _failures(problem, state, judgement, landed))
    # A step that cannot be trusted gives no reliable information on contacts, so refusal precedes
    # rejection and failure.
    action = select(judgement.doubt.refuses & ~state.pending.waits, REFUSE, action)
    if misfit is not None:
        action = select(misfit, TAKE_BACK, action)
    action = select(is_running(problem.grid, state), action, IDLE)
    return problem.system.hold(action.astype(problem.system.dtype))


def failing(action: Array, failures: Iterable[tuple[RESULTS, Array]]) -> Array:
    """The action, or the failure that has precedence among those that are true."""
    for failure, failed in sorted(failures, key=lambda v: FAILURES.index(v[0]), reverse=True):
        action = select(failed, FAIL + FAILURES.index(failure), action)
    return action


def _failures(
    problem: Problem, state: LoopState, judgement: Judgement, landed: Array
) -> list[tuple[RESULTS, Array]]:
    """The failures of the loop itself, and whether a trial step has each."""
    system, end, waits = problem.system, judgement.end, state.pending.waits
    motion, found, no = end.motion, judgement.contact.found, jnp.zeros((), bool)
    most, undecided = problem.recording.max_events, end.num_modes == 0
    # A limit of turns from which no mode continues is an accumulation without a continuation.
    limit = no if state.turn is None else state.turn.completed & waits
    chain = _CHAIN if system.resets and system.m > 1 else _FROZEN + 2 * system.m
    full = no if most is None else _is_event(state, end) & (state.counts.num_events >= most)
    # If the table ends with many contacts at one time, or with flights hidden by rounding, they
    # accumulate. Surfaces that reset each other a few times each need no more than this number.
    many = full & (judgement.repeats >= _FROZEN + 2 * system.m)
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


def smooth_action_of(problem: Problem, state: LoopState, end: StepEnd, doubt: Doubt) -> Array:
    """The same in a system without surfaces."""
    action = jnp.full_like(state.motion.tau, ACCEPT)
    too_long, refuses = doubt.too_long, doubt.refuses
    if problem.tick is not None:
        waits, back = state.pending.waits, problem.grid.direction < 0
        too_long, refuses = too_long & ~waits, refuses & ~waits
        action = select(waits, SWITCH, action)
        action = failing(action, [(RESULTS.irreversible_reset, end.moved & back)])
    failures = (RESULTS.nonfinite, doubt.infinite), (RESULTS.step_too_long, too_long)
    action = failing(action, failures)
    action = select(refuses, REFUSE, action)
    return select(is_running(problem.grid, state), action, IDLE)


def outcome(action: Array, result: RESULTS) -> RESULTS:
    """The outcome of a lane after an action, given the one before."""
    for number, failure in enumerate(FAILURES):
        result = RESULTS.where(action == FAIL + number, failure, result)
    return result


def _is_event(state: LoopState, end: StepEnd) -> Array:
    """Whether a switch is an event. A switch of a clock that changes no mode is not."""
    return state.pending.waits & (any_of(end.members) | end.moved)


def step_of(
    state: LoopState,
    length: Length,
    end: StepEnd,
    action: Array,
    landing: Landing | None,
    path: Polynomial | None,
) -> Step:
    """The step that results from an action, on a path if it is known."""
    lands, accepted = (action == LAND) | (action == TOUCH), action == ACCEPT
    # A step to a saving time that is not a grid point is recorded and taken back, so that saving
    # does not change the steps.
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
        path=path,
    )


def next_search_length(
    problem: Problem, state: LoopState, judgement: Judgement, step: Step, action: Array
) -> Array:
    """The signed length to the next expected contact after this trial step; 0 if none is expected,
    or if the step cannot be trusted."""
    grid = problem.grid
    least = _LEAST_CUT * problem.same_time(state.motion.tau) * grid.direction
    cut = judgement.contact.theta * step.length.h
    cut = select(abs(cut) < abs(least), least, cut)
    # If the step has ended just short of its contact, Newton gives the remaining time.
    missing = missing_time(grid, state, judgement.end)
    ahead = select(step.length.cutting & step.accepted, missing, 0.0)
    length = select(action == REJECT, cut, select(step.moved, ahead, state.search.length))
    return stop_gradient(select(action == REFUSE, 0.0, length))
