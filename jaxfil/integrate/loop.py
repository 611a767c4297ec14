"""The switch-model loop: one lane from a state to a later one, through every contact.

A scene, a tableau, a `Span` and a `Policy` enter; the `Lane` at the end leaves, with what was kept
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
from jaxfil.integrate.components import Blocks, Forcing, Scene, all_finite, any_of, axpy, where
from jaxfil.integrate.event_location import NEVER, land, missing_time, search
from jaxfil.integrate.initial_mode import begin
from jaxfil.integrate.mode_switch import departure, look
from jaxfil.integrate.recording import keep_sample, record_event, save_state
from jaxfil.integrate.state import Ahead, Lane, Policy, Span, View, later, running
from jaxfil.integrate.stepper import Tableau, is_too_long, step
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.kernel import kernel_if_it_fits

Trial = tuple[Blocks, Blocks]
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


def choose_length(scene: Scene, span: Span, policy: Policy, lane: Lane) -> Length:
    """To the next grid point or saving time, or to the contact expected before it."""
    target, gridded, saving = span.grid_point(lane.index + 1), True, jnp.zeros((), bool)
    if policy.save == "ts":
        assert policy.ts is not None
        count = policy.ts.shape[0]
        at = policy.ts[jnp.minimum(lane.num_saved, count - 1)]
        ahead = (at - target) * span.direction
        same = span.same_time(target)
        saving = (lane.num_saved < count) & (ahead <= same)
        gridded = ~saving | (ahead >= -same)
        target = jnp.where(gridded, target, at)
    full = target - lane.tau
    if scene.m == 0:
        return Length(full, target, full * 0, saving & False, (saving & False) | gridded, saving)
    full = full - lane.rest
    cutting = (lane.cut != 0) & (abs(lane.cut) < abs(full)) & ~lane.pending
    whole = ~lane.pending & ~cutting
    h = jnp.where(cutting, lane.cut, jnp.where(lane.pending, 0.0, full))
    end = jnp.where(whole, target, lane.tau + h)
    return Length(h, end, full - h, cutting, gridded & whole, saving & whole)


def _action(
    scene, policy, lane: Lane, on, view: View, found, landing, frozen, tries, gross
) -> Array:
    """What to do with a trial step, or the number of the failure it has met, as one float: all that
    follows needs nothing else of what went into it."""
    action = jnp.where(found.theta < NEVER, _REJECT, _ACCEPT)
    action = jnp.where(landing.landed, jnp.where(landing.touched, _TOUCH, _LAND), action)
    action = jnp.where(lane.pending, _SWITCH, action)
    failures = [~all_finite(view.x, view.f, view.g, (found.theta,))]
    if policy.max_events is None:
        failures.append(jnp.zeros((), bool))
    else:
        failures.append(lane.pending & (lane.num_events >= policy.max_events))
    stuck = view.repels & ((found.theta >= NEVER) | lane.pending)
    failures.append((view.num_modes > 1) | stuck)
    failures.append(
        jnp.zeros((), bool) if scene.slides else any_of(tuple(s == 0 for s in view.mode))
    )
    failures.append((view.num_modes == 0) | (tries > _TRIES))
    failures.append(frozen >= _FROZEN)
    failures.append(gross & ~lane.pending & (landing.landed | (found.theta >= NEVER)))
    for number, failed in reversed(list(enumerate(failures))):
        action = jnp.where(failed, _FAIL + number, action)
    action = jnp.where(on, action, _IDLE)
    (action,) = scene.hold(action.astype(scene.dtype))
    return action


def _outcome(action: Array, result: RESULTS) -> RESULTS:
    for number, outcome in enumerate(_FAILURES):
        result = RESULTS.where(action == _FAIL + number, outcome, result)
    return result


def advance(scene: Scene, table: Tableau, span: Span, policy: Policy, lane: Lane) -> Lane:
    """One iteration. A lane that has come to its end stays as it is."""
    length = choose_length(scene, span, policy, lane)
    forcing = scene.forcing(span.t0 + lane.tau, length.h, table.times)
    trial = follow(scene, table, span, lane, length, forcing)
    if scene.m == 0:
        return _accept_smooth(scene, table, span, policy, lane, length, trial, forcing)
    return judge(scene, table, span, policy, lane, length, trial, forcing)


def follow(
    scene: Scene, table: Tableau, span: Span, lane: Lane, length: Length, forcing: list[Forcing]
) -> Trial:
    """A trial step in the lane's mode."""

    def field(t, x, forcing=None):
        return filippov.field(scene, t, x, lane.mode, forcing)

    t = span.t0 + lane.tau
    return step(table, field, forcing, t, lane.x, lane.f, length.h, scene.once)


def judge(
    scene: Scene,
    table: Tableau,
    span: Span,
    policy: Policy,
    lane: Lane,
    length: Length,
    trial: Trial,
    forcing: list[Forcing],
    ahead: Ahead | None = None,
) -> Lane:
    """The lane after a trial step: accepted, rejected, landed or switched. What is known `ahead` is
    as in `look`."""
    x = where(lane.pending, lane.x, trial[0])
    view = look(scene, span, lane, length.end, x, forcing[-1], ahead)
    found = search(scene, span, lane, view, length.h, length.cutting)
    landing = land(scene, span, lane, view, length.h, length.room, length.cutting)
    gross = is_too_long(table, trial[1], view.f, length.h, view.size)
    return _decide(scene, span, policy, lane, length, view, found, landing, gross)


def _decide(
    scene, span, policy, lane: Lane, length: Length, view: View, found, landing, gross
) -> Lane:
    """Accept, reject, land or switch."""
    tries = jnp.where(found.theta < NEVER, lane.tries + 1, 0)
    # A flight this short cannot be told from the correction that ends it.
    again = abs(view.tau - lane.contact_tau) <= 4 * span.same_time(view.tau)
    frozen = jnp.where(lane.pending, jnp.where(again, lane.frozen + 1, 0), lane.frozen)
    on = running(span, lane)
    action = _action(scene, policy, lane, on, view, found, landing, frozen, tries, gross)
    landed, rejected = (action == _LAND) | (action == _TOUCH), action == _REJECT
    accepted, switched = action == _ACCEPT, action == _SWITCH

    # A step to a saving time that is no grid point is looked at and taken back.
    saving, gridded = length.saving & accepted, length.gridded & accepted
    moved = (switched | accepted) & ~(saving & ~gridded)
    lands = landed

    g, rate, armed, noise = departure(scene, span, lane, view)
    landed_noise = where(action == _TOUCH, view.touch, view.noise)
    # A cut of length zero would be none.
    least = 1e-6 * span.same_time(lane.tau) * span.direction
    cut = found.theta * length.h
    cut = jnp.where(abs(cut) < abs(least), least, cut)
    # A step that has ended just short of its contact: Newton says how much is missing.
    ahead = jnp.where(length.cutting & accepted, missing_time(span, lane, view), 0.0)
    index = lane.index + gridded.astype(jnp.int32)
    h = jnp.where(lands, length.h + landing.delta, jnp.where(moved, length.h, 0.0))
    tau, rest = later(lane.tau, lane.rest, h)
    after = Lane(
        tau=jnp.where(gridded, view.tau, tau),
        rest=jnp.where(gridded, 0.0, rest),
        x=where(moved, view.x, where(lands, axpy(view.x, landing.delta, view.f), lane.x)),
        size=where(moved, view.size, lane.size),
        f=where(moved, view.f, lane.f),
        mode=where(moved, view.mode, lane.mode),
        first_mode=lane.first_mode,
        g=where(moved, g, lane.g),
        rate=where(moved, rate, where(lands, view.rate, lane.rate)),
        armed=where(moved, armed, lane.armed),
        noise=where(lands, landed_noise, where(moved, noise, lane.noise)),
        cut=stop_gradient(jnp.where(rejected, cut, jnp.where(moved, ahead, lane.cut))),
        aim=where(rejected, found.surfaces, lane.aim),
        pending=lands | (lane.pending & ~moved),
        hit=where(lands, landing.surfaces, lane.hit),
        graze=jnp.where(lands, action == _TOUCH, lane.graze),
        index=index,
        tries=jnp.where(rejected, lane.tries + 1, 0),
        frozen=jnp.where(switched, frozen, lane.frozen),
        contact_tau=jnp.where(switched, stop_gradient(view.tau), lane.contact_tau),
        num_iterations=lane.num_iterations + on.astype(jnp.int32),
        num_accepted=lane.num_accepted + (moved & accepted).astype(jnp.int32),
        num_events=lane.num_events + switched.astype(jnp.int32),
        num_saved=lane.num_saved,
        result=_outcome(action, lane.result),
        table=record_event(scene, span, lane, view, switched),
        saves=lane.saves,
    )
    return _keep(scene, span, policy, lane, after, view, moved, gridded, saving)


def _accept_smooth(
    scene, table, span, policy, lane: Lane, length: Length, trial: Trial, forcing: list[Forcing]
) -> Lane:
    """The whole of an iteration where there are no surfaces."""
    view = look(scene, span, lane, length.end, trial[0], forcing[-1])
    on = running(span, lane)
    finite = all_finite(view.x, view.f)
    ok = finite & ~is_too_long(table, trial[1], view.f, length.h, view.size) & on
    saving, gridded = length.saving & ok, length.gridded & ok
    moved = ok & ~(saving & ~gridded)
    after = eqx.tree_at(
        lambda lane: (
            lane.tau,
            lane.x,
            lane.f,
            lane.size,
            lane.index,
            lane.num_iterations,
            lane.num_accepted,
        ),
        lane,
        (
            jnp.where(moved, view.tau, lane.tau),
            where(moved, view.x, lane.x),
            where(moved, view.f, lane.f),
            where(moved, view.size, lane.size),
            lane.index + gridded.astype(jnp.int32),
            lane.num_iterations + on.astype(jnp.int32),
            lane.num_accepted + moved.astype(jnp.int32),
        ),
    )
    failure = RESULTS.where(finite, RESULTS.step_too_long, RESULTS.nonfinite)
    result = RESULTS.where(ok | ~on, lane.result, failure)
    after = eqx.tree_at(lambda lane: lane.result, after, result)
    return _keep(scene, span, policy, lane, after, view, moved, gridded, saving)


def _keep(scene, span, policy, lane, after: Lane, view: View, moved, gridded, saving) -> Lane:
    """`after` with the state of `view` saved, if the policy says so."""
    if policy.save == "none":
        return after
    if policy.save == "samples":
        return keep_sample(policy, lane, after, view.x, gridded)
    if policy.save == "steps":
        saving = moved
    saves = save_state(scene, span, lane, view, saving)
    return eqx.tree_at(
        lambda lane: (lane.saves, lane.num_saved),
        after,
        (saves, lane.num_saved + saving.astype(jnp.int32)),
    )


def integrate(
    scene: Scene,
    table: Tableau,
    span: Span,
    policy: Policy,
    x0: Blocks,
    *,
    num_saves: int = 0,
    kind: Literal["lax", "checkpointed"] = "lax",
    checkpoints: int | None = None,
    max_iterations: int | None = None,
) -> Lane:
    """Run the loop from x0 to the end of `span`, or to the first failure.

    `kind="checkpointed"` allows reverse-mode derivatives and needs a static `max_iterations`.
    """
    first = begin(scene, span, policy, x0, num_saves)
    body, on = ft.partial(advance, scene, table, span, policy), ft.partial(running, span)
    if kind == "lax":
        lane = jax.lax.while_loop(lambda lane: eqxi.unvmap_any(on(lane)), body, first)
        return finish(span, lane)
    records = [name for name in ("table", "saves") if getattr(first, name) is not None]

    def buffers(lane: Lane) -> list:
        return [v for name in records for v in vars(getattr(lane, name)).values()]

    lane = eqxi.while_loop(
        on,
        body,
        first,
        kind=kind,
        buffers=buffers,
        max_steps=max_iterations,
        checkpoints=checkpoints,
    )
    return finish(span, lane)


def integrate_whole(scene: Scene, table: Tableau, span: Span, policy: Policy, x0: Blocks) -> Lane:
    """`integrate`, on a processor as one kernel if all of it fits into one: see `kernel`."""
    return kernel_if_it_fits(ft.partial(integrate, scene, table, span, policy))(x0)


def finish(span: Span, lane: Lane) -> Lane:
    """A lane that no longer runs, told why if it has not come to its end."""
    spent = (lane.index < span.num_steps) & (lane.result == RESULTS.successful)
    result = RESULTS.where(spent, RESULTS.max_steps_reached, lane.result)
    return eqx.tree_at(lambda lane: lane.result, lane, result)
