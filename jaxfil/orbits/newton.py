"""Damped Newton iteration with a given Jacobian.

If the guess is traced, each lane of a batch has its own damping and outcome. For concrete numbers
the iteration is in Python, around functions that are compiled for other uses too.

A period map of a nonsmooth system is only piecewise smooth, and a step across a kink may increase
the residual although the direction is correct. A step is halved until the residual decreases, but
the shortest trial step is accepted in any case, which carries the iteration over the kink.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.kernel import kernel_if_it_fits, tree_in_kernel
from jaxfil.xla.known import is_known
from jaxfil.xla.select import select
from jaxfil.xla.thresholds import CONVERGED, RESIDUAL

# Steps are halved down to this fraction of the full one, which is then accepted in any case.
_SHORTEST = 1 / 32
# Number of steps without a new smallest residual that ends the search.
_PATIENCE = 6
# A full step below this power of eps, in the unknowns' scales, may be the rounding of the residual.
FLOOR = 2 / 3
# A full step above this power of eps, in the unknowns' scales, is useless: the Jacobian is zero in
# some direction, up to rounding.
_ENDLESS = -0.75


class Evaluation(eqx.Module):
    """M equations for N unknowns at a point, with M = N, or N − 1 before a constraint is appended:
    residual and Jacobian, the scales of the equations and of the unknowns, the outcome of the
    evaluation itself, and further data."""

    residual: Float[Array, " M"]
    jacobian: Float[Array, "M N"]
    equation_scale: Float[Array, " M"]
    unknown_scale: Float[Array, " N"]
    result: RESULTS
    aux: Any

    def size(self, scale: Array) -> Array:
        """The largest scaled residual; inf if it is not finite."""
        largest = jnp.max(abs(self.residual) / scale)
        return select(jnp.isfinite(largest), largest, jnp.inf)


class Stages(eqx.Module):
    """The evaluation of equations in two parts. The first has one form for concrete numbers, around
    programs that other calls share, and one for traced ones. `finish` assembles the equations from
    the unknowns and the result."""

    concrete: Callable[[Array], Any]
    traced: Callable[[Array], Any]
    finish: Callable[[Array, Any], Evaluation]


class _Finish(eqx.Module):
    """The last part of an evaluation, with `more` applied to the equations."""

    equations: Callable[[Array, Any], Evaluation]
    more: Callable[[Evaluation, Array], Evaluation]

    def __call__(self, z: Array, done: Any) -> Evaluation:
        return self.more(self.equations(z, done), z)


def as_it_is(at: Evaluation, z: Array) -> Evaluation:
    """The evaluation, unchanged."""
    return at


class Root(eqx.Module):
    """The end of Newton's iteration: the unknowns, the full step from there, the further data, the
    size of the residual, in the largest scales so far, and the outcome."""

    z: Float[Array, " N"]
    step: Float[Array, " N"]
    at: Evaluation
    size: Float[Array, ""]
    num_steps: Int[Array, ""]
    result: RESULTS


class _State(eqx.Module):
    """The last accepted point, its residual, the largest scales so far, the step there, and the
    search. Relative to its own scale the residual of a component that goes to zero would never
    decrease."""

    z: Array
    size: Array
    equation_scale: Array
    unknown_scale: Array
    step: Array
    length: Array  # of the step
    damping: Array
    least: Array  # the smallest residual so far
    patience: Array
    num_steps: Array
    running: Array
    result: RESULTS

    @property
    def trial(self) -> Array:
        """The end of the damped step."""
        return self.z + self.damping * self.step


def newton(
    evaluate: Callable[[Array], Evaluation], z: Float[Array, " N"], max_steps: Array | int
) -> Root:
    """A zero of the residual from the guess `z`, by at most `max_steps` evaluations.

    The outcome is `successful`, `newton_stalled`, `newton_singular`, `newton_max_steps_reached`,
    or the outcome of the evaluation at the guess if it fails.
    """
    # Traced once for two calls, for its shapes and in the loop.
    evaluate = eqx.filter_jit(evaluate)
    blank = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), eqx.filter_eval_shape(evaluate, z))

    def unfinished(carry: tuple[_State, Evaluation]) -> Array:
        state, _ = carry
        return state.running & (state.num_steps < max_steps)

    def iterate(carry: tuple[_State, Evaluation]) -> tuple[_State, Evaluation]:
        # The only evaluation of an iteration: a second one would double the program. The length of
        # a step is therefore tried by the next iteration.
        state, before = carry
        at = evaluate(state.trial)
        state, accepted = _judge(state, at, -_solve(at.jacobian, at.residual))
        return state, jax.tree.map(lambda u, v: select(accepted, u, v), at, before)

    last, at = jax.lax.while_loop(unfinished, iterate, (_first(z), blank))
    return Root(last.z, last.step, at, last.size, last.num_steps, last.result)


def root_of(
    stages: Stages,
    z: Float[Array, " N"],
    max_steps: Array | int,
    more: Callable[[Evaluation, Array], Evaluation] = as_it_is,
    *,
    known: bool,
) -> Root:
    """`newton` of an evaluation in stages, with `more` applied. If all inputs are `known`, the
    iteration is a loop in Python."""
    finish = _Finish(stages.finish, more)
    if known and is_known((z, more)):
        return _newton_of_known(stages, finish, z, int(max_steps))
    return newton(lambda z: finish(z, stages.traced(z)), z, max_steps)


def _newton_of_known(
    stages: Stages, finish: _Finish, z: Float[Array, " N"], max_steps: int
) -> Root:
    state, trial, at = _first_of_known(z), z, None
    for _ in range(max_steps):
        now = _finished(finish, trial, stages.concrete(trial))
        step = -solve_in_numpy(np.asarray(now.jacobian), np.asarray(now.residual))
        state, trial, flags = _judged(state, dataclasses.replace(now, aux=None), step)
        accepted, running = np.asarray(flags)
        at = now if accepted else at
        if not running:
            break
    assert at is not None  # the guess is always accepted
    return Root(state.z, state.step, at, state.size, state.num_steps, state.result)


@eqx.filter_jit
def _finished(finish: _Finish, z: Array, done: Any) -> Evaluation:
    return tree_in_kernel(lambda: finish(z, done))


def _first(z: Array) -> _State:
    """The state before the first evaluation."""
    zero = jnp.zeros((), jnp.int32)
    return _State(
        z=z,
        size=jnp.asarray(jnp.inf, z.dtype),
        equation_scale=jnp.zeros_like(z),
        unknown_scale=jnp.zeros_like(z),
        step=jnp.zeros_like(z),
        length=jnp.zeros((), z.dtype),
        damping=jnp.ones((), z.dtype),
        least=jnp.asarray(jnp.inf, z.dtype),
        patience=zero,
        num_steps=zero,
        running=jnp.ones((), bool),
        result=RESULTS.newton_max_steps_reached,
    )


# One program for all of its constants.
_first_of_known = jax.jit(_first)


def _judge(state: _State, at: Evaluation, step: Array) -> tuple[_State, Array]:
    """The next state after an evaluation at the end of the damped step with the full `step` there,
    and whether the damped step is accepted."""
    first, trial = state.num_steps == 0, state.trial
    # By a quarter of the decrease that the linear equations predict. A residual that is zero to
    # rounding does not decrease.
    eps = jnp.finfo(trial.dtype).eps
    scale = jnp.maximum(state.equation_scale, at.equation_scale)
    size = at.size(scale)
    falls = (size <= (1 - 0.25 * state.damping) * state.size) | (size <= RESIDUAL * eps)
    sound = (at.result == RESULTS.successful) & jnp.isfinite(size)
    # Shorter is useless: a residual that does not decrease along so short a step has a kink there.
    forced = state.damping <= _SHORTEST
    accepted = first | (sound & (falls | forced))
    # An unknown that is zero to half the digits of its earlier size is zero.
    largest = jnp.maximum(state.unknown_scale, at.unknown_scale)
    unknown_scale = jnp.maximum(jnp.sqrt(eps) * state.unknown_scale, at.unknown_scale)
    length = jnp.max(abs(step) / unknown_scale)
    # Not if the step is not finite, or so long that only rounding makes the Jacobian regular.
    solvable = length <= eps**_ENDLESS
    # The next step would be the error of this point, and is not taken.
    converged = accepted & sound & (length <= CONVERGED * eps)
    # A full step that is already short and cannot reduce the residual, whose rounding is larger.
    floor = ~accepted & (state.length <= eps**FLOOR) & (state.damping == 1)
    # An iteration that alternates across a kink does not reduce the residual in the long run.
    # Nor does one that is within the rounding of the largest scales.
    rest = jnp.max(abs(step) / largest)
    calm = (rest <= CONVERGED * eps) & (size <= CONVERGED * eps)
    better = accepted & (size < 0.9 * state.least) & ~calm
    patience = select(better, 0, state.patience + accepted.astype(jnp.int32))
    # At the guess there is no shorter step to return to.
    failed = first & ~sound
    singular = accepted & sound & ~solvable & ~converged
    stalled = (patience >= _PATIENCE) | (~accepted & forced)
    # An unknown that is zero may have the rounding of larger ones, which no step reduces.
    floor |= stalled & accepted & sound & calm
    result = RESULTS.where(stalled, RESULTS.newton_stalled, state.result)
    result = RESULTS.where(singular, RESULTS.newton_singular, result)
    unknown = failed & (at.result == RESULTS.successful)
    result = RESULTS.where(failed, at.result, result)
    result = RESULTS.where(unknown, RESULTS.nonfinite, result)
    result = RESULTS.where(converged | floor, RESULTS.successful, result)
    after = _State(
        z=select(accepted, trial, state.z),
        size=select(accepted, size, state.size),
        equation_scale=select(accepted, scale, state.equation_scale),
        unknown_scale=select(accepted, largest, state.unknown_scale),
        step=select(accepted & solvable, step, state.step),
        length=select(accepted, length, state.length),
        # Return to the full step soon, because only it converges quadratically.
        damping=select(accepted, jnp.minimum(1, 4 * state.damping), 0.5 * state.damping),
        least=select(accepted, jnp.minimum(size, state.least), state.least),
        patience=patience,
        num_steps=state.num_steps + 1,
        running=~(converged | floor | failed | singular | stalled),
        result=result,
    )
    return after, accepted


def _judged_with_trial(state: _State, at: Evaluation, step: Array) -> tuple[_State, Array, Array]:
    after, accepted = _judge(state, at, step)
    return after, after.trial, jnp.stack([accepted, after.running])


# As one kernel: compiled part by part it would take twice as long.
_judged = jax.jit(kernel_if_it_fits(_judged_with_trial))


def solve_in_numpy(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """X of A X = B, of one column or many, of concrete numbers; inf where A is singular. Compiling
    a factorisation would take longer than the whole iteration."""
    rows = np.max(abs(matrix), axis=1)
    rows = np.where(rows == 0, 1, rows)
    try:
        # A value that is not finite is an outcome, without a warning.
        with np.errstate(all="ignore"):
            return np.linalg.solve((matrix.T / rows).T, (right.T / rows).T)
    except np.linalg.LinAlgError:
        return np.full_like(right, np.inf)


def _solve(matrix: Array, right: Array) -> Array:
    """x of A x = b, not finite where A is singular to rounding."""
    # Rows are normalised, so that the units of the equations do not choose the pivots.
    rows = jnp.max(abs(matrix), axis=1, keepdims=True)
    scaled = matrix / select(rows == 0, 1, rows)
    return jnp.linalg.solve(scaled, right / select(rows == 0, 1, rows)[:, 0])
