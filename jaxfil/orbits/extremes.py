"""The extremes of an orbit, over every step of its arcs.

How many steps an arc takes is unknown before it is run: under a tolerance, with ticks of clocks,
with steps that are halved. It therefore has room for a number of steps, pauses where this is full
for the extremes of these, and goes on, in as many iterations as the search for the orbit has.
"""

import dataclasses
import functools as ft

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem, Recording
from jaxfil.integrate.lane.recorders import SaveDense
from jaxfil.integrate.lane.recording import mode_codes
from jaxfil.integrate.lane.state import LoopState, SavedStates, is_running
from jaxfil.integrate.loop.iterate import advance, finish
from jaxfil.integrate.loop.start import initial_state
from jaxfil.integrate.run.options import enough_iterations
from jaxfil.integrate.run.solution import Dense
from jaxfil.integrate.run.step_choice import expected_steps
from jaxfil.integrate.system.components import pack
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.orbits.extremum import largest
from jaxfil.orbits.shooting import ShootingOptions
from jaxfil.xla.kernel import kernel_if_it_fits
from jaxfil.xla.select import select


class _Paused(eqx.Module):
    """An arc that pauses, and its extremes until then."""

    state: LoopState
    start: SavedStates
    """The start of the step that it is in, as one row."""
    low: Array
    high: Array


@eqx.filter_jit
def extremes_of(
    system: System, options: ShootingOptions, starts: Array, period: Array
) -> tuple[Array, Array]:
    """The smallest and the largest value of each component on the arcs of an orbit from their
    `starts` (M, n), each of shape (n,). NaN if an arc cannot be integrated."""
    length = period / options.arcs
    size = enough_iterations(expected_steps(options.steps, options.stepper), options.max_events)
    recording = Recording(SaveDense(size=size))

    def arc(number: Array, start: Array) -> tuple[Array, Array]:
        t0 = options.t0 + number * length
        problem = options.problem(system, start, t0, length, options.arcs)
        problem = dataclasses.replace(problem, recording=recording)
        return _extremes_of_run(problem, system, options, start)

    numbers = jnp.arange(options.arcs).astype(starts.dtype)
    if options.arcs == 1:  # a batch of one would take as long to trace as a larger batch
        return arc(numbers[0], starts[0])
    low, high = jax.vmap(arc)(numbers, starts)
    return jnp.min(low, axis=0), jnp.max(high, axis=0)


def _extremes_of_run(
    problem: Problem, system: System, options: ShootingOptions, x0: Array
) -> tuple[Array, Array]:
    """The extremes of each component on a run."""
    recorder, t0, dtype = problem.recording.recorder, problem.grid.t0, problem.system.dtype
    assert isinstance(recorder, SaveDense)

    def begun(x0: Array) -> LoopState:
        return initial_state(problem, problem.system.unpack(x0))

    def to_pause(state: LoopState) -> LoopState:
        # A step takes an iteration at least.
        most = jnp.minimum(problem.grid.max_iterations, state.counts.num_iterations + recorder.size)
        grid = dataclasses.replace(problem.grid, max_iterations=most)
        here = dataclasses.replace(problem, grid=grid)
        return jax.lax.while_loop(
            lambda state: eqxi.unvmap_any(is_running(grid, state)), ft.partial(advance, here), state
        )

    def go_on(at: _Paused) -> _Paused:
        counts = dataclasses.replace(at.state.counts, num_saved=jnp.zeros((), jnp.int32))
        state = dataclasses.replace(at.state, counts=counts, saves=recorder.empty(problem.system))
        state = kernel_if_it_fits(to_pause, options.compact)(state)
        saves, count = state.saves, state.counts.num_saved
        assert saves is not None
        rows = jax.tree.map(lambda v, w: jnp.concatenate([v[None], w]), at.start, saves)
        t1 = t0 + problem.grid.length
        steps = Dense(
            system, t0, t1, rows.ts, rows.xs, rows.modes, options.stepper, options.compact
        )
        low, high = _extremes_of(steps, x0.shape[0])
        low, high = jnp.minimum(at.low, low), jnp.maximum(at.high, high)
        return _Paused(state, jax.tree.map(lambda v: v[count], rows), low, high)

    state = kernel_if_it_fits(begun, options.compact)(x0)
    start = SavedStates(t0, pack(state.motion.x, dtype), mode_codes(state.motion.mode))
    end = jax.lax.while_loop(
        lambda at: is_running(problem.grid, at.state), go_on, _Paused(state, start, x0, x0)
    )
    fine = finish(problem.grid, end.state).result == RESULTS.successful
    return select(fine, end.low, jnp.nan), select(fine, end.high, jnp.nan)


def _extremes_of(dense: Dense, n: int) -> tuple[Array, Array]:
    """The extremes of each component over every step of a run."""
    # The smallest value is the largest of the negative: one search for all, as lanes of a batch.
    numbers, signs = np.repeat(np.arange(n), 2), np.tile([-1.0, 1.0], n)

    def extreme(i: Array, sign: Array) -> Array:
        return sign * largest(dense, lambda t, x: sign * x[i])

    both = jax.vmap(extreme)(jnp.asarray(numbers), jnp.asarray(signs, dense.xs.dtype))
    return both[0::2], both[1::2]
