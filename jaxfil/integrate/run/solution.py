"""The `Solution`: what happened, and what can be asked of it.

Nothing is computed here but on request: a card of a few lines, and the state between saved times.
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
from jaxfil.integrate.steppers.explicit import Stepper, compact_step, step, tableau_of
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
    """The surface, the lowest number where several are decided together; −1 at a tick alone."""
    members: Bool[Array, "k m"]
    """All surfaces of the event: those met, or those whose mode a tick or a reset has changed."""
    kinds: Int[Array, " k"]
    """Members of `EventKind`."""
    modes: Int[Array, "k m"]
    """Modes just after, as in `Solution`; 0 in the padding."""

    def __repr__(self) -> str:
        return event_rows(self)


def events_of(table: EventTable | None) -> Events | None:
    """The event table of a lane, as the user sees it."""
    if table is None:
        return None
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
    """Numbers of the sections, in the order in which they were given."""


def crossings_of(table: CrossingTable | None) -> Crossings | None:
    """The crossings of a lane, as the user sees them."""
    return None if table is None else Crossings(table.ts, table.xs, table.sections)


def switches(events: Events | None) -> np.ndarray:
    """The rows of those contacts that are more than a touch, after which the mode goes on."""
    if events is None:
        return np.zeros(0, int)
    kinds = np.asarray(events.kinds)
    return np.flatnonzero((kinds != EventKind.none) & (kinds != EventKind.graze))


class Solution(eqx.Module):
    """What `solve` returns. Unreached entries of `ts` and `xs` are inf, as in diffrax.

    `xs` and `modes` are right limits: a state saved at the time of a contact is the one after it.
    Modes are +1 or −1 (on that side of a surface), 0 (sliding on it), or +2 or −2 (at rest on it,
    from that side, held by its reaction).
    """

    ts: Float[Array, " k"] | None
    """Saved times; None with `SaveAt(dense=True)`, as `xs` and `modes`."""
    xs: Float[Array, "k n"] | None
    """Saved states."""
    modes: Int[Array, "k m"] | None
    """Modes at the saved times."""
    events: Events | None
    """The event table; None where none is kept, or there are no surfaces."""
    num_events: Int[Array, ""]
    """How many events there were, in the table or not."""
    result: RESULTS
    """How the run ended."""
    stats: dict[str, Array]
    """`num_steps` accepted, `num_halvings` of steps that could not be trusted, `num_iterations` of
    the loop, `num_saved` states."""
    t_final: Float[Array, ""]
    """How far the run came: t1, or the time of what `result` tells."""
    x_final: Float[Array, " n"]
    """The state there."""
    mode_final: Int[Array, " m"]
    """The mode there."""
    errors: Float[Array, "k n"] | None = None
    """Estimated |xs − exact|, component by component, if asked for; inf where unknown."""
    crossings: Crossings | None = None
    """The crossings of `sections`; None where none are given, or no table is kept."""
    num_crossings: Int[Array, ""] | None = None
    """How many crossings there were, in the table or not."""
    observed: Float[Array, "k *shape"] | None = None
    """What `observe` is at the saved times; None where nothing is observed."""
    _dense: "Dense | None" = None
    """Every step's start, for `evaluate`."""
    labels: Labels = eqx.field(static=True, default=Labels())
    """What pictures call its quantities."""
    compact: bool = eqx.field(static=True, default=False)
    """Whether the stages of a step were a loop in the program: see `solve`."""

    # Not a method: one of an equinox module is hashed with all arrays, and `jax.jit` refuses it.
    @property
    def evaluate(self) -> Callable[..., Float[Array, "*shape n"]]:
        """The function `evaluate(t, observe=None)`: the state at a time of the solved span, to the
        order of the stepper, shape (n,); of an array of times the states, shape (*t.shape, n).
        With a function `observe`, as that of `solve`, its value there in place of the state.

        Needs `saveat=diffrax.SaveAt(dense=True)`. The step that contains `t` is taken again, up to
        `t`: nothing is interpolated. NaN outside the span that was reached.
        """
        return jax.tree_util.Partial(_evaluate, self)

    def plot(self, ax: Axes = None) -> Axes:
        """Draw the phase portrait, or the history of a state of one component; returns the
        matplotlib axes. Needs saved times."""
        return draw(self, ax=ax)

    def to_xarray(self) -> Dataset:
        """An `xarray.Dataset` of `x` and `mode` (time, …) with the coordinate `t`, of what was met
        (`event_t`, `event_x`, `event_kind`, …), of `crossing_t` and so on, of the end and of
        `outcome` in words; of a batch with the dimension `lane` before the others.

        What was not reached is inf and −1, as here. Needs the package xarray.
        """
        return dataset_io.to_xarray(solution_arrays(self))

    def save(self, path: PathLike) -> None:
        """Write to a netCDF file (`path` ends in .nc), a Zarr store (.zarr) or an .npz.

        `jaxfil.load(path)` gives the same solution back, bit for bit; of one that `evaluate` can be
        asked of `jaxfil.load(path, system=…)`. What was there is replaced.
        """
        dataset_io.save(solution_arrays(self), path)

    def __repr__(self) -> str:
        return card(self)


def errors(sol: Solution, finer: Solution) -> Float[Array, "k n"]:
    """What is left between a solution and the one at half the step, shape (k, n).

    With a global error C·dtᵖ the distance is (1 − 2⁻ᵖ) of it. (A run at twice the step costs
    a sixth of this one, but where a step is not small against the motion between two contacts it
    was seen to report anything from a fifth to 500 times the error; this one keeps within a fifth
    of it.) Rounding, which two runs may share, is taken to be one unit a step at random. A
    finer run that fails, or a state that was not reached, leaves the error unknown, inf.
    """
    assert sol.xs is not None and finer.xs is not None
    xs = jax.lax.stop_gradient(sol.xs)
    known = jnp.isfinite(xs) & jnp.isfinite(finer.xs)
    size = jnp.max(select(known, abs(xs), 0.0), axis=-1, keepdims=True)
    units = jnp.sqrt(finer.stats["num_steps"].astype(xs.dtype))
    rounding = jnp.finfo(xs.dtype).eps * size * units
    distance = select(known, abs(xs - finer.xs), jnp.inf)
    return jnp.maximum(distance, rounding)


class Dense(eqx.Module):
    """Every step's start: enough to take any step again."""

    system: System
    t0: Array
    t1: Array
    ts: Array
    xs: Array
    modes: Array
    stepper: Stepper
    compact: bool = eqx.field(static=True)
    """Whether steps are taken as `compact_step` takes them."""


def _evaluate(sol: Solution, t: Times, observe: Observe | None = None) -> Array:
    """`Solution.evaluate`."""
    if (dense := sol._dense) is None:
        raise ValueError("`evaluate` needs a solution saved with diffrax.SaveAt(dense=True).")
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
    """What is observed at times of any shape, shape (*ts.shape, *observable.shape)."""
    flat, x0 = ts.ravel(), dense.xs[0]
    xs = jax.vmap(ft.partial(evaluate, dense))(flat)
    modes = jax.vmap(lambda t: dense.modes[_step_at(dense, t)])(flat)
    problem = _around(dense, build(dense.system, x0, compact=dense.compact), dense.t0)
    values = observed(observable, problem, dense.system, x0, SavedStates(flat, xs, modes))
    outside = jnp.isnan(xs).any(axis=1).reshape(ts.shape + (1,) * len(observable.shape))
    return select(outside, jnp.nan, values.reshape(*ts.shape, *observable.shape))


def _step_at(dense: Dense, t: Array) -> Array:
    """The number of the step that contains a time: of a contact or a tick, to within rounding of
    times, the step after it."""
    sign = select(dense.t1 >= dense.t0, 1.0, -1.0).astype(t.dtype)
    keys = select(jnp.isfinite(dense.ts), sign * dense.ts, jnp.inf)
    late = sign * t + resolution(dense.t0, t)
    return jnp.maximum(jnp.searchsorted(keys, late, side="right") - 1, 0)


def evaluate(dense: Dense, t: Scalar) -> Float[Array, " n"]:
    """The state at a time, shape (n,); NaN outside the span."""
    dtype = dense.xs.dtype
    t = jnp.asarray(t, dtype)
    forward = dense.t1 >= dense.t0
    sign = select(forward, 1.0, -1.0).astype(dtype)
    i = _step_at(dense, t)
    system = build(dense.system, dense.xs[i], compact=dense.compact)
    system = within_step(dense, system, dense.ts[i])
    field = ModeField(system, system.of_surfaces(dense.modes[i].astype(dtype)))
    start, x = dense.ts[i], system.unpack(dense.xs[i])
    end = step_again(dense, system, field, start, x, t - start)
    reached = (sign * t >= sign * dense.t0) & (sign * t <= sign * dense.t1)
    return select(reached, pack(end, dtype), jnp.nan)


def within_step(dense: Dense, system: ComponentSystem, t: Array) -> ComponentSystem:
    """A system in a step from t on: it does not look across a tick of a clock."""
    return clocks.just_after(_around(dense, system, t), t).system


def _around(dense: Dense, system: ComponentSystem, t: Array) -> Problem:
    """The problem of a system from t on."""
    grid = even_grid(t, dense.t1 - dense.t0, jnp.int32(1))
    return Problem(system, tableau_of(dense.stepper), grid, NOTHING)


def step_again(
    dense: Dense, system: ComponentSystem, field: ModeField, t: Array, x: Components, h: Array
) -> Components:
    """The end of a step from (t, x), or of a part of one, taken as it was."""
    tableau, take = tableau_of(dense.stepper), compact_step if dense.compact else step
    return take(tableau, field, t, x, field(t, x), h, system.forcing(t, h, tableau.times)).x


def card(sol: Solution) -> str:
    """What happened, in a few lines; shapes only for a batch or while traced."""
    told = precision(sol.x_final)
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
    """A line for each contact of one lane; shapes only for a batch or while traced."""
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
