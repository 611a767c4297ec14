"""A block of lanes that share one loop, on a processor.

Rows of parameters and initial states enter, with what makes a problem of a row; the lanes at the
end leave, with their samples. The loop takes turns. As long as few lanes may meet something in
their next step, the others coast to its end and these few wait. Then all steps are judged, which
takes as long as the steps themselves, until hardly a lane needs it. What a lane comes to does not
depend on the others: a step that it coasts through would have been accepted, with the same numbers.
"""

import functools as ft
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.components import ComponentSystem, Forcing, unpack, where
from jaxfil.integrate.event_free import (
    accept_free_step,
    is_event_free,
    is_near_surface,
    is_sliding,
    try_free_step,
)
from jaxfil.integrate.initial_mode import initial_state
from jaxfil.integrate.loop import Length, Trial, choose_length, finish, follow, integrate, judge
from jaxfil.integrate.state import FreeStep, LoopState, Recording, TimeGrid, is_running
from jaxfil.integrate.stepper import Tableau

Problem = Callable[[Array, Array], tuple[ComponentSystem, Tableau, TimeGrid, Recording]]
"""A row of parameters and an initial state to what `integrate` is given; it keeps samples."""

# Lanes coast until one in so many cannot, and are judged until one in so many is left that could
# not: of blocks of 64 where lanes slide, until none is. A lane that sticks is busy for long; left
# behind, it would still stick when the others come to stick again. Measured: on belt friction the
# first pair costs a tenth. Where nothing slides (3, 12) is 8 % faster on the SD oscillator, which
# is chaotic, and 8 % slower on the impact oscillator, which is not.
_CROSSING, _SLIDING = (8, 32), (16, 128)


def integrate_batch(problem: Problem, rows: Array, states: Array, num_saves: int) -> LoopState:
    """`integrate` for b lanes together: rows (b, k) and states (b, n) to a `LoopState` of b."""
    system = problem(rows[0], states[0])[0]

    def alone(row: Array, x0: Array) -> LoopState:
        return integrate(*problem(row, x0), unpack(x0), num_saves=num_saves)

    if system.m == 0:  # there is nothing to meet
        return jax.vmap(alone)(rows, states)
    spans = jax.vmap(lambda row, x0: problem(row, x0)[2])(rows, states)
    few_stopped, few_busy = _SLIDING if system.slides else _CROSSING

    def start(row: Array, x0: Array) -> LoopState:
        system, _, grid, recording = problem(row, x0)
        return initial_state(system, grid, recording, unpack(x0), num_saves)

    def on(lanes: LoopState) -> Array:
        return jax.vmap(is_running)(spans, lanes)

    def unstopped(state: tuple[LoopState, Array]) -> Array:
        lanes, stopped = state
        return few_stopped * jnp.sum(stopped & on(lanes)) < jnp.sum(on(lanes))

    def coasted(state: tuple[LoopState, Array]) -> tuple[LoopState, Array]:
        return jax.vmap(ft.partial(_coast, problem))(rows, states, state[0])

    def unsettled(state: tuple[LoopState, Array]) -> Array:
        lanes, first = state
        return first | (
            few_busy * jnp.sum(jax.vmap(is_near_surface)(lanes) & on(lanes)) > jnp.sum(on(lanes))
        )

    def judged(state: tuple[LoopState, Array]) -> tuple[LoopState, Array]:
        return _judge(problem, system.slides, rows, states, state[0]), state[1] & False

    def turn(lanes: LoopState) -> LoopState:
        lanes, _ = jax.lax.while_loop(unstopped, coasted, (lanes, jax.vmap(is_near_surface)(lanes)))
        lanes, _ = jax.lax.while_loop(unsettled, judged, (lanes, jnp.ones((), bool)))
        return lanes

    begun = jax.vmap(start)(rows, states)
    lanes = jax.lax.while_loop(lambda lanes: jnp.any(on(lanes)), turn, begun)
    return jax.vmap(finish)(spans, lanes)


def _try(problem: Problem, row: Array, x0: Array, state: LoopState) -> tuple[Length, FreeStep]:
    """A trial step of a lane on its own sides."""
    system, table, grid, recording = problem(row, x0)
    length = choose_length(system, grid, recording, state)
    return length, try_free_step(system, table, grid, state, length.h, length.end)


def _coast(problem: Problem, row: Array, x0: Array, state: LoopState) -> tuple[LoopState, Array]:
    """A lane at the end of its step if nothing is in the way, and whether it has stopped."""
    system, table, grid, recording = problem(row, x0)
    length, ahead = _try(problem, row, x0, state)
    clear = is_event_free(system, table, grid, state, length.h, length.end, ahead) & is_running(
        grid, state
    )
    (clear,) = system.hold(clear.astype(system.dtype))
    return accept_free_step(recording, state, length.end, ahead, clear > 0), clear == 0


def _judge(
    problem: Problem, slides: bool, rows: Array, states: Array, lanes: LoopState
) -> LoopState:
    """A full iteration of all lanes, in which the steps of those that do not slide are the ones
    that they might have coasted through, to the last bit."""

    def slid(
        row: Array,
        x0: Array,
        state: LoopState,
        length: Length,
        trial: Trial,
        forcing: list[Forcing],
    ) -> Trial:
        system, table, grid, _ = problem(row, x0)
        slide = follow(system, table, grid, state, length, forcing)
        x, error = (where(is_sliding(state), a, b) for a, b in zip(slide, trial, strict=True))
        return x, error

    def decided(
        row: Array, x0: Array, state: LoopState, length: Length, trial: Trial, ahead: FreeStep
    ):
        system, table, grid, recording = problem(row, x0)
        return judge(system, table, grid, recording, state, length, trial, ahead.forcing, ahead)

    lengths, aheads = jax.vmap(ft.partial(_try, problem))(rows, states, lanes)
    trials = (aheads.x, aheads.error)
    if slides:
        trials = jax.lax.cond(
            jnp.any(jax.vmap(is_sliding)(lanes)),
            lambda: jax.vmap(slid)(rows, states, lanes, lengths, trials, aheads.forcing),
            lambda: trials,
        )
    return jax.vmap(decided)(rows, states, lanes, lengths, trials, aheads)
