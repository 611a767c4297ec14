"""The options of `solve`: which states to save, limits of the run, and the kind of derivatives.

Arguments are checked here; a `ValueError` names the argument, the allowed values and the given one.
"""

import dataclasses
import math
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.lane.problem import FINER, SAME_TIME, Recorder
from jaxfil.integrate.lane.recorders import SaveDense, SaveSteps, SaveTimes
from jaxfil.model import check
from jaxfil.model.types import Scalar
from jaxfil.xla.known import power_of_two

Adjoint: TypeAlias = diffrax.ForwardMode | diffrax.RecursiveCheckpointAdjoint
"""The kind of reverse mode: the transposed forward Jacobian, or a loop with checkpoints."""

# diffrax's default for the saved quantity, which is the state.
_SAVE_STATE = diffrax.SubSaveAt(t1=True).fn
# Number of contacts in a default budget for runs without a limit on their number.
_MANY_EVENTS = 256
# Number of steps assumed for a run whose steps follow a tolerance: its limit of iterations, and the
# number assumed if an array of that length is kept.
_MANY_STEPS, _KEPT_STEPS = 2**20, 4096


class Options(eqx.Module):
    """The options of a run: saved states (at the user's times, not elapsed ones), limits on
    contacts and iterations, checkpoints of reverse mode, and the grade of the program."""

    recorder: Recorder
    max_events: int | None = eqx.field(static=True)
    budget: int | None = eqx.field(static=True)
    reverse: bool = eqx.field(static=True)
    checkpoints: int | None = eqx.field(static=True)
    compact: bool = eqx.field(static=True)
    share: Array
    """The factor on the usual error limit at which a step is halved."""

    def at_half_the_step(self) -> "Options":
        """The options of the run at half the step, which is not differentiated."""
        # Under a tolerance the share also divides the allowed error, which shortens the steps.
        # Twice the budget must still be an int32.
        budget = None if self.budget is None else min(2 * self.budget, check.MOST_STEPS)
        return dataclasses.replace(self, budget=budget, reverse=False, share=FINER * self.share)


def options_of(
    saveat: diffrax.SaveAt,
    max_events: int | None,
    max_steps: int | None,
    adjoint: Adjoint,
    compact: bool,
    times: tuple[Scalar, Scalar, Scalar],
    dtype: np.dtype,
    adaptive: bool,
) -> Options:
    """The options of a solve over the span (t0, t1, dt), given as the user's numbers. Under `jit`
    these are known unless they are arrays of JAX. The number of steps of an `adaptive` run is
    unknown."""
    save, ts = _save_kind(saveat, dtype)
    by_steps = save in ("steps", "dense")
    span = _known_span(times, dtype)
    if span is not None:
        _check_span(span, saveat)
    max_events = check.count("max_events", max_events, optional=True)
    budget = check.count("max_steps", max_steps, optional=True)
    reverse, num_times = _is_reverse(adjoint), 0 if ts is None else ts.shape[0]
    # Both keep an array with an entry for each iteration.
    kept = by_steps or reverse
    if budget is None and adaptive:
        # The length of an array is part of the program. A power of two is shared by many spans.
        rows = enough_iterations(_KEPT_STEPS, max_events or _MANY_EVENTS) + num_times
        budget = power_of_two(rows) if kept else _MANY_STEPS + num_times
    elif budget is None and kept:
        budget = _default_budget(span, max_events, num_times)
    recorder = Recorder()
    if ts is not None:
        recorder = SaveTimes(ts=ts)
    elif by_steps:
        # Dense output needs the start of every step, the first of which is at t0.
        with_t0 = save == "dense" or (saveat.subs is not None and bool(saveat.subs.t0))
        kind = SaveDense if save == "dense" else SaveSteps
        recorder = kind(size=budget or 0, with_t0=with_t0)
    return Options(
        recorder=recorder,
        max_events=max_events,
        budget=budget,
        reverse=reverse,
        checkpoints=getattr(adjoint, "checkpoints", None),
        compact=compact,
        share=jnp.ones((), dtype),
    )


def enough_iterations(num_steps: int, max_events: int) -> int:
    """The iterations allowed for a number of steps and contacts if an array of that length is kept:
    one for each step, and six for each contact, which takes about four."""
    return num_steps + 6 * max_events + 16


def _save_kind(saveat: Any, dtype: Any) -> tuple[str, Array | None]:
    """The kind of a `diffrax.SaveAt`, one of t1, ts, steps and dense, and its times if any."""
    if not isinstance(saveat, diffrax.SaveAt):
        raise ValueError(f"`saveat` must be a diffrax.SaveAt, got {type(saveat).__name__}.")
    sub = saveat.subs
    if not isinstance(sub, diffrax.SubSaveAt | None):
        raise ValueError(f"`saveat` must have a single SubSaveAt, got {sub!r}.")
    _refuse_unknown(saveat, sub)
    asked = {"dense": bool(saveat.dense)}
    if sub is not None:  # diffrax has None here if only `dense` is requested
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
    ts = check.numbers("saveat.ts", sub.ts, dtype, "times of shape (k,) with k ≥ 1")
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"`saveat.ts` must be of shape (k,) with k ≥ 1, got shape {ts.shape}.")
    return "ts", ts


def _refuse_unknown(saveat: diffrax.SaveAt, sub: diffrax.SubSaveAt | None) -> None:
    """Raises an error for options of diffrax that a solve does not support."""
    for name in ("solver_state", "controller_state", "made_jump"):
        if getattr(saveat, name):
            raise ValueError(
                f"`saveat.{name}` must be False, since no such state is saved; got True."
            )
    if sub is None:
        return
    if sub.steps not in (0, 1):
        raise ValueError(
            f"`saveat.steps` must be True, since every step is saved (take every {sub.steps}th row "
            f"of the result); got {sub.steps!r}."
        )
    if sub.fn is not _SAVE_STATE:
        raise ValueError(
            "`saveat.fn` must be omitted, since states are saved (apply the function to the "
            f"result's `ts` and `xs`); got {sub.fn!r}."
        )


class _Span(NamedTuple):
    """A span of time and its step, as concrete numbers."""

    t0: np.ndarray
    t1: np.ndarray
    dt: np.ndarray

    @property
    def finite(self) -> bool:
        """Whether all three are finite."""
        return bool(np.isfinite(self).all())

    @property
    def steps(self) -> float:
        """The number of steps in the span."""
        return float(abs(self.t1 - self.t0) / self.dt)


def _known_span(times: tuple[Scalar, Scalar, Scalar], dtype: np.dtype) -> _Span | None:
    """The span in the precision of the run; None if a part of it is traced."""
    known = [v.astype(dtype) for v in map(check.concrete, times) if v is not None]
    return _Span(*known) if len(known) == 3 else None


def _check_span(span: _Span, saveat: diffrax.SaveAt) -> None:
    """Checks that saving times lie in the span in order, that a step exceeds the rounding of times
    in the span, and that the number of steps fits in an int32."""
    # Such a run ends at t0 with the outcome `nonfinite`.
    if not span.finite:
        return
    t0, t1, dt = span
    ts = None if saveat.subs is None else saveat.subs.ts
    saved = None if ts is None else check.concrete(ts)
    # By NumPy, since JAX would compile a program for each operation.
    if saved is not None and not valid_ts(saved.astype(dt.dtype), t0, t1, np):
        raise ValueError(
            f"`saveat.ts` must be times in order within the span from t0 = {t0} to t1 = {t1}, got "
            f"{saved}."
        )
    if dt <= (least := float(resolution(t0, t1, np.maximum))):
        raise ValueError(
            f"`dt` must be greater than {least:.2g}, the rounding of times from t0 = {t0} to t1 = "
            f"{t1} in {dt.dtype}, got {dt}. Start at a t0 nearer to 0, or use float64."
        )
    if span.steps > check.MOST_STEPS:
        raise ValueError(
            f"`dt` must make fewer than 2³¹ steps from t0 = {t0} to t1 = {t1}, got {dt}, which "
            f"makes {span.steps:.3g}."
        )


def resolution(t0: Any, t1: Any, maximum: Any = jnp.maximum) -> Any:
    """The distance up to which times of the span count as equal."""
    return SAME_TIME * np.finfo(t0.dtype).eps * maximum(abs(t0), abs(t1))


def valid_ts(ts: Any, t0: Any, t1: Any, xp: ModuleType = jnp) -> Any:
    """Whether saving times are in order, in the direction of time, and within the span; `xp` is the
    library of the arrays, NumPy or JAX's."""
    sign = xp.where(t1 < t0, -1.0, 1.0).astype(ts.dtype)
    inside = (sign * ts >= sign * t0) & (sign * ts <= sign * t1)
    return xp.all(inside) & xp.all(sign * xp.diff(ts) >= 0)


def _is_reverse(adjoint: Any) -> bool:
    if isinstance(adjoint, diffrax.ForwardMode):
        return False
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return True
    raise ValueError(
        "`adjoint` must be diffrax.ForwardMode() or diffrax.RecursiveCheckpointAdjoint(), got "
        f"{check.told(adjoint)}."
    )


def _default_budget(span: _Span | None, max_events: int | None, num_times: int) -> int:
    """The iterations allowed for the span, with one for each of `num_times` saving times."""
    if span is None:
        raise ValueError(
            "`max_steps` must be an integer here, since an array of that length is kept, and `t0`, "
            "`t1` or `dt` is traced, so that the number of steps is unknown; got None."
        )
    # A run over a span that is not finite ends at t0.
    num_steps = math.ceil(span.steps) if span.finite else 1
    return power_of_two(enough_iterations(num_steps, max_events or _MANY_EVENTS) + num_times)
