"""Accumulations: infinitely many switchings in a finite time, completed by their limit.

Where contacts of the same kind follow one another at intervals that shrink by a constant ratio, a
switch jumps to their limit, given by its time, its state and the surfaces reached in between. The
next switch chooses the mode on these.

Near the point to which a twisting controller or a spiral through the sides of two surfaces
converges, the motion is self-similar, and each turn takes q times as long as the last one. The time
remaining after a turn of length T is a geometric series (Aitken's extrapolation). The mean velocity
V of turns is linear in the time of their middle, both for a smooth motion and for one that decays
with the first or second power of the remaining time:

    τ = T q/(1 − q),   q = T/T_before,
    x + τ (V + (V − V_before) (T + τ)/(T + T_before)),   V = D/T after a turn that moves x by D.

Where the fields are constant both are exact, with their derivatives. Elsewhere the error of the
time is of the order of the square of the remaining time, and the error of the state of its cube.
The limit is used when two consecutive turns predict the same one to within rounding, in time and in
every component of the state.

Resets may end the series later, as one that keeps a band of a hysteresis above a least width, or a
latch that acts below some gap. So the resets of the turn also act on a copy of it, made smaller by
a factor ε towards the limit L. If p and R(p) are the states before and after a reset of the turn,
its copy must give L + ε (R(p) − L) again, whatever the others have written to memories.
"""

import dataclasses
import functools as ft
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.guards import stays_on
from jaxfil.integrate.contacts.resets import Impact, Reset, effects
from jaxfil.integrate.contacts.turn import LONGEST, Turn
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, StepEnd
from jaxfil.integrate.lane.step_length import Length, typical_step
from jaxfil.integrate.system.components import (
    Components,
    any_of,
    index_of,
    largest,
    maximum,
    total,
    where,
)
from jaxfil.xla.select import select, select_all
from jaxfil.xla.valid_derivative import undefined_where

# Tolerance for equal predictions, in multiples of the rounding of their terms.
_AGREE = 4
# The largest such rounding, as a part of the length of a turn. With shorter turns it grows while
# predictions still approach each other: as 2.6 and 1/5 in each turn of a wall and a friction.
_TOLD = 1 / 8
# The size of the copy of a turn, as this power of eps. It is large compared with the rounding of
# the turn, so that a reset can tell the directions in it.
_COPY = 2 / 3


def follow_turns(
    problem: Problem,
    state: LoopState,
    length: Length,
    end: StepEnd,
    reset: Reset | None,
    led: Impact | None,
) -> StepEnd:
    """The end of a step with the turn that its switch, with this reset, belongs to. If that turn
    completes the accumulation, the step jumps to the limit of all later turns."""
    turn = state.turn
    if turn is None:
        return end
    follows = _counts(state) if reset is None else _counts(state) | any_of(reset.heard)
    turn, jump, x = problem.system.where_any(
        follows, _turned, _as_before, problem, state, length, end, reset, led
    )
    done = turn.completed
    upcoming = done & turn.met
    if end.jump is not None and end.next is not None:
        jump, upcoming = select(done, jump, end.jump), where(done, upcoming, end.next)
    # Changes of other surfaces by this switch are part of the completed turns, and the mode at the
    # limit is not the one planned here.
    again = None if end.again is None else end.again & ~done
    planned = None if end.planned is None else end.planned & ~done
    return dataclasses.replace(
        end,
        again=again,
        planned=planned,
        motion=dataclasses.replace(end.motion, x=where(done, x, end.motion.x)),
        turn=turn,
        jump=jump,
        next=upcoming,
    )


def _counts(state: LoopState) -> Array:
    """Whether a switch is at a contact of a turn, or at the limit.

    A tick is not, nor is a surface that a map or a jump of H has moved the state across. Two ticks
    that coincide but for rounding would be a turn that has shrunk to zero.
    """
    assert state.turn is not None
    contact = any_of(state.pending.surfaces & ~state.pending.across)
    return state.pending.waits & (contact | state.turn.completed)


def _as_before(
    problem: Problem, state: LoopState, length: Length, end: StepEnd, *_: Any
) -> tuple[Turn | None, Array, Components]:
    return state.turn, jnp.zeros_like(end.motion.tau), end.motion.x


def _turned(
    problem: Problem,
    state: LoopState,
    length: Length,
    end: StepEnd,
    reset: Reset | None,
    led: Impact | None,
) -> tuple[Turn, Array, Components]:
    """The turn after a switch, and the time and the state of the limit of turns."""
    turn, same = state.turn, problem.same_time(end.motion.tau)
    assert turn is not None
    # After the limit, turns are counted from the start.
    counts = _counts(state)
    switches = counts & ~state.pending.grazes & ~turn.completed
    kind = _kind(state.pending.surfaces, end.motion.mode)
    # Long after t0 a turn may be little longer than the spacing of times, and the low-order parts
    # determine its digits.
    time = (end.motion.tau - turn.tau) + stop_gradient(state.tau_low - turn.tau_low)
    # Backward in time elapsed times decrease, so that turns are followed only forward.
    again = switches & (kind == turn.kind) & (time > 0)
    shrinks = again & (time < turn.length)
    # Lanes without a prediction divide by 1. In reverse mode the derivative of a quotient by zero
    # would be NaN even where the quotient is not selected.
    took, before = select(shrinks, time, 1), select(shrinks, turn.length, 1)
    ratio = select(shrinks, time, 0) / before
    left = select(shrinks, time * ratio / (1 - ratio), jnp.inf)
    move = end.motion.x - turn.x
    mean = move / took
    # The middles of two turns are half the sum of their lengths apart, so this is half the rate at
    # which the mean velocity changes.
    change = (mean - turn.move / before) / (took + before)

    def ahead(span: Array) -> Components:
        """The state after a part `span` of the remaining time."""
        return end.motion.x + span * (mean + (time + span) * change)

    # Without a prediction the remaining time is inf, and the state would not be finite.
    limit, last = ahead(select(shrinks, left, 0)), mean + (time + 2 * left) * change
    agrees, rounding, apart = _agrees(problem, state, end, time, ratio, left, limit, move)
    reached, clear = _surfaces_there(problem, state, end, left, (limit, last), apart)
    # The predicted limit may be past a grid point by the rounding of the prediction.
    late = length.beyond(left)
    agrees = agrees & reached & (late <= rounding)
    copy = _copied(problem, state, end, reset)
    if copy is not None:
        agrees = agrees & _is_alike(problem, copy, turn.limit, apart)
    # A limit within the rounding of times is reached, whether predictions agree or not, unless the
    # turn before was long. A second contact at one time but for rounding has no ratio to it.
    brief = problem.system.eps**0.5 * typical_step(problem, state)
    reached = (left <= same) & (late <= same) & (turn.length <= brief)
    completed = shrinks & (agrees | reached) & clear
    soon = left <= brief
    if _is_watched(problem):
        # States within the time of the jump would be computed from the last contact.
        completed = completed & soon
    elif problem.system.resets:
        # For a single wall, `resets` has a better prediction, by the reset itself.
        together = total((turn.met | state.pending.surfaces).astype(jnp.int32)) > 1
        completed = completed & (together | soon)
    if led is not None:
        completed = completed & ~_has_own_impacts(led, turn.met | state.pending.surfaces)
    starts = switches & (again | (turn.contacts >= LONGEST))
    # The switch at the limit needs the surfaces of the completed turn. Any other start clears them.
    met = switches & (turn.met | state.pending.surfaces)
    now = Turn(
        kind=select(starts, kind, turn.kind),
        tau=select(starts, end.motion.tau, turn.tau),
        tau_low=select(starts, state.tau_low, turn.tau_low),
        x=where(starts, end.motion.x, turn.x),
        length=select(starts, select(again, time, 0), turn.length),
        move=where(starts, move, turn.move),
        left=select(starts, stop_gradient(left), turn.left),
        limit=where(starts, stop_gradient(limit), turn.limit),
        met=met & (completed | ~starts),
        late=select(starts, 0, _lateness(state)),
        contacts=select(starts, 0, turn.contacts + 1),
        completed=completed,
        copy=copy and where(starts, (1 - _scale(problem)) * stop_gradient(limit), copy),
    )
    jump = select(completed, left - late, 0)
    if not problem.system.resets and len(set(problem.system.structure.groups)) > 1:
        # Those of independent surfaces that end at one time end at two for other parameters.
        both = _are_of_several_groups(problem, turn.met | state.pending.surfaces)
        jump = undefined_where(stop_gradient(completed & both), jump)
    other = dataclasses.replace(turn, copy=copy)
    return select_all(counts, now, other), jump, ahead(jump)


def _scale(problem: Problem) -> float:
    """The factor ε by which the copy of a turn is smaller."""
    return problem.system.eps**_COPY


def _copied(
    problem: Problem, state: LoopState, end: StepEnd, reset: Reset | None
) -> Components | None:
    """`Turn.copy` after a reset.

    The copy moves by ε times what the state moves by, except in a reset. It starts as L + ε (x − L)
    after the first contact, so that `Turn.copy` is (1 − ε) L then, and again where the copy has
    followed the turn.
    """
    turn, scale = state.turn, _scale(problem)
    assert turn is not None
    if reset is None or turn.copy is None:
        return None
    system, tau = stop_gradient((problem.system, end.motion.tau))
    left = turn.tau + turn.left - tau
    t = problem.grid.t0 + tau + (1 - scale) * select(jnp.isfinite(left), left, 0)
    before, after = scale * stop_gradient(state.motion.x), scale * stop_gradient(reset.x)
    moved = system.reset(stop_gradient(t), before + turn.copy, index_of(reset.heard)) - after
    return where(any_of(reset.heard), moved, turn.copy)


def _is_alike(problem: Problem, copy: Components, limit: Components, apart: Components) -> Array:
    """Whether the copy of a turn has followed it, to within the rounding of the limit."""
    return ~any_of(~(abs(copy - (1 - _scale(problem)) * limit) <= _AGREE * apart))


def _is_watched(problem: Problem) -> bool:
    """Whether every contact is followed, to save its state or to search for crossings."""
    followed = problem.recording.recorder.follows_contacts or problem.look is not None
    return followed or any(e.follows_contacts for e in problem.extensions)


def _surfaces_there(
    problem: Problem,
    state: LoopState,
    end: StepEnd,
    left: Array,
    limit: tuple[Components, Components],
    apart: Components,
) -> tuple[Array, Array]:
    """Whether the limit, a state known to within `apart` with its mean velocity, is on all surfaces
    of the turn, and whether no other surface is crossed on the way to it.

    It is not on those of another accumulation that goes on, as of two balls that come to rest
    independently, each at its own time.
    """
    assert state.turn is not None
    (x, velocity), motion = limit, end.motion
    span = select(jnp.isfinite(left), left, 0)
    h, h_t, normals = problem.system.gradients(problem.grid.t0 + motion.tau + span, x)
    met = state.turn.met | state.pending.surfaces
    close = abs(h) <= abs(normals) @ apart + _AGREE * state.motion.noise
    # Bernstein coefficients of the cubic of a guard on the way, which is between them. Later turns
    # are nearer to the limit than this one, which has not reached the surface.
    start = motion.g + span / 3 * motion.rate
    stop = motion.mode * (h - span / 3 * (h_t + normals @ velocity))
    passes = (start >= 0) & (stop >= 0) & (motion.mode * h >= 0)
    others = ~(met | stays_on(problem.system, motion.mode))
    return ~any_of(met & ~close), ~any_of(others & ~passes)


def _are_of_several_groups(problem: Problem, met: Components) -> Array:
    """Whether some of these surfaces do not switch the rates of the others (`Structure.groups`)."""
    groups = np.asarray(problem.system.structure.groups)
    own = [problem.system.of_surfaces(jnp.asarray(groups == k)) for k in sorted(set(groups))]
    return total(Components(any_of(met & v).astype(jnp.int32) for v in own)) > 1


def _has_own_impacts(led: Impact, met: Components) -> Array:
    """Whether one of several surfaces throws back without an effect on the others, nor theirs on
    it. Its impacts end at a time of their own, with its own derivative, even if
    others end at the same time, and `resets` completes them."""
    assert led.links is not None
    one = total(met.astype(jnp.int32)) == 1
    alone = effects(led.links, met) <= 2 * led.links.diagonal()
    return ~one & any_of(met & led.walls & alone)


def _kind(hit: Components, mode: Components) -> Array:
    """The surfaces of a contact and the mode after it, encoded as one number."""
    codes = 2 * (mode + 2) + hit.astype(mode.number(0).dtype)
    if codes.is_array:  # square roots, so that different codes have different sums
        (numbers,) = stop_gradient(codes).parts
        roots = np.sqrt(np.arange(2.0, 2.0 + len(numbers))).astype(numbers.dtype)
        return jnp.sum(numbers * roots)
    # Each code is between 0 and 9, one decimal digit.
    return stop_gradient(ft.reduce(lambda number, code: 10 * number + code, codes.parts))


def _lateness(state: LoopState) -> Array:
    """The uncertainty of the contact times of a turn. It is the rounding of a guard divided by its
    rate."""
    assert state.turn is not None
    late = where(
        state.pending.surfaces & (state.motion.rate != 0),
        state.motion.noise / abs(state.motion.rate),
        0,
    )
    return stop_gradient(jnp.maximum(state.turn.late, largest(late)))


def _agrees(
    problem: Problem,
    state: LoopState,
    end: StepEnd,
    time: Array,
    ratio: Array,
    left: Array,
    limit: Components,
    move: Components,
) -> tuple[Array, Array, Components]:
    """Whether the limit equals the one predicted by the turn before, to within rounding, and the
    rounding of its time and of its state."""
    turn, same = state.turn, problem.same_time(state.motion.tau)
    assert turn is not None
    # The factor 1/(1 − q) of a ratio of two times magnifies their rounding twice.
    shrink = 1 - ratio
    rounding = _AGREE * (same / shrink + _lateness(state) / (shrink * shrink))
    # If rounding is a large part of a turn, all predictions agree, without meaning.
    agrees = (abs(left - (turn.left - time)) <= rounding) & (rounding <= _TOLD * time)
    size, speed = (
        maximum(abs(limit), abs(end.motion.x)),
        maximum(abs(end.motion.f), abs(state.motion.f)),
    )
    # A reset moves the state at a rounded time, also if the velocity is zero before and after it.
    speed = maximum(speed, abs(move) / select(time > 0, time, 1))
    apart = _AGREE * problem.system.eps * size / (shrink * shrink) + rounding * speed
    # Negated twice, so that a NaN does not agree.
    return agrees & ~any_of(~(abs(limit - turn.limit) <= apart)), rounding, apart
