"""The switch-model loop: one lane from a state to a later one, through every contact.

A scene, a tableau, a `TimeGrid` and a `Recording` enter; the `LoopState` at the end leaves, with what was kept
on the way. Batches come from `vmap`: every lane has its own clock in the one loop and waits for
nobody.

An iteration takes one smooth step in the current mode and does one of four things with it: accepts
it, if it can be trusted; rejects it, and cuts the next one at the contact the step has run over;
*lands*, if it has ended on a contact, with one Newton correction in time; or, in the iteration
after a landing, which has length zero, *switches*: resets, chooses the mode at the corrected state,
and goes on.

Derivatives. The lengths found by the search for contacts are constants; the Newton correction
x += δf, t += δ, δ = −g/ġ is not. Differentiating it, with the new mode's field taken at the
corrected state, is the saltation matrix.
"""

import functools as ft
from typing import Literal

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate import filippov
from jaxfil.integrate.components import (
    Components,
    ComponentSystem,
    Forcing,
    all_finite,
    any_of,
    axpy,
    where,
)
from jaxfil.integrate.event_location import NEVER, land, missing_time, search
from jaxfil.integrate.initial_mode import initial_state
from jaxfil.integrate.mode_switch import look, rearm_guards
from jaxfil.integrate.recording import keep_sample, record_event, save_state
from jaxfil.integrate.state import (
    FreeStep,
    LoopState,
    Recording,
    StepEnd,
    TimeGrid,
    is_running,
    later,
)
from jaxfil.integrate.stepper import Tableau, is_too_long, step
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.kernel import kernel_if_it_fits

Trial = tuple[Components, Components]
"""The end of a trial step, and what is known of its error: see `stepper.step`."""

# This many contacts in a row, each at the time of the last, are an accumulation.
_FROZEN = 12
# What an iteration does with its trial step.
_IDLE, _REJECT, _ACCEPT, _LAND, _TOUCH, _SWITCH, _FAIL = map(float, range(7))
# What can go wrong in it, in the order in which it is told.
_FAILURES = (
    RESULTS.nonfinite,
    RESULTS.max_events_reached,
    RESULTS.nonunique,
    RESULTS.undeclared_sliding,
    RESULTS.mode_undecided,
    RESULTS.zeno,
    RESULTS.step_too_long,
)
# Trial steps rejected in a row before the search for a contact is given up.
_TRIES = 60


class Length(eqx.Module):
    """How far a trial step goes (signed), and what is at its end."""

    h: Array
    end: Array  # elapsed time
    room: Array  # from there to the next grid or saving time
    cutting: Array  # an expected contact
    gridded: Array  # a grid point
    saving: Array  # a time to be saved


def choose_length(
    system: ComponentSystem, grid: TimeGrid, recording: Recording, state: LoopState
) -> Length:
    """To the next grid point or saving time, or to the contact expected before it."""
    target, gridded, saving = grid.grid_point(state.index + 1), True, jnp.zeros((), bool)
    if recording.save == "ts":
        assert recording.ts is not None
        count = recording.ts.shape[0]
        at = recording.ts[jnp.minimum(state.num_saved, count - 1)]
        ahead = (at - target) * grid.direction
        same = grid.same_time(target)
        saving = (state.num_saved < count) & (ahead <= same)
        gridded = ~saving | (ahead >= -same)
        target = jnp.where(gridded, target, at)
    full = target - state.tau
    if system.m == 0:
        return Length(full, target, full * 0, saving & False, (saving & False) | gridded, saving)
    full = full - state.rest
    cutting = (state.cut != 0) & (abs(state.cut) < abs(full)) & ~state.pending
    whole = ~state.pending & ~cutting
    h = jnp.where(cutting, state.cut, jnp.where(state.pending, 0.0, full))
    end = jnp.where(whole, target, state.tau + h)
    return Length(h, end, full - h, cutting, gridded & whole, saving & whole)


def _action(
    system, recording, state: LoopState, on, step_end: StepEnd, found, landing, frozen, tries, gross
) -> Array:
    """What to do with a trial step, or the number of the failure it has met, as one float: all that
    follows needs nothing else of what went into it."""
    action = jnp.where(found.theta < NEVER, _REJECT, _ACCEPT)
    action = jnp.where(landing.landed, jnp.where(landing.touched, _TOUCH, _LAND), action)
    action = jnp.where(state.pending, _SWITCH, action)
    failures = [~all_finite(step_end.x, step_end.f, step_end.g, (found.theta,))]
    if recording.max_events is None:
        failures.append(jnp.zeros((), bool))
    else:
        failures.append(state.pending & (state.num_events >= recording.max_events))
    stuck = step_end.repels & ((found.theta >= NEVER) | state.pending)
    failures.append((step_end.num_modes > 1) | stuck)
    failures.append(
        jnp.zeros((), bool) if system.slides else any_of(tuple(s == 0 for s in step_end.mode))
    )
    failures.append((step_end.num_modes == 0) | (tries > _TRIES))
    failures.append(frozen >= _FROZEN)
    failures.append(gross & ~state.pending & (landing.landed | (found.theta >= NEVER)))
    for number, failed in reversed(list(enumerate(failures))):
        action = jnp.where(failed, _FAIL + number, action)
    action = jnp.where(on, action, _IDLE)
    (action,) = system.hold(action.astype(system.dtype))
    return action


def _outcome(action: Array, result: RESULTS) -> RESULTS:
    for number, outcome in enumerate(_FAILURES):
        result = RESULTS.where(action == _FAIL + number, outcome, result)
    return result


def advance(
    system: ComponentSystem, table: Tableau, grid: TimeGrid, recording: Recording, state: LoopState
) -> LoopState:
    """One iteration. A lane that has come to its end stays as it is."""
    length = choose_length(system, grid, recording, state)
    forcing = system.forcing(grid.t0 + state.tau, length.h, table.times)
    trial = follow(system, table, grid, state, length, forcing)
    if system.m == 0:
        return _accept_smooth(system, table, grid, recording, state, length, trial, forcing)
    return judge(system, table, grid, recording, state, length, trial, forcing)


def follow(
    system: ComponentSystem,
    table: Tableau,
    grid: TimeGrid,
    state: LoopState,
    length: Length,
    forcing: list[Forcing],
) -> Trial:
    """A trial step in the lane's mode."""

    def field(t, x, forcing=None):
        return filippov.field(system, t, x, state.mode, forcing)

    t = grid.t0 + state.tau
    return step(table, field, forcing, t, state.x, state.f, length.h, system.once)


def judge(
    system: ComponentSystem,
    table: Tableau,
    grid: TimeGrid,
    recording: Recording,
    state: LoopState,
    length: Length,
    trial: Trial,
    forcing: list[Forcing],
    ahead: FreeStep | None = None,
) -> LoopState:
    """The lane after a trial step: accepted, rejected, landed or switched. What is known `ahead` is
    as in `look`."""
    x = where(state.pending, state.x, trial[0])
    step_end = look(system, grid, state, length.end, x, forcing[-1], ahead)
    found = search(system, grid, state, step_end, length.h, length.cutting)
    landing = land(system, grid, state, step_end, length.h, length.room, length.cutting)
    gross = is_too_long(table, trial[1], step_end.f, length.h, step_end.size)
    return _decide(system, grid, recording, state, length, step_end, found, landing, gross)


def _decide(
    system,
    grid,
    recording,
    state: LoopState,
    length: Length,
    step_end: StepEnd,
    found,
    landing,
    gross,
) -> LoopState:
    """Accept, reject, land or switch."""
    tries = jnp.where(found.theta < NEVER, state.tries + 1, 0)
    # A flight this short cannot be told from the correction that ends it.
    again = abs(step_end.tau - state.contact_tau) <= 4 * grid.same_time(step_end.tau)
    frozen = jnp.where(state.pending, jnp.where(again, state.frozen + 1, 0), state.frozen)
    on = is_running(grid, state)
    action = _action(system, recording, state, on, step_end, found, landing, frozen, tries, gross)
    landed, rejected = (action == _LAND) | (action == _TOUCH), action == _REJECT
    accepted, switched = action == _ACCEPT, action == _SWITCH

    # A step to a saving time that is no grid point is looked at and taken back.
    saving, gridded = length.saving & accepted, length.gridded & accepted
    moved = (switched | accepted) & ~(saving & ~gridded)
    lands = landed

    g, rate, armed, noise = rearm_guards(system, grid, state, step_end)
    landed_noise = where(action == _TOUCH, step_end.touch, step_end.noise)
    # A cut of length zero would be none.
    least = 1e-6 * grid.same_time(state.tau) * grid.direction
    cut = found.theta * length.h
    cut = jnp.where(abs(cut) < abs(least), least, cut)
    # A step that has ended just short of its contact: Newton says how much is missing.
    ahead = jnp.where(length.cutting & accepted, missing_time(grid, state, step_end), 0.0)
    index = state.index + gridded.astype(jnp.int32)
    h = jnp.where(lands, length.h + landing.delta, jnp.where(moved, length.h, 0.0))
    tau, rest = later(state.tau, state.rest, h)
    after = LoopState(
        tau=jnp.where(gridded, step_end.tau, tau),
        rest=jnp.where(gridded, 0.0, rest),
        x=where(
            moved, step_end.x, where(lands, axpy(step_end.x, landing.delta, step_end.f), state.x)
        ),
        size=where(moved, step_end.size, state.size),
        f=where(moved, step_end.f, state.f),
        mode=where(moved, step_end.mode, state.mode),
        first_mode=state.first_mode,
        g=where(moved, g, state.g),
        rate=where(moved, rate, where(lands, step_end.rate, state.rate)),
        armed=where(moved, armed, state.armed),
        noise=where(lands, landed_noise, where(moved, noise, state.noise)),
        cut=stop_gradient(jnp.where(rejected, cut, jnp.where(moved, ahead, state.cut))),
        aim=where(rejected, found.surfaces, state.aim),
        pending=lands | (state.pending & ~moved),
        hit=where(lands, landing.surfaces, state.hit),
        graze=jnp.where(lands, action == _TOUCH, state.graze),
        index=index,
        tries=jnp.where(rejected, state.tries + 1, 0),
        frozen=jnp.where(switched, frozen, state.frozen),
        contact_tau=jnp.where(switched, stop_gradient(step_end.tau), state.contact_tau),
        num_iterations=state.num_iterations + on.astype(jnp.int32),
        num_accepted=state.num_accepted + (moved & accepted).astype(jnp.int32),
        num_events=state.num_events + switched.astype(jnp.int32),
        num_saved=state.num_saved,
        result=_outcome(action, state.result),
        table=record_event(system, grid, state, step_end, switched),
        saves=state.saves,
    )
    return _keep(system, grid, recording, state, after, step_end, moved, gridded, saving)


def _accept_smooth(
    system,
    table,
    grid,
    recording,
    state: LoopState,
    length: Length,
    trial: Trial,
    forcing: list[Forcing],
) -> LoopState:
    """The whole of an iteration where there are no surfaces."""
    step_end = look(system, grid, state, length.end, trial[0], forcing[-1])
    on = is_running(grid, state)
    finite = all_finite(step_end.x, step_end.f)
    ok = finite & ~is_too_long(table, trial[1], step_end.f, length.h, step_end.size) & on
    saving, gridded = length.saving & ok, length.gridded & ok
    moved = ok & ~(saving & ~gridded)
    after = eqx.tree_at(
        lambda state: (
            state.tau,
            state.x,
            state.f,
            state.size,
            state.index,
            state.num_iterations,
            state.num_accepted,
        ),
        state,
        (
            jnp.where(moved, step_end.tau, state.tau),
            where(moved, step_end.x, state.x),
            where(moved, step_end.f, state.f),
            where(moved, step_end.size, state.size),
            state.index + gridded.astype(jnp.int32),
            state.num_iterations + on.astype(jnp.int32),
            state.num_accepted + moved.astype(jnp.int32),
        ),
    )
    failure = RESULTS.where(finite, RESULTS.step_too_long, RESULTS.nonfinite)
    result = RESULTS.where(ok | ~on, state.result, failure)
    after = eqx.tree_at(lambda state: state.result, after, result)
    return _keep(system, grid, recording, state, after, step_end, moved, gridded, saving)


def _keep(
    system, grid, recording, state, after: LoopState, step_end: StepEnd, moved, gridded, saving
) -> LoopState:
    """`after` with the state of `step_end` saved, if the policy says so."""
    if recording.save == "none":
        return after
    if recording.save == "samples":
        return keep_sample(recording, state, after, step_end.x, gridded)
    if recording.save == "steps":
        saving = moved
    saves = save_state(system, grid, state, step_end, saving)
    return eqx.tree_at(
        lambda state: (state.saves, state.num_saved),
        after,
        (saves, state.num_saved + saving.astype(jnp.int32)),
    )


def integrate(
    system: ComponentSystem,
    table: Tableau,
    grid: TimeGrid,
    recording: Recording,
    x0: Components,
    *,
    num_saves: int = 0,
    kind: Literal["lax", "checkpointed"] = "lax",
    checkpoints: int | None = None,
    max_iterations: int | None = None,
) -> LoopState:
    """Run the loop from x0 to the end of `span`, or to the first failure.

    `kind="checkpointed"` allows reverse-mode derivatives and needs a static `max_iterations`.
    """
    first = initial_state(system, grid, recording, x0, num_saves)
    body, on = ft.partial(advance, system, table, grid, recording), ft.partial(is_running, grid)
    if kind == "lax":
        state = jax.lax.while_loop(lambda state: eqxi.unvmap_any(on(state)), body, first)
        return finish(grid, state)
    records = [name for name in ("table", "saves") if getattr(first, name) is not None]

    def buffers(state: LoopState) -> list:
        return [v for name in records for v in vars(getattr(state, name)).values()]

    state = eqxi.while_loop(
        on,
        body,
        first,
        kind=kind,
        buffers=buffers,
        max_steps=max_iterations,
        checkpoints=checkpoints,
    )
    return finish(grid, state)


def integrate_in_kernel(
    system: ComponentSystem, table: Tableau, grid: TimeGrid, recording: Recording, x0: Components
) -> LoopState:
    """`integrate`, on a processor as one kernel if all of it fits into one: see `kernel`."""
    return kernel_if_it_fits(ft.partial(integrate, system, table, grid, recording))(x0)


def finish(grid: TimeGrid, state: LoopState) -> LoopState:
    """A lane that no longer runs, told why if it has not come to its end."""
    spent = (state.index < grid.num_steps) & (state.result == RESULTS.successful)
    result = RESULTS.where(spent, RESULTS.max_steps_reached, state.result)
    return eqx.tree_at(lambda state: state.result, state, result)
