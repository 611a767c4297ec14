"""What `solve` is asked for besides the problem: what to save, how far to go, which derivatives.

The arguments as the user gave them enter; `Options` leave, or a `ValueError` that names the
argument, what it must be and what it was.
"""

import dataclasses
import math
from typing import Any, TypeAlias

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.problem import SAME_TIME
from jaxfil.model import check

Adjoint: TypeAlias = diffrax.ForwardMode | diffrax.RecursiveCheckpointAdjoint
"""Which derivatives a solve has: forward mode, or reverse mode from a loop with checkpoints."""

FORWARD_ONLY = (
    "`adjoint` must be diffrax.RecursiveCheckpointAdjoint() for derivatives in reverse "
    "mode (jax.grad, jax.vjp), got diffrax.ForwardMode(), for those in forward mode (jax.jacfwd)."
)
# Contacts that a default budget leaves room for where their number has no limit.
_MANY_EVENTS = 256


class Options(eqx.Module):
    """What to save ("t1", "ts", "steps" or "dense", with the state at t0 or without it), the limits
    on contacts and iterations, and the checkpoints of reverse mode."""

    save: str = eqx.field(static=True)
    with_t0: bool = eqx.field(static=True)
    max_events: int | None = eqx.field(static=True)
    budget: int | None = eqx.field(static=True)
    reverse: bool = eqx.field(static=True)
    checkpoints: int | None = eqx.field(static=True)
    ts: Array | None

    @property
    def num_saves(self) -> int:
        """Space needed for what is saved on the way."""
        if self.ts is not None:
            return self.ts.shape[0]
        return self.budget or 0 if self.save in ("steps", "dense") else 0

    def at_half_the_step(self) -> "Options":
        """Those of the run at half the step, which nothing differentiates."""
        budget = None if self.budget is None else 2 * self.budget
        return dataclasses.replace(self, budget=budget, reverse=False)


def options_of(
    saveat: diffrax.SaveAt,
    max_events: int | None,
    max_steps: int | None,
    adjoint: Adjoint,
    span: tuple[Array, Array, Array],
) -> Options:
    """The options of a solve over the span (t0, t1, dt)."""
    t0, t1, _ = span
    save, ts = _save_kind(saveat, t0.dtype)
    _check_ts(ts, t0, t1)
    _check_pace(*span)
    max_events = check.count("max_events", max_events, optional=True)
    budget = check.count("max_steps", max_steps, optional=True)
    reverse = _is_reverse(adjoint)
    if budget is None and (save in ("steps", "dense") or reverse):
        budget = _default_budget(*span, max_events)
    return Options(
        save=save,
        with_t0=saveat.subs is not None and bool(saveat.subs.t0),
        max_events=max_events,
        budget=budget,
        reverse=reverse,
        checkpoints=getattr(adjoint, "checkpoints", None),
        ts=ts,
    )


def enough_iterations(num_steps: int, max_events: int) -> int:
    """Iterations enough for so many steps and contacts, where an array of that length is kept: one
    for each step, and six for each contact, which takes about four."""
    return num_steps + 6 * max_events + 16


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
    if not bool(valid_ts(ts, t0, t1)) and np.isfinite(start) and np.isfinite(stop):
        raise ValueError(
            f"`saveat.ts` must be times in order within the span from t0 = {start} to t1 = "
            f"{stop}, got {saved}."
        )


def resolution(t0: Any, t1: Any, maximum: Any = jnp.maximum) -> Any:
    """Times of the span that are no further apart than this are one time."""
    return SAME_TIME * np.finfo(t0.dtype).eps * maximum(abs(t0), abs(t1))


def _check_pace(t0: Array, t1: Array, dt: Array) -> None:
    """A step is longer than what times of the span can tell apart; unknown while traced."""
    start, stop, pace = (check.concrete(v) for v in (t0, t1, dt))
    if start is None or stop is None or pace is None:
        return
    if not np.isfinite(start) or not np.isfinite(stop):
        return
    if pace <= (least := float(resolution(start, stop, np.maximum))):
        raise ValueError(
            f"`dt` must be greater than {least:.2g}, the rounding of times from t0 = {start} to "
            f"t1 = {stop} in {t0.dtype}, got {pace}. Start at a t0 nearer to 0, or use float64."
        )


def valid_ts(ts: Array, t0: Array, t1: Array) -> Array:
    """Whether saving times are in order, in the direction of time, and within the span."""
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
    """Iterations enough for the span."""
    start, stop, pace = (check.concrete(v) for v in (t0, t1, dt))
    if start is None or stop is None or pace is None:
        raise ValueError(
            "`max_steps` must be an integer here: an array of that length is kept, and `t0`, `t1` "
            "or `dt` is traced, so that the number of steps is not known; got None."
        )
    steps = abs(stop - start) / pace
    num_steps = math.ceil(steps) if np.isfinite(steps) else 1
    return enough_iterations(num_steps, max_events or _MANY_EVENTS)
