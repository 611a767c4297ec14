"""Extensions: features of a run that carry a state of their own through the loop.

The loop knows only their hooks. An extension that a run does not use adds no operation to its
program. `loop/extensions.problem_of` adds those that the system or its sections need; callers add
others, as averages and extremes are.

A table that an extension fills, with one row for each event or saved state, must be one of those
that `lane/state.tables_of` finds, so that reverse mode does not store a copy for every step.
"""

from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, Motion, StepEnd
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.model.outcomes import RESULTS


class Step(eqx.Module):
    """The decision of an iteration about its trial step."""

    end: StepEnd
    length: Length
    accepted: Array
    """Whether the trial step reaches no contact and can be trusted."""
    saving: Array
    """Whether an accepted step ends at a saving time."""
    gridded: Array
    """Whether an accepted step ends at a grid point."""
    moved: Array
    """Whether the lane moves to the end of the step; if not, the step was only a probe."""
    lands: Array
    """Whether the step ends on a contact, to whose time the lane is then corrected."""
    delta: Array
    """The signed time from the end of the step to the contact."""
    switched: Array
    """Whether a pending switch was carried out."""
    made: Array
    """Whether that switch is an event: of a contact, or of a tick that has changed the state or a
    mode."""
    path: Polynomial | None
    """The motion that the step is a part of, if it is a polynomial."""

    @property
    def between(self) -> Array | None:
        """Whether the step was a switch that another one follows at the same time (see
        `StepEnd.between`); None if there cannot be any."""
        between = self.end.between
        return None if between is None else self.switched & between

    @property
    def settled(self) -> Array:
        """Whether the lane has moved to a state with a mode, which may be saved."""
        return self.moved if self.between is None else self.moved & ~self.between

    @property
    def advances(self) -> Array:
        """Whether time advances with the step, which is accepted or lands on a contact."""
        # An accepted step may have length zero, from a tick to a state saved at its time.
        far = stop_gradient(abs(self.length.h)) > 0
        # A step to a saving time between grid points is accepted and taken back, so that `accepted`
        # alone does not mean that time advances.
        return (self.moved & self.accepted & far) | self.lands


class Verdict(eqx.Module):
    """An extension's decision about a trial step."""

    takes_back: Array
    """Whether the step is taken back, so that the lane stays at its start."""
    failures: tuple[tuple[RESULTS, Array], ...]
    """Outcomes with which the lane ends here, members of `judge.FAILURES`, and whether it does."""
    note: Any
    """Data for `after_step`."""


class Extension(eqx.Module):
    """A feature with a state of its own, of any type. Hooks do nothing unless overridden."""

    in_free_steps: ClassVar[bool] = False
    """Whether the extension never changes the problem or a step, and follows steps without contact
    by `after_free_step` alone; lanes of a batch then need no full iteration for these steps."""

    follows_contacts: ClassVar[bool] = False
    """Whether the extension needs every contact (see `Recorder.follows_contacts`)."""

    def before_step(self, problem: Problem, own: Any) -> Problem:
        """The problem with the functions and the limits of time of a trial step. `own` is None in
        the evaluation at t0, which precedes `begin`."""
        return problem

    def begin(self, problem: Problem, state: LoopState) -> tuple[LoopState, Any]:
        """The lane at t0 and the first state of the extension."""
        return state, None

    def error(
        self,
        problem: Problem,
        state: LoopState,
        own: Any,
        h: Array,
        end: Motion,
        path: Polynomial | None,
    ) -> Array | None:
        """Under a tolerance, the error of a trial step of length h that is not in the stepper's
        estimate, relative to the allowed one and of the order of the stepper."""
        return None

    def at_end(self, problem: Problem, state: LoopState, own: Any, step: Step) -> Verdict | None:
        """The verdict about a trial step on which the loop would decide `step`."""
        # A verdict, even without an effect, would have the step decided twice (`iterate._heard`).
        return None

    def after_step(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: Any,
        step: Step,
        verdict: Verdict | None,
    ) -> tuple[LoopState, Any]:
        """The lane after the step from `state` to `after`, and the extension's next state."""
        return after, own

    def after_free_step(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: Any,
        path: Polynomial | None,
        clear: Array,
    ) -> Any:
        """The next state of the extension after a step without contact from `state` to `after`,
        along its `path` if it is a polynomial, on lanes where it is `clear`; the same state on
        others."""
        return own


def extensions_of(problem: Problem, state: LoopState) -> Iterator[tuple[Extension, Any]]:
    """Each extension of a run, with its state."""
    # A lane has these states only after `begin` (see `loop.start.initial_state`).
    return zip(problem.extensions, state.extensions, strict=True)
