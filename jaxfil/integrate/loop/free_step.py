"""Steps of lanes without contact.

In most iterations a lane only steps from one grid point to the next, on its own side of every
surface. This file computes such a step, tests whether it is event-free, and moves the lane to its
end. It makes no other decision: a step is event-free only where `loop.judge` would accept it too,
with the same numbers.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import stays_off
from jaxfil.integrate.contacts.guards import larger, surface_noise
from jaxfil.integrate.lane.extension import extensions_of
from jaxfil.integrate.lane.forcing_phase import next_period
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import FreeStep, LoopState
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.loop.halving import smooth_step, trust_after_free_step
from jaxfil.integrate.loop.path import is_clear, path_of
from jaxfil.integrate.steppers.error_estimate import may_be_too_long
from jaxfil.integrate.steppers.explicit import Trial, step, trial_of
from jaxfil.integrate.steppers.taylor import TaylorTableau
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system.components import all_finite, any_of, maximum, on_each, side_of, where
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.xla.select import select, select_all


def field_on_sides(problem: Problem, state: LoopState) -> ModeField:
    """The field on the current sides of a lane."""
    return ModeField(problem.system, side_of(state.motion.mode), blended=False, held=False)


def try_free_step(problem: Problem, state: LoopState, length: Length) -> FreeStep:
    """A trial step on the current sides of a lane. For a lane that slides it is computed on side
    +1, and not used."""
    system, tableau, h = problem.system, problem.tableau, length.h
    field = field_on_sides(problem, state)
    start, motion = problem.grid.t0 + state.motion.tau, state.motion
    forcing, path = system.forcing(start, h, tableau.times), None
    if isinstance(tableau, TaylorTableau):
        path = path_of(problem, state, length, field)
        trial = trial_of(tableau, path, jnp.ones_like(h), forcing)
        x, error, forcing = system.hold((trial.x, trial.error, trial.forcing))
        trial = Trial(x, error, forcing, path=path)
    else:
        trial = step(tableau, field, start, motion.x, motion.f, h, forcing)
    return end_of_free_step(problem, state, length, trial, path)


def end_of_free_step(
    problem: Problem,
    state: LoopState,
    length: Length,
    trial: Trial,
    path: Polynomial | None = None,
) -> FreeStep:
    """The end of a trial step on the current sides of a lane, with the path of the whole step if it
    is known."""
    system, sides, t = problem.system, side_of(state.motion.mode), problem.grid.t0 + length.end
    # The forcing at the end is known from the step, and is not computed again.
    f = system.hold(system.field(t, trial.x, sides, forcing=trial.forcing[-1]))
    value, slope = jax.jvp(system.switching, (t, trial.x), (jnp.ones_like(t), f))
    return FreeStep(trial, f, system.hold(sides * value), system.hold(sides * slope), path)


def is_near(problem: Problem, state: LoopState) -> Array:
    """Whether a lane slides or rests, is at or near a contact, or takes steps shorter than the
    grid's. With polynomial steps a surface that is not armed counts like any other."""
    near = state.held | state.pending.waits | (state.search.length != 0)
    # `stays_off` is for armed guards only. On a polynomial the zero at the start is divided out.
    if not isinstance(problem.tableau, TaylorTableau):
        near = near | any_of(~state.armed)
    # A shorter step does not end at a grid point, which `accept_free_step` assumes.
    return near | (state.trust.longest < jnp.inf)


def is_event_free(problem: Problem, state: LoopState, length: Length, free: FreeStep) -> Array:
    """Whether a step is event-free: the lane is on no surface, and no guard comes near zero."""
    x, h = free.trial.x, length.h
    t, size = problem.grid.t0 + length.end, larger(state.motion.scale, x)
    _, h_t, normals = problem.system.gradients(t, x)
    touch = surface_noise(problem.system, t, x, size, h_t, normals)
    clear = ~is_near(problem, state) & all_finite(x, free.f, free.g)
    taken = smooth_step(problem, state, h, free.f, free.trial)
    clear = clear & ~may_be_too_long(problem.tableau, taken)
    if free.path is not None:
        # The polynomial excludes a zero within the step. The guard at the end must also be beyond
        # the rounding within which a landing would take it for a contact or a graze.
        least = 4 * maximum(touch, where(state.armed, 0.0, state.motion.noise))
        off = is_clear(problem, state, length, free.path) & (free.g > least)
    else:
        ends = state.motion.g, h * state.motion.rate, free.g, h * free.rate
        off = on_each(stays_off, *ends, touch)
    return clear & ~any_of(~off)


def accept_free_step(
    problem: Problem, state: LoopState, length: Length, free: FreeStep, clear: Array
) -> LoopState:
    """The lane at the end of a step where it is `clear` of events, with its sample saved; the same
    lane otherwise."""
    x, one, before, counts = free.trial.x, clear.astype(jnp.int32), state.motion, state.counts
    moved = dataclasses.replace(
        before,
        tau=length.end,
        x=x,
        f=free.f,
        scale=larger(before.scale, x),
        g=stop_gradient(free.g),
        rate=free.rate,
    )
    after = dataclasses.replace(
        state,
        motion=select_all(clear, moved, before),
        # A grid point is a known time, and needs no low-order part.
        tau_low=select(clear, 0.0, state.tau_low),
        # At the end every guard is beyond its rounding (`is_event_free`), so all are armed.
        armed=state.armed | clear,
        trust=trust_after_free_step(state.trust, clear),
        counts=dataclasses.replace(
            counts,
            # The step is a whole one of the grid, since shorter ones are excluded in `is_near`.
            index=counts.index + one,
            num_iterations=counts.num_iterations + one,
            num_accepted=counts.num_accepted + one,
        ),
    )
    after = problem.recording.recorder.keep(problem, state, after, x, clear)
    each = extensions_of(problem, state)
    following = tuple(
        e.after_free_step(problem, state, after, own, free.path, clear) for e, own in each
    )
    return next_period(problem.grid, dataclasses.replace(after, extensions=following))
