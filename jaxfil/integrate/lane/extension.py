"""Extensions: features of a run that carry a state of their own through the loop.

The loop calls their hooks and knows nothing else of them; a run without an extension has no trace
of it in its program. `loop.extensions` lists them all.
"""

from typing import Any, ClassVar

import equinox as eqx
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, StepEnd
from jaxfil.integrate.lane.step_length import Length


class Step(eqx.Module):
    """What an iteration does with its trial step."""

    end: StepEnd
    length: Length
    accepted: Array
    """Whether the trial step meets nothing and can be trusted."""
    saving: Array
    """Whether it then ends at a time to be saved."""
    gridded: Array
    """Whether it then ends at a grid point."""
    moved: Array
    """Whether the lane goes on to its end, and does not only look at it."""
    lands: Array
    """Whether it has ended on a contact: the lane goes on to where that is."""
    delta: Array
    """The signed time from the end of the step to the contact that it lands on."""
    switched: Array
    """Whether a pending switch was made."""
    made: Array
    """Whether that switch was of a contact, and not of a clock alone."""

    @property
    def advances(self) -> Array:
        """Whether time goes on by it: it is taken, or lands."""
        far = stop_gradient(abs(self.length.h)) > 0
        return (self.moved & self.accepted & far) | self.lands


class Verdict(eqx.Module):
    """What an extension says of a trial step."""

    takes_back: Array
    """Whether the lane stays where it is."""
    fails: Array
    """Whether a number of the extension is not finite."""
    note: Any
    """What `after_step` needs to know."""


class Extension(eqx.Module):
    """A feature with a state of its own, of any type. Hooks do nothing unless overridden."""

    in_free_steps: ClassVar[bool] = False
    """Whether it leaves the problem and all steps as they are, and follows a lane of a batch by
    `after_free_step` where steps meet nothing: lanes then need no full iteration for them."""

    def before_step(self, problem: Problem, own: Any) -> Problem:
        """The problem as a trial step sees it: its functions, and how far it may go. `own` is None
        for the evaluation at t0, before `begin`."""
        return problem

    def begin(self, problem: Problem, state: LoopState) -> tuple[LoopState, Any]:
        """The lane at t0 and the first state of the extension."""
        return state, None

    def at_end(self, problem: Problem, state: LoopState, own: Any, step: Step) -> Verdict | None:
        """What is said of a trial step with which the loop would do what `step` says."""
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
        """`after`, to which the step has led from `state`, and the next state of the extension."""
        return after, own

    def after_free_step(
        self, problem: Problem, state: LoopState, after: LoopState, own: Any, clear: Array
    ) -> Any:
        """The next state of the extension after a step from `state` to `after` that meets nothing,
        where it is `clear`; the same one otherwise."""
        return own
