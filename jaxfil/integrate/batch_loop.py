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

from jaxfil.integrate.components import Forcing, Scene, unpack, where
from jaxfil.integrate.event_free import busy, coast, is_clear, is_sliding, look_ahead
from jaxfil.integrate.initial_mode import begin
from jaxfil.integrate.loop import Length, Trial, choose_length, finish, follow, integrate, judge
from jaxfil.integrate.state import Ahead, Lane, Policy, Span, running
from jaxfil.integrate.stepper import Tableau

Problem = Callable[[Array, Array], tuple[Scene, Tableau, Span, Policy]]
"""A row of parameters and an initial state to what `integrate` is given; it keeps samples."""

# Lanes coast until one in so many cannot, and are judged until one in so many is left that could
# not: of blocks of 64 where lanes slide, until none is. A lane that sticks is busy for long; left
# behind, it would still stick when the others come to stick again. Measured: on belt friction the
# first pair costs a tenth. Where nothing slides (3, 12) is 8 % faster on the SD oscillator, which
# is chaotic, and 8 % slower on the impact oscillator, which is not.
_CROSSING, _SLIDING = (8, 32), (16, 128)


def integrate_block(problem: Problem, rows: Array, states: Array, num_saves: int) -> Lane:
    """`integrate` for b lanes together: rows (b, k) and states (b, n) to a `Lane` of b."""
    scene = problem(rows[0], states[0])[0]

    def alone(row: Array, x0: Array) -> Lane:
        return integrate(*problem(row, x0), unpack(x0), num_saves=num_saves)

    if scene.m == 0:  # there is nothing to meet
        return jax.vmap(alone)(rows, states)
    spans = jax.vmap(lambda row, x0: problem(row, x0)[2])(rows, states)
    few_stopped, few_busy = _SLIDING if scene.slides else _CROSSING

    def start(row: Array, x0: Array) -> Lane:
        scene, _, span, policy = problem(row, x0)
        return begin(scene, span, policy, unpack(x0), num_saves)

    def on(lanes: Lane) -> Array:
        return jax.vmap(running)(spans, lanes)

    def unstopped(state: tuple[Lane, Array]) -> Array:
        lanes, stopped = state
        return few_stopped * jnp.sum(stopped & on(lanes)) < jnp.sum(on(lanes))

    def coasted(state: tuple[Lane, Array]) -> tuple[Lane, Array]:
        return jax.vmap(ft.partial(_coast, problem))(rows, states, state[0])

    def unsettled(state: tuple[Lane, Array]) -> Array:
        lanes, first = state
        return first | (few_busy * jnp.sum(jax.vmap(busy)(lanes) & on(lanes)) > jnp.sum(on(lanes)))

    def judged(state: tuple[Lane, Array]) -> tuple[Lane, Array]:
        return _judge(problem, scene.slides, rows, states, state[0]), state[1] & False

    def turn(lanes: Lane) -> Lane:
        lanes, _ = jax.lax.while_loop(unstopped, coasted, (lanes, jax.vmap(busy)(lanes)))
        lanes, _ = jax.lax.while_loop(unsettled, judged, (lanes, jnp.ones((), bool)))
        return lanes

    begun = jax.vmap(start)(rows, states)
    lanes = jax.lax.while_loop(lambda lanes: jnp.any(on(lanes)), turn, begun)
    return jax.vmap(finish)(spans, lanes)


def _try(problem: Problem, row: Array, x0: Array, lane: Lane) -> tuple[Length, Ahead]:
    """A trial step of a lane on its own sides."""
    scene, table, span, policy = problem(row, x0)
    length = choose_length(scene, span, policy, lane)
    return length, look_ahead(scene, table, span, lane, length.h, length.end)


def _coast(problem: Problem, row: Array, x0: Array, lane: Lane) -> tuple[Lane, Array]:
    """A lane at the end of its step if nothing is in the way, and whether it has stopped."""
    scene, table, span, policy = problem(row, x0)
    length, ahead = _try(problem, row, x0, lane)
    clear = is_clear(scene, table, span, lane, length.h, length.end, ahead) & running(span, lane)
    (clear,) = scene.hold(clear.astype(scene.dtype))
    return coast(policy, lane, length.end, ahead, clear > 0), clear == 0


def _judge(problem: Problem, slides: bool, rows: Array, states: Array, lanes: Lane) -> Lane:
    """A full iteration of all lanes, in which the steps of those that do not slide are the ones
    that they might have coasted through, to the last bit."""

    def slid(
        row: Array, x0: Array, lane: Lane, length: Length, trial: Trial, forcing: list[Forcing]
    ) -> Trial:
        scene, table, span, _ = problem(row, x0)
        slide = follow(scene, table, span, lane, length, forcing)
        x, error = (where(is_sliding(lane), a, b) for a, b in zip(slide, trial, strict=True))
        return x, error

    def decided(row: Array, x0: Array, lane: Lane, length: Length, trial: Trial, ahead: Ahead):
        scene, table, span, policy = problem(row, x0)
        return judge(scene, table, span, policy, lane, length, trial, ahead.forcing, ahead)

    lengths, aheads = jax.vmap(ft.partial(_try, problem))(rows, states, lanes)
    trials = (aheads.x, aheads.error)
    if slides:
        trials = jax.lax.cond(
            jnp.any(jax.vmap(is_sliding)(lanes)),
            lambda: jax.vmap(slid)(rows, states, lanes, lengths, trials, aheads.forcing),
            lambda: trials,
        )
    return jax.vmap(decided)(rows, states, lanes, lengths, trials, aheads)
