"""`solve`: one initial value problem.

A system, an initial state, a time span and a step enter; a `Solution` leaves.
"""

import dataclasses
import math
from typing import Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.integrate import components
from jaxfil.integrate.components import Components
from jaxfil.integrate.loop import integrate
from jaxfil.integrate.recording import mode_codes
from jaxfil.integrate.solution import Dense, Solution, errors, events_of
from jaxfil.integrate.state import SAME_TIME, LoopState, Recording, SavedStates, TimeGrid
from jaxfil.integrate.stepper import checked, tableau
from jaxfil.model import check
from jaxfil.model.labels import labels_of
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.xla.kernel import kernel_if_it_fits

_FORWARD_ONLY = (
    "`adjoint` must be diffrax.RecursiveCheckpointAdjoint() for derivatives in reverse "
    "mode (jax.grad, jax.vjp), got diffrax.ForwardMode(), for those in forward mode (jax.jacfwd)."
)
# Steps that end this close to the end of the span (in steps) are its last.
_WHOLE = 1e-6


def solve(
    system: System,
    x0: Float[Array, " n"],
    t0: Array | float,
    t1: Array | float,
    dt: Array | float,
    *,
    stepper: Any = None,
    saveat: diffrax.SaveAt = diffrax.SaveAt(t1=True),  # noqa: B008
    max_events: int | None = 1024,
    max_steps: int | None = None,
    adjoint: Any = diffrax.ForwardMode(),  # noqa: B008
    throw: bool = True,
    estimate_error: bool = False,
) -> Solution:
    r"""Integrate a nonsmooth system from `x0` at `t0` to `t1`.

    ẋ = F(t, x, side), side_j = sgn H_j(t, x), in Filippov's sense where the solution stays on a
    surface. Steps have the fixed length `dt`; one is cut only at a contact, and the grid is met
    again after it. Contacts are located to a few eps and the order of the stepper is kept.

    **Arguments**

    - `x0`: initial state, shape (n,). Its dtype is that of the whole computation.
    - `t0`, `t1`: the span of time; backward if t1 < t0.
    - `dt`: the length of a step, positive, and more than 8 eps·max(|t0|, |t1|).
    - `stepper`: an explicit diffrax Runge–Kutta solver such as `diffrax.Tsit5()`, `RK4()`, or for
      stiff fields `Rodas5P()`; by default `diffrax.Dopri8()`.
    - `saveat`: `diffrax.SaveAt` with one of `t1`, `ts`, `steps`, `dense` (and `t0` with `steps`).
    - `max_events`: length of the event table; None keeps no table and sets no limit.
    - `max_steps`: budget of loop iterations (a contact takes about four). Needed where an array
      of that length is kept (`steps`, `dense`, reverse mode) and the span or `dt` is traced.
    - `adjoint`: `diffrax.ForwardMode()`, or `diffrax.RecursiveCheckpointAdjoint()` for reverse
      mode. Derivatives with respect to x0, t0, t1 and every float leaf of the system are exact
      through crossings, slides and resets.
    - `throw`: raise an error unless the outcome is `RESULTS.successful`; otherwise return it.
    - `estimate_error`: also run at half the step, and give the distance between the two as
      `errors`, an estimate of the global error; the cost is threefold. Needs `saveat` with `t1`
      or `ts`.

    **Returns** a `Solution`.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> sol = jf.solve(jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0]), 0.0, 20.0, 0.1)
    >>> print(round(float(sol.xs[-1, 0]), 4), int(sol.num_events))
    -0.2 4
    """
    x = check.state("x0", x0)
    dtype = x.dtype
    check.system("system", system)
    system = cast(system, dtype)
    labels = labels_of(system, x.shape[0])
    start, stop = check.scalar("t0", t0, dtype), check.scalar("t1", t1, dtype)
    length = check.scalar("dt", dt, dtype, positive=True)
    stepper = checked(stepper)
    save, ts = _save_kind(saveat, dtype)
    _check_ts(ts, start, stop)
    _check_pace(start, stop, length)
    max_events = check.count("max_events", max_events, optional=True)
    budget = check.count("max_steps", max_steps, optional=True)
    reverse = _is_reverse(adjoint)
    if budget is None and (save in ("steps", "dense") or reverse):
        budget = _default_budget(start, stop, length, max_events)
    if estimate_error and save not in ("t1", "ts"):
        raise ValueError(
            f"`estimate_error` must be False with a `saveat` of {save}: errors are estimated at "
            "times that do not depend on the step, t1 or ts; got True."
        )
    options = _Options(
        save=save,
        with_t0=saveat.subs is not None and bool(saveat.subs.t0),
        max_events=max_events,
        budget=budget,
        reverse=reverse,
        checkpoints=getattr(adjoint, "checkpoints", None),
    )
    sol = _solve(system, x, start, stop, length, ts, stepper, options)
    if estimate_error:
        system, x, start, stop, ts = _constant((system, x, start, stop, ts))
        half, options = length / 2, options.of_companion()
        companion = _solve(system, x, start, stop, half, ts, stepper, options)
        sol = eqx.tree_at(lambda s: s.errors, sol, errors(sol, companion), is_leaf=_is_none)
    sol = dataclasses.replace(sol, labels=labels)
    return _raise_unless_successful(sol) if throw else sol


def _constant(tree: Any) -> Any:
    """The same without derivatives."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), rest)


def _is_none(leaf: Any) -> bool:
    return leaf is None


class _Options(eqx.Module):
    save: str = eqx.field(static=True)
    with_t0: bool = eqx.field(static=True)
    max_events: int | None = eqx.field(static=True)
    budget: int | None = eqx.field(static=True)
    reverse: bool = eqx.field(static=True)
    checkpoints: int | None = eqx.field(static=True)

    def of_companion(self) -> "_Options":
        """Those of the run at half the step, which nothing differentiates."""
        budget = None if self.budget is None else 2 * self.budget
        return dataclasses.replace(self, budget=budget, reverse=False)


def _save_kind(saveat: Any, dtype: Any) -> tuple[str, Array | None]:
    """Which of t1, ts, steps and dense a `diffrax.SaveAt` asks for."""
    if not isinstance(saveat, diffrax.SaveAt):
        raise ValueError(f"`saveat` must be a diffrax.SaveAt, got {type(saveat).__name__}.")
    sub = saveat.subs
    if not isinstance(sub, diffrax.SubSaveAt | None):
        raise ValueError(f"`saveat` must have a single SubSaveAt, got {sub!r}.")
    asked = {"dense": bool(saveat.dense)}
    if sub is not None:  # diffrax leaves it out where only `dense` is asked for
        asked |= {"t1": bool(sub.t1), "ts": sub.ts is not None, "steps": bool(sub.steps)}
    kinds = [name for name, wanted in asked.items() if wanted]
    with_t0 = sub is not None and bool(sub.t0)
    if len(kinds) != 1 or (with_t0 and kinds != ["steps"]):
        raise ValueError(
            "`saveat` must ask for exactly one of t1=True, ts=…, steps=True, dense=True (and "
            f"t0=True only with steps=True), got {kinds + ['t0'] * with_t0}."
        )
    if kinds[0] != "ts":
        return kinds[0], None
    assert sub is not None
    ts = jnp.asarray(sub.ts, dtype)
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"`saveat.ts` must be of shape (k,) with k ≥ 1, got shape {ts.shape}.")
    return "ts", ts


def _check_ts(ts: Array | None, t0: Array, t1: Array) -> None:
    """Saving times lie in the span, in its direction; unknown while traced."""
    saved, start, stop = (check.concrete(v) for v in (ts, t0, t1))
    if ts is None or saved is None or start is None or stop is None:
        return
    if not bool(_valid_ts(ts, t0, t1)) and np.isfinite(start) and np.isfinite(stop):
        raise ValueError(
            f"`saveat.ts` must be times in order within the span from t0 = {start} to t1 = "
            f"{stop}, got {saved}."
        )


def _resolution(t0: Any, t1: Any, maximum: Any = jnp.maximum) -> Any:
    """Times of the span that are no further apart than this are one time."""
    return SAME_TIME * np.finfo(t0.dtype).eps * maximum(abs(t0), abs(t1))


def _check_pace(t0: Array, t1: Array, dt: Array) -> None:
    """A step is longer than what times of the span can tell apart; unknown while traced."""
    start, stop, pace = (check.concrete(v) for v in (t0, t1, dt))
    if start is None or stop is None or pace is None:
        return
    if not np.isfinite(start) or not np.isfinite(stop):
        return
    if pace <= (least := float(_resolution(start, stop, np.maximum))):
        raise ValueError(
            f"`dt` must be greater than {least:.2g}, the rounding of times from t0 = {start} to "
            f"t1 = {stop} in {t0.dtype}, got {pace}. Start at a t0 nearer to 0, or use float64."
        )


def _valid_ts(ts: Array, t0: Array, t1: Array) -> Array:
    sign = jnp.where(t1 < t0, -1.0, 1.0).astype(ts.dtype)
    inside = (sign * ts >= sign * t0) & (sign * ts <= sign * t1)
    return jnp.all(inside) & jnp.all(sign * jnp.diff(ts) >= 0)


def _is_reverse(adjoint: Any) -> bool:
    if isinstance(adjoint, diffrax.ForwardMode):
        return False
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return True
    raise ValueError(
        "`adjoint` must be diffrax.ForwardMode() or diffrax.RecursiveCheckpointAdjoint(), got "
        f"{adjoint!r}."
    )


def _default_budget(t0: Array, t1: Array, dt: Array, max_events: int | None) -> int:
    """Iterations enough for the span: each step, and six for each contact."""
    start, stop, pace = (check.concrete(v) for v in (t0, t1, dt))
    if start is None or stop is None or pace is None:
        raise ValueError(
            "`max_steps` must be an integer here: an array of that length is kept, and `t0`, `t1` "
            "or `dt` is traced, so that the number of steps is not known; got None."
        )
    steps = abs(stop - start) / pace
    return (math.ceil(steps) if np.isfinite(steps) else 1) + 6 * (max_events or 256) + 16


def _span(t0: Array, t1: Array, dt: Array, ts: Array | None, budget: int | None) -> TimeGrid:
    """The grid of a solve. Bad values that were traced, and so not seen at the door, make it NaN,
    which is an outcome."""
    length = t1 - t0
    valid = dt > _resolution(t0, t1)
    valid = valid if ts is None else valid & _valid_ts(ts, t0, t1)
    dt = jnp.where(valid, jax.lax.stop_gradient(dt), jnp.nan)
    steps = jax.lax.stop_gradient(abs(length) / dt)
    # A span of more steps than an int32 holds ends as a budget used up, never as a wrapped number.
    num_steps = jnp.clip(jnp.ceil(steps - _WHOLE), 1, 2**30).astype(jnp.int32)
    ample = 32 * jnp.minimum(num_steps, 2**25) + 100_000
    iterations = ample if budget is None else jnp.asarray(budget, jnp.int32)
    return TimeGrid(t0, length, jnp.where(length < 0, -dt, dt), num_steps, iterations)


@eqx.filter_jit
def _solve(system, x0, t0, t1, dt, ts, stepper, options: _Options) -> Solution:
    scene_ = components.build(system, x0)
    span = _span(t0, t1, dt, ts, options.budget)
    kind = {"t1": "none", "ts": "ts", "steps": "steps", "dense": "steps"}[options.save]
    num_saves = {"none": 0, "ts": 0 if ts is None else ts.shape[0], "steps": options.budget}[kind]
    policy = Recording(kind, options.max_events, None if ts is None else ts - t0)
    adjoint: dict[str, Any] = {}
    if options.reverse:
        checkpoints, budget = options.checkpoints, options.budget
        adjoint = dict(kind="checkpointed", checkpoints=checkpoints, max_iterations=budget)

    def run(x: Components) -> LoopState:
        # With what the outcome makes of the end: its derivatives need no values from elsewhere.
        lane = integrate(
            scene_, tableau(stepper), span, policy, x, num_saves=num_saves or 0, **adjoint
        )
        return _ended(scene_, span, lane)

    lane = (run if options.reverse else kernel_if_it_fits(run))(components.unpack(x0))
    sol = _solution(scene_, span, lane, options, system, x0, stepper)
    return sol if options.reverse else eqxi.nondifferentiable_backward(sol, msg=_FORWARD_ONLY)


def _ended(scene_, span: TimeGrid, lane: LoopState) -> LoopState:
    """A finished lane; one that has kept nothing with its end, infinite unless it is the end asked
    for."""
    if lane.saves is not None:
        return lane
    done = lane.result == RESULTS.successful
    t, x = span.t0 + lane.tau, components.pack(lane.x, scene_.dtype)
    end = SavedStates(
        jnp.where(done, t, jnp.inf)[None],
        jnp.where(done, x, jnp.inf)[None],
        mode_codes(lane.mode)[None],
    )
    return eqx.tree_at(lambda lane: lane.saves, lane, end, is_leaf=_is_none)


def _solution(
    scene_, span: TimeGrid, lane: LoopState, options: _Options, system, x0, stepper
) -> Solution:
    """The result of a finished lane, as the user sees it."""
    t_final, x_final = span.t0 + lane.tau, components.pack(lane.x, scene_.dtype)
    assert lane.saves is not None
    dense = None
    ts, xs, modes = lane.saves.ts, lane.saves.xs, lane.saves.modes
    if options.with_t0 or options.save == "dense":
        ts, xs = jnp.append(span.t0[None], ts), jnp.append(x0[None], xs, axis=0)
        modes = jnp.append(mode_codes(lane.first_mode)[None], modes, axis=0)
    if options.save == "dense":
        dense = Dense(system, span.t0, t_final, ts, xs, modes, stepper)
        ts = xs = modes = None
    return Solution(
        ts=ts,
        xs=xs,
        modes=modes,
        events=events_of(lane.table),
        num_events=lane.num_events,
        result=lane.result,
        stats={
            "num_steps": lane.num_accepted,
            "num_iterations": lane.num_iterations,
            "num_saved": lane.num_saved,
        },
        t_final=t_final,
        x_final=x_final,
        mode_final=mode_codes(lane.mode),
        _dense=dense,
    )


def _raise_unless_successful(sol: Solution) -> Solution:
    """The same solution, or an error with the sentence of its outcome."""
    return sol.result.error_if(sol, sol.result != RESULTS.successful)
