"""The trial step of an iteration, and its end.

A step that overflows is refused, but reverse mode would multiply its derivatives, which are not
finite, by cotangents of zero. In programs for reverse mode they are left out (`only_if_valid`).
"""

import dataclasses
import functools as ft
from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array

from jaxfil.integrate.contacts.switch import evaluate_step_end
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import ContactSearch, FreeStep, LoopState, StepEnd
from jaxfil.integrate.lane.step_length import Length, choose_length
from jaxfil.integrate.loop.path import may_be_cut, path_of, step_along
from jaxfil.integrate.steppers.explicit import Trial, compact_step, step
from jaxfil.integrate.steppers.taylor import TaylorTableau
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.surfaces.unilateral import rests_of
from jaxfil.integrate.system.components import Forcing, all_finite, any_of, where
from jaxfil.xla.select import select_all
from jaxfil.xla.valid_derivative import only_if_valid


class Tried(eqx.Module):
    """A trial step, and its end."""

    search: ContactSearch
    """The contact that the lane aims at, which a step along a polynomial has found itself."""
    length: Length
    trial: Trial
    end: StepEnd

    @property
    def infinite(self) -> Array:
        """Whether the end is not finite."""
        motion = self.end.motion
        return ~all_finite(motion.x, motion.f, motion.g, motion.rate)


def try_step(problem: Problem, state: LoopState) -> Tried:
    """The trial step of an iteration."""
    length = choose_length(problem, state)
    if isinstance(problem.tableau, TaylorTableau) and may_be_cut(problem):
        # It ends at the first zero of a guard on its polynomial, or at a kink.
        path = path_of(problem, state, length, ModeField(problem.system, state.motion.mode))
        state, length, trial = step_along(problem, state, length, path)
    else:
        t, times = problem.grid.t0 + state.motion.tau, problem.tableau.times
        forcing = problem.system.forcing(t, length.h, times)
        trial = trial_step(problem, state, length, forcing)
    return Tried(state.search, length, trial, end_of(problem, state, length, trial))


def try_step_in_reverse(problem: Problem, state: LoopState) -> tuple[Tried, Array]:
    """The trial step of an iteration for reverse mode, and whether its end is not finite. Such a
    step is refused, and its numbers take no part in derivatives; its end is the start."""
    # The tables of a loop with checkpoints are no arrays; a trial step does not use them.
    bare = dataclasses.replace(state, table=None, saves=None, extensions=())
    tried = only_if_valid(_valid_step, problem, bare)
    infinite, start = tried.infinite, state.motion
    start = dataclasses.replace(start, tau=tried.end.motion.tau)
    motion = select_all(infinite, start, tried.end.motion)
    end = dataclasses.replace(tried.end, motion=motion)
    return dataclasses.replace(tried, end=end), infinite


def _valid_step(problem: Problem, state: LoopState) -> tuple[Array, Tried]:
    """Whether a trial step has a finite end, and the step."""
    tried = try_step(problem, state)
    return ~tried.infinite, tried


def trial_step(problem: Problem, state: LoopState, length: Length, forcing: list[Forcing]) -> Trial:
    """A trial step in the lane's mode."""
    system, motion = problem.system, state.motion
    t = problem.grid.t0 + motion.tau

    def tried(take: Callable, held: bool) -> Trial:
        field = ModeField(system, motion.mode, held=held)
        return take(problem.tableau, field, t, motion.x, motion.f, length.h, forcing)

    grade = compact_step if problem.compact else step
    if not system.resets:
        return tried(grade, held=False)
    # Reactions enlarge the field's program, and few lanes rest, so their step is a compact one.
    held, free = ft.partial(tried, compact_step, True), ft.partial(tried, grade, False)
    return system.where_any(any_of(rests_of(motion.mode)), held, free)


def end_of(
    problem: Problem,
    state: LoopState,
    length: Length,
    trial: Trial,
    free: FreeStep | None = None,
) -> StepEnd:
    """The end of a trial step."""
    x = trial.x
    if problem.system.m > 0 or problem.tick is not None:
        # A switch has length zero, so its trial would end in the same state, but with 0·∞ = NaN
        # where the field of the old mode is not finite.
        x = where(state.pending.waits, state.motion.x, x)
    return evaluate_step_end(problem, state, length, x, trial.forcing[-1], free)
