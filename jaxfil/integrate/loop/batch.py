"""A batch of lanes that share one loop, on a CPU.

All numbers of the batch stay in the first-level cache; 64 lanes take some 54 kB.

Nearly all steps are without contact. A step that is known to be so in advance needs neither the
search for a contact, nor the other sides' fields, nor a mode, and takes half the time of a full
iteration. But lanes in a vector execute the same operations at the same time, so the loop
alternates between two phases:

    coasting      every lane tries a free step (on its own sides); those for which it
                  is event-free (`is_event_free`) move to its end, the others wait where they are
    judging       every lane does a full iteration: search, reject, land, switch

    lane 0   ─────┼─────┼─────┼──·      ·──x·──┼─────┼─────┼─────       ┼  a grid point
    lane 1   ─────┼─────┼─────┼─────┼   ┼─────┼─────┼─────┼─────       x  a contact
    lane 2   ──·            (waits)     x──·──┼─────┼─────┼─────       ·  stopped: not event-free
             └─────── coasting ──────┘  └─ judging ─┘└─ coasting ─

Coasting continues until too many lanes wait, judging until hardly any lane needs it. The limits are
`_CROSSING`, `_SLIDING`, and for steps that are polynomials `_ALONG`. The result of a lane is
independent of the others. A step that it coasts through would have been accepted with the same
numbers, bit for bit, so a lane has the same samples alone, in a batch of 64 or in another batch.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import FreeStep, LoopState, is_running
from jaxfil.integrate.lane.step_length import Length, choose_length
from jaxfil.integrate.loop.free_step import (
    accept_free_step,
    end_of_free_step,
    field_on_sides,
    is_event_free,
    is_near,
    try_free_step,
)
from jaxfil.integrate.loop.iterate import finish, integrate, judge
from jaxfil.integrate.loop.path import ends_at_kinks, path_of, step_along
from jaxfil.integrate.loop.start import initial_state
from jaxfil.integrate.loop.trial import trial_step
from jaxfil.integrate.steppers.explicit import Trial
from jaxfil.integrate.steppers.taylor import TaylorTableau
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.xla.select import select, select_all

_BATCH = "batch"
"""The name of the axis along which lanes are counted."""

# Each pair is (N, M): coasting ends when 1/N of the lanes have stopped, judging when at most 1/M
# are near a surface, which in blocks of 64 means zero lanes where M = 128. A lane that sticks is
# near its surface for long; otherwise it would still stick when the others come to stick again.
# Measured: on belt friction the first pair costs a tenth. Where nothing slides, (3, 12) is 8 %
# faster on the SD oscillator, which is chaotic, and 8 % slower on the impact oscillator, which is
# not.
_CROSSING, _SLIDING, _ALONG = (8, 32), (16, 128), (4, 16)


def integrate_batch(
    problem: Callable[[Any, Array], tuple[Problem, Components]], points: Any, states: Array
) -> LoopState:
    """`integrate` for b lanes together, returning a `LoopState` of b lanes. `problem` returns the
    problem and the initial components of a lane, given its point in parameter space (arrays of b
    rows) and its state (b, n)."""

    def lane(point: Any, x0: Array) -> LoopState:
        return _integrate_together(*problem(point, x0))

    return jax.vmap(lane, axis_name=_BATCH)(points, states)


def _count(flag: Array) -> Array:
    """The number of lanes of the batch with a flag set. It is a number of the whole batch, so that
    loops and conditionals on it are not batched by `vmap`."""
    return jax.lax.psum(flag.astype(jnp.int32), _BATCH)


def _integrate_together(problem: Problem, x0: Components) -> LoopState:
    """One lane of a batch; it depends on the others through `_count`."""
    # Coasting does not pay without surfaces, or if extensions or the recorder need every iteration;
    # one loop is then smaller than three.
    coasts_alone = problem.recording.recorder.in_free_steps
    coasts_alone = coasts_alone and all(e.in_free_steps for e in problem.extensions)
    # Lanes coast from one grid point to the next, which steps of a tolerance, or to a kink, do not
    # follow.
    coasts_alone = coasts_alone and problem.tableau.tolerance is None
    coasts_alone = coasts_alone and not ends_at_kinks(problem)
    if problem.system.m == 0 or problem.compact or not coasts_alone:
        return integrate(problem, x0)
    few_stopped, few_near = _SLIDING if problem.system.slides else _CROSSING
    if isinstance(problem.tableau, TaylorTableau) and not problem.system.slides:
        few_stopped, few_near = _ALONG

    def on(state: LoopState) -> Array:
        return is_running(problem.grid, state)

    def coasts(carry: tuple[LoopState, Array]) -> Array:
        state, stopped = carry
        return few_stopped * _count(stopped & on(state)) < _count(on(state))

    def coast(carry: tuple[LoopState, Array]) -> tuple[LoopState, Array]:
        return _coast(problem, carry[0])

    def needs_judging(carry: tuple[LoopState, Array]) -> Array:
        state, first = carry
        # At least one iteration, since a lane that has stopped needs it even if no lane is near.
        return first | (few_near * _count(is_near(problem, state) & on(state)) > _count(on(state)))

    def judged(carry: tuple[LoopState, Array]) -> tuple[LoopState, Array]:
        return _judge(problem, carry[0]), jnp.zeros((), bool)

    def turn(state: LoopState) -> LoopState:
        # Lanes near a surface count as stopped from the beginning.
        state, _ = jax.lax.while_loop(coasts, coast, (state, is_near(problem, state)))
        state, _ = jax.lax.while_loop(needs_judging, judged, (state, jnp.ones((), bool)))
        return state

    first = _each_of_the_batch(x0, initial_state(problem, x0))
    state = jax.lax.while_loop(lambda state: _count(on(state)) > 0, turn, first)
    return finish(problem.grid, state)


def _each_of_the_batch(x0: Components, state: LoopState) -> LoopState:
    """The same state, with each number marked as differing between lanes, as x0 is.

    JAX batches the body of a loop again until it knows which of its numbers differ between lanes,
    and these loops are nested. Without this function, that took a fifth of the time to the first
    sweep.
    """
    first = jnp.ravel(x0.parts[0])[0]
    never = first != first
    return jax.tree.map(lambda v: select(never, v, v), state)


def _try(problem: Problem, state: LoopState) -> tuple[Length, FreeStep]:
    """A trial step of a lane on its own sides."""
    length = choose_length(problem, state)
    return length, try_free_step(problem, state, length)


def _coast(problem: Problem, state: LoopState) -> tuple[LoopState, Array]:
    """A lane at the end of its step if the step is event-free, and whether it has stopped."""
    length, free = _try(problem, state)
    clear = is_event_free(problem, state, length, free) & is_running(problem.grid, state)
    # Held, like the action of a full iteration. XLA would otherwise recompute it for each user.
    clear = problem.system.hold(clear.astype(problem.system.dtype))
    return accept_free_step(problem, state, length, free, clear > 0), clear == 0


def _judge(problem: Problem, state: LoopState) -> LoopState:
    """A full iteration. The step of a lane that neither slides nor rests is the same as in
    coasting, bit for bit."""
    if isinstance(problem.tableau, TaylorTableau):
        return _judge_along(problem, state)
    length, free = _try(problem, state)
    x, error, forcing = free.trial.x, free.trial.error, free.trial.forcing
    if problem.system.slides or problem.system.resets:

        def bound() -> tuple[Components, Components | None]:
            slide = trial_step(problem, state, length, forcing)
            return select_all(state.held, (slide.x, slide.error), (x, error))

        # A flag of the whole batch, so that batches without slides and rests skip this step.
        any_held = _count(state.held) > 0
        x, error = jax.lax.cond(any_held, bound, lambda: (x, error))
    return judge(problem, state, length, Trial(x, error, forcing), free)


def _judge_along(problem: Problem, state: LoopState) -> LoopState:
    """A full iteration with a step that is a polynomial up to its contact."""
    system, length = problem.system, choose_length(problem, state)

    def on_sides() -> Polynomial:
        return path_of(problem, state, length, field_on_sides(problem, state))

    def in_mode() -> Polynomial:
        return path_of(problem, state, length, ModeField(system, state.motion.mode))

    if system.slides or system.resets:
        # The series of a mode serves the lanes on sides too, and the series on sides is not
        # computed beside it: in a block where a lane sticks, most iterations need the former.
        path = jax.lax.cond(_count(state.held) > 0, in_mode, on_sides)
    else:
        path = on_sides()
    state, length, trial = step_along(problem, state, length, path)
    return judge(problem, state, length, trial, end_of_free_step(problem, state, length, trial))
