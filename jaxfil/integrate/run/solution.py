"""The `Solution`: the result of a run.

Its methods compute only on request: a short summary, and states between saved times.
"""

import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfil.integrate.lane import clocks
from jaxfil.integrate.lane.problem import NOTHING, Problem, even_grid
from jaxfil.integrate.lane.state import CrossingTable, EventTable, SavedStates
from jaxfil.integrate.run.dataset import solution_arrays
from jaxfil.integrate.run.observed import Observable, checked_observable, observed
from jaxfil.integrate.run.options import resolution
from jaxfil.integrate.steppers.explicit import (
    Stepper,
    compact_step,
    has_known_name,
    step,
    tableau_of,
)
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system.components import Components, pack
from jaxfil.integrate.system.lowered import ComponentSystem, build
from jaxfil.model import dataset_io
from jaxfil.model.card import outcome, precision
from jaxfil.model.drawing import draw
from jaxfil.model.labels import Labels
from jaxfil.model.observe import Observe
from jaxfil.model.outcomes import RESULTS, EventKind
from jaxfil.model.system import System
from jaxfil.model.types import Axes, Dataset, PathLike, Scalar, Times
from jaxfil.xla.select import select


class Events(eqx.Module):
    """The contacts of a solution in order, padded with inf, −1, False and `EventKind.none`."""

    ts: Float[Array, " k"]
    """Times."""
    xs: Float[Array, "k n"]
    """States just before (left limits, before a reset)."""
    surfaces: Int[Array, " k"]
    """The surface, the lowest number if several are decided together; −1 at a tick alone."""
    members: Bool[Array, "k m"]
    """All surfaces of the event: those reached, or those whose mode a tick or a reset has
    changed."""
    kinds: Int[Array, " k"]
    """Members of `EventKind`."""
    modes: Int[Array, "k m"]
    """Modes just after, as in `Solution`; 0 in the padding."""

    def __repr__(self) -> str:
        return event_rows(self)


def events_of(table: EventTable | None) -> Events | None:
    """The public event table of a lane."""
    if table is None:
        return None
    # The first of equal maxima is the lowest number. At a tick alone no flag is set, and the index
    # would be 0, the number of a surface.
    first = jnp.argmax(table.members, axis=-1).astype(jnp.int32)
    surfaces = select(jnp.any(table.members, axis=-1), first, -1)
    return Events(table.ts, table.xs, surfaces, table.members, table.kinds, table.modes)


class Crossings(eqx.Module):
    """The crossings of sections in order, padded with inf and −1."""

    ts: Float[Array, " k"]
    """Times."""
    xs: Float[Array, "k n"]
    """States; where S jumps across zero, just after the jump."""
    sections: Int[Array, " k"]
    """Numbers of the sections, in the order of the argument."""


def crossings_of(table: CrossingTable | None) -> Crossings | None:
    """The public crossings of a lane."""
    return None if table is None else Crossings(table.ts, table.xs, table.sections)


def switches(events: Events | None) -> np.ndarray:
    """The rows of the contacts that are not grazes, after which the mode may differ. A tick without
    a surface is no contact; whether it changes the state at all may be rounding."""
    if events is None:
        return np.zeros(0, int)
    kinds, alone = np.asarray(events.kinds), ~np.asarray(events.members).any(axis=-1)
    others = (EventKind.none, EventKind.graze)
    return np.flatnonzero(~np.isin(kinds, others) & ~((kinds == EventKind.tick) & alone))


class Solution(eqx.Module):
    """The result of `solve`. Unreached entries of `ts` and `xs` are inf, as in diffrax.

    `xs` and `modes` are right limits: a state saved at the time of a contact is the one after it.
    Modes are +1 or −1 (on that side of a surface), 0 (sliding on it), or +2 or −2 (at rest on it,
    on that side, held by its reaction).
    """

    ts: Float[Array, " k"] | None
    """Saved times; None with `SaveAt(dense=True)`, as are `xs` and `modes`."""
    xs: Float[Array, "k n"] | None
    """Saved states."""
    modes: Int[Array, "k m"] | None
    """Modes at the saved times."""
    events: Events | None
    """The event table; None without a table or without surfaces."""
    num_events: Int[Array, ""]
    """Number of events."""
    result: RESULTS
    """The outcome of the run."""
    stats: dict[str, Array]
    """Counts: `num_steps` accepted steps, `num_halvings` refusals of steps that could not be
    trusted, `num_iterations` of the loop, `num_saved` states."""
    t_final: Float[Array, ""]
    """t1, or the time at which a failure or a section ended the run."""
    x_final: Float[Array, " n"]
    """The state at `t_final`."""
    mode_final: Int[Array, " m"]
    """The mode at `t_final`."""
    errors: Float[Array, "k n"] | None = None
    """Estimated |xs − exact|, componentwise, if requested; inf if unknown."""
    crossings: Crossings | None = None
    """The crossings of `sections`; None without sections or without a table."""
    num_crossings: Int[Array, ""] | None = None
    """Number of crossings, including those beyond the table."""
    observed: Float[Array, "k *shape"] | None = None
    """The values of `observe` at the saved times; None without an observable."""
    _dense: "Dense | None" = None
    """The start of every step, for `evaluate`."""
    labels: Labels = eqx.field(static=True, default=Labels())
    """The names of the quantities in pictures."""
    compact: bool = eqx.field(static=True, default=False)
    """Whether the stages of a step were a loop in the program (see `solve`)."""

    # A property and not a method, since a bound method of an equinox module is hashed with all its
    # arrays, which `jax.jit` refuses.
    @property
    def evaluate(self) -> Callable[..., Float[Array, "*shape n"]]:
        """The function `evaluate(t, observe=None)`: the state at a time of the solved span, to the
        order of the stepper, shape (n,); for an array of times the states, shape (*t.shape, n).
        With a function `observe`, as in `solve`, its value in place of the state.

        Needs `saveat=diffrax.SaveAt(dense=True)`. The step that contains `t` is repeated up to
        `t`, without interpolation. NaN outside the span that was reached.
        """
        return jax.tree_util.Partial(_evaluate, self)

    def plot(self, ax: Axes = None) -> Axes:
        """Draw the phase portrait, or the history of a state of one component; returns the
        matplotlib axes. Needs saved times."""
        return draw(self, ax=ax)

    def to_xarray(self) -> Dataset:
        """An `xarray.Dataset` of `x` and `mode` (time, …) with the coordinate `t`, of the events
        (`event_t`, `event_x`, `event_kind`, …), of `crossing_t` and so on, of the end and of
        `outcome` in words; for a batch with the dimension `lane` before the others.

        Unreached entries are inf and −1, as here. Needs the package xarray.
        """
        return dataset_io.to_xarray(solution_arrays(self))

    def save(self, path: PathLike) -> None:
        """Write to a netCDF file (`path` ends in .nc), a Zarr store (.zarr) or an .npz.

        `jaxfil.load(path)` returns the same solution, bit for bit; a solution with `evaluate` needs
        `jaxfil.load(path, system=…)`. An existing file is replaced.

        Raises `ValueError` for a solution with `evaluate` by a stepper of your own, of which a file
        would have the name only.
        """
        if self._dense is not None and not has_known_name(self._dense.stepper):
            raise ValueError(
                "`path` cannot hold dense output by a stepper of your own, since a file has its "
                f"name only; got {type(self._dense.stepper).__name__}. Save with `saveat` of `ts` "
                "or `steps`."
            )
        dataset_io.save(solution_arrays(self), path)

    def __repr__(self) -> str:
        return card(self)


def errors(sol: Solution, finer: Solution) -> Float[Array, "k n"]:
    """The distance between a solution and the one at half the step, shape (k, n).

    With a global error C·dtᵖ the distance is (1 − 2⁻ᵖ) of it. (A run at twice the step costs
    a sixth of this one, but where a step is not small compared with the motion between two contacts
    it reported from a fifth to 500 times the error in tests; this one stays within a fifth of it.)
    Rounding, which the two runs may share, is estimated as one unit per step at random. If the
    finer run fails, or a state was not reached, the error is unknown, inf.
    """
    assert sol.xs is not None and finer.xs is not None
    # The finer run has no derivatives, so the difference from it must not have any either.
    xs = jax.lax.stop_gradient(sol.xs)
    known = jnp.isfinite(xs) & jnp.isfinite(finer.xs)
    size = jnp.max(select(known, abs(xs), 0.0), axis=-1, keepdims=True)
    # Rounding of random signs adds up like the square root of the number of steps.
    units = jnp.sqrt(finer.stats["num_steps"].astype(xs.dtype))
    rounding = jnp.finfo(xs.dtype).eps * size * units
    # Unreached entries are inf in both runs, and their difference would be NaN.
    distance = select(known, abs(xs - finer.xs), jnp.inf)
    return jnp.maximum(distance, rounding)


class Dense(eqx.Module):
    """The start of every step, which is enough to repeat any step."""

    system: System
    t0: Array
    t1: Array
    ts: Array
    xs: Array
    modes: Array
    stepper: Stepper
    compact: bool = eqx.field(static=True)
    """Whether steps are repeated by `compact_step`."""


def _evaluate(sol: Solution, t: Times, observe: Observe | None = None) -> Array:
    """The value of `Solution.evaluate(t, observe)`."""
    if (dense := sol._dense) is None:
        raise ValueError("`evaluate` needs a solution saved with diffrax.SaveAt(dense=True).")
    if shape := np.shape(sol.t_final):
        raise ValueError(
            "`evaluate` needs a solution of one lane; write "
            f"equinox.filter_vmap(lambda sol: sol.evaluate(t))(sols), got a batch of shape {shape}."
        )
    ts = jnp.asarray(t, dense.xs.dtype)
    if observe is None:
        return _states(dense, ts)
    return _values(dense, checked_observable("observe", observe, dense.system, dense.xs[0]), ts)


@eqx.filter_jit
def _states(dense: Dense, ts: Float[Array, "*shape"]) -> Float[Array, "*shape n"]:
    """The states at times of any shape."""
    xs = jax.vmap(ft.partial(evaluate, dense))(ts.ravel())
    return xs.reshape(*ts.shape, *xs.shape[1:])


@eqx.filter_jit
def _values(dense: Dense, observable: Observable, ts: Array) -> Array:
    """The observable at times of any shape, shape (*ts.shape, *observable.shape)."""
    flat, x0 = ts.ravel(), dense.xs[0]
    xs = jax.vmap(ft.partial(evaluate, dense))(flat)
    modes = jax.vmap(lambda t: dense.modes[_step_at(dense, t)])(flat)
    problem = _around(dense, build(dense.system, x0, compact=dense.compact), dense.t0)
    # States outside the span are NaN, which count as unreached.
    values = observed(observable, problem, dense.system, x0, SavedStates(flat, xs, modes))
    # `observed` marks such entries by inf, and dense output by NaN.
    outside = jnp.isnan(xs).any(axis=1).reshape(ts.shape + (1,) * len(observable.shape))
    return select(outside, jnp.nan, values.reshape(*ts.shape, *observable.shape))


def _step_at(dense: Dense, t: Array) -> Array:
    """The number of the step that contains a time. A time within rounding of a contact or a tick
    belongs to the step after it, in the order of time also in a run backward."""
    sign = select(dense.t1 >= dense.t0, 1.0, -1.0).astype(t.dtype)
    # Unreached entries become +inf in either direction of time, so that they are sorted last.
    keys = select(jnp.isfinite(dense.ts), sign * dense.ts, jnp.inf)
    late = sign * (t + resolution(dense.t0, t))
    # A time before the span has the first step, and its state is replaced by NaN.
    return jnp.maximum(jnp.searchsorted(keys, late, side="right") - 1, 0)


def evaluate(dense: Dense, t: Scalar) -> Float[Array, " n"]:
    """The state at a time, shape (n,); NaN outside the span."""
    dtype = dense.xs.dtype
    t = jnp.asarray(t, dtype)
    forward = dense.t1 >= dense.t0
    sign = select(forward, 1.0, -1.0).astype(dtype)
    i = _step_at(dense, t)
    # The run is differentiated forward, in a kernel, and this step as the user asks.
    system = build(dense.system, dense.xs[i], compact=dense.compact, transposed=True)
    system = within_step(dense, system, dense.ts[i])
    field = ModeField(system, system.of_surfaces(dense.modes[i].astype(dtype)))
    start, x = dense.ts[i], system.unpack(dense.xs[i])
    # t may be before the start of its step, by the rounding of times (`_step_at`).
    end = step_again(dense, system, field, start, x, t - start)
    # The end may be the t1 of the run only up to rounding.
    after, left = sign * (t - dense.t0), sign * (dense.t1 - t)
    reached = jnp.minimum(after, left) >= -resolution(dense.t0, dense.t1)
    return select(reached, pack(end, dtype), jnp.nan)


def within_step(dense: Dense, system: ComponentSystem, t: Array) -> ComponentSystem:
    """A system in a step from t on, without evaluations across a tick of a clock."""
    return clocks.just_after(_around(dense, system, t), t).system


def _around(dense: Dense, system: ComponentSystem, t: Array) -> Problem:
    """The problem of a system from t on."""
    # Only the start, the direction and the rounding of times are taken from this grid.
    grid = even_grid(t, dense.t1 - dense.t0, jnp.int32(1))
    return Problem(system, tableau_of(dense.stepper), grid, NOTHING)


def step_again(
    dense: Dense, system: ComponentSystem, field: ModeField, t: Array, x: Components, h: Array
) -> Components:
    """The end of a step from (t, x), or of a part of one, repeated as in the run."""
    tableau, take = tableau_of(dense.stepper), compact_step if dense.compact else step
    return take(tableau, field, t, x, field(t, x), h, system.forcing(t, h, tableau.times)).x


def card(sol: Solution) -> str:
    """A summary in a few lines; only shapes for a batch or while traced."""
    told = precision(sol.x_final)
    # While traced the numbers are unknown, and only their shapes can be printed.
    if isinstance(sol.t_final, jax.core.Tracer) or sol.t_final.ndim > 0:
        batch = tuple(sol.t_final.shape)
        n = sol.x_final.shape[-1]
        return f"Solution{told}: a batch of shape {batch}, states of {n} components"
    lines = [f"Solution{told}: {outcome(sol.result)}"]
    state = np.array2string(np.asarray(sol.x_final), precision=6, separator=", ")
    lines.append(f"  t = {float(sol.t_final):.10g}, x = {state}, mode {sol.mode_final.tolist()}")
    if sol.ts is not None:
        saved = int(np.isfinite(sol.ts).sum())
        lines.append(f"  {saved} states saved (room for {sol.ts.shape[0]})")
    halved = int(sol.stats["num_halvings"])
    steps = f"{int(sol.stats['num_steps'])} steps" + (f" ({halved} halved)" if halved else "")
    lines.append(f"  {steps}, {_events_line(sol)}")
    if sol.num_crossings is not None:
        lines.append(f"  {int(sol.num_crossings)} crossings of sections")
    if sol.errors is not None:
        lines.append(f"  error about {float(np.max(sol.errors)):.1e}, from a run at half the step")
    return "\n".join(lines)


def event_rows(events: Events) -> str:
    """A line for each contact of one lane; only shapes for a batch or while traced."""
    if isinstance(events.ts, jax.core.Tracer) or events.ts.ndim > 1:
        return f"Events: tables of shape {events.ts.shape}"
    lines = [f"{'t':>18}  {'kind':<9}{'surface':<9}x just before"]
    for i in np.flatnonzero(np.asarray(events.kinds) != EventKind.none):
        met = ", ".join(map(str, np.flatnonzero(events.members[i])))
        x = np.array2string(
            np.asarray(events.xs[i]), precision=6, separator=", ", suppress_small=True
        )
        kind = EventKind(int(events.kinds[i])).name
        lines.append(f"{float(events.ts[i]):18.13f}  {kind:<9}{met:<9}{x}")
    return "\n".join(lines) if len(lines) > 1 else "Events: no contacts"


def _events_line(sol: Solution) -> str:
    total = int(sol.num_events)
    if sol.events is None or total == 0:
        return f"{total} contacts"
    kinds = np.asarray(sol.events.kinds)
    counts = [(k.name, int(np.sum(kinds == k))) for k in EventKind if k is not EventKind.none]
    parts = ", ".join(f"{number} {name}" for name, number in counts if number)
    return f"{total} contacts ({parts})"
