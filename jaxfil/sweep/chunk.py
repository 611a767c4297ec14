"""The program of a chunk of lanes.

On a CPU it consists of single kernels, each of one lane or of a block of lanes, if the system
fits into one.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane.problem import period_outcome
from jaxfil.integrate.loop.batch import integrate_batch
from jaxfil.integrate.loop.iterate import integrate
from jaxfil.model.outcomes import RESULTS
from jaxfil.sweep.sampling import Kept, Point, Samples, Sampling
from jaxfil.xla.kernel import BLOCK, kernel_of_rows
from jaxfil.xla.program import opened, operations

Saved: TypeAlias = tuple[Kept, RESULTS, Array]
"""Data of lanes for their samples, their outcomes, and their last states."""


class Chunk(eqx.Module):
    """The results of a chunk."""

    samples: Samples[Array]
    results: RESULTS
    end: Array
    """Last states, shape (lanes, n), or the last state of all, shape (n,), where each lane starts
    from the end of the previous one."""
    in_kernels: bool = eqx.field(static=True)
    """Whether its lanes, or blocks of them, are single kernels."""


def run_chunk(
    sampling: Sampling, rows: Array, states: Array, lanes: Array, *, followed: bool
) -> Chunk:
    """The first `lanes` lanes of a chunk, side by side, or one after the other, each from the end
    of the previous one."""
    points = sampling.points(rows, states)
    run = _one_after_another if followed else _side_by_side
    (saved, results, end), in_kernels = run(sampling, points, states, lanes)
    each = jax.vmap(sampling.sampled, (0, None if followed else 0, 0, 0))
    samples = each(points, states, saved, results)
    periods = jax.vmap(lambda row: sampling.at(row)[1])(rows)
    return Chunk(samples, jax.vmap(period_outcome)(periods, results), end, in_kernels)


def _lane(sampling: Sampling, point: Point, x0: Array) -> Saved:
    saved, result, end = sampling.outcome(integrate(*sampling.problem(point, x0)))
    return saved, result, sampling.ended(point, x0, end)


def _row_of_one(sampling: Sampling, lanes: Array, *row: Any) -> Saved:
    """The lane of a row of one point, one state and one number, unless it is padding, which is not
    run."""
    point, x0, i = jax.tree.map(lambda v: v[0], row)
    found = _if(i < lanes, ft.partial(_lane, sampling), point, x0)
    return jax.tree.map(lambda v: v[None], found)


def _side_by_side(
    sampling: Sampling, points: Point, states: Array, lanes: Array
) -> tuple[Saved, bool]:
    """Each lane from its own state, and whether they are in kernels."""

    def block(points: Point, states: Array, _: Array) -> Saved:
        return sampling.outcome(integrate_batch(sampling.problem, points, states))

    def together(points: Point, states: Array, _: Array) -> Saved:
        return jax.vmap(ft.partial(_lane, sampling))(points, states)

    rows = points, states, jnp.arange(len(states), dtype=jnp.int32)
    # One lane after the other uses the program of one lane, which compiles in half the time.
    alone = ft.partial(_row_of_one, sampling, lanes)
    function, size = (alone, 1) if sampling.compact else (block, BLOCK)
    kernel = kernel_of_rows(function, size, *rows)
    return _if(lanes > 0, kernel or together, *rows), kernel is not None


def _one_after_another(
    sampling: Sampling, points: Point, state: Array, lanes: Array
) -> tuple[Saved, bool]:
    """Each lane from the end of the previous one, with the end of the last; and whether they are in
    kernels."""
    numbers = jnp.arange(len(points.values), dtype=jnp.int32)
    alone = ft.partial(_row_of_one, sampling, lanes)
    kernel = kernel_of_rows(alone, 1, points, state[None], numbers)
    run = kernel or alone

    def next_point(x: Array, at: tuple[Point, Array]) -> tuple[Array, tuple]:
        # After a failed lane the next one starts from the last good state.
        point, i = jax.tree.map(lambda v: v[None], at)
        saved, result, end = jax.tree.map(lambda v: v[0], run(point, x[None], i))
        good = (result == RESULTS.successful) & (at[1] < lanes)
        return jnp.where(good, end, x), (saved, result)

    end, (saved, results) = jax.lax.scan(next_point, state, (points, numbers))
    return (saved, results, end), kernel is not None


def _if(flag: Array, function: Callable, *args: Any) -> Any:
    """`function(*args)` if the flag is set, otherwise 0 without a call."""
    # As a jaxpr, so that it is traced once, for its result and for the shape of it.
    program, values, tree = opened(function, args)

    def nothing(*_: Any) -> list[Array]:
        return [jnp.zeros(v.shape, v.dtype) for v in program.out_avals]

    return jax.tree.unflatten(tree, jax.lax.cond(flag, operations(program), nothing, *values))
