"""Recorders: rules for which states of a lane are saved, and where.

There is one for each kind of `diffrax.SaveAt` (that of `t1` alone is the base class), and one for
the samples of a sweep. A new kind is a subclass of `Recorder`.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane.extension import Step
from jaxfil.integrate.lane.problem import Problem, Recorder
from jaxfil.integrate.lane.recording import entered, mode_codes
from jaxfil.integrate.lane.state import LoopState, SavedStates
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system.components import Components, pack, with_last_zeroed
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.masked_write import masked_write
from jaxfil.xla.select import select


class SaveSamples(Recorder):
    """Recorder of every `every`-th state at a grid point, starting at number `first`."""

    name = "samples"
    in_free_steps = True
    size: int = eqx.field(static=True, kw_only=True)
    """Number of samples."""
    modes: bool = eqx.field(static=True, kw_only=True)
    """Whether modes are saved too."""
    integrals: int = eqx.field(static=True, default=0, kw_only=True)
    """Number of trailing components that are integrals. They restart from zero after every `every`
    grid points, since sums over a long run would lose their last digits."""
    first: Array = eqx.field(kw_only=True)
    every: Array = eqx.field(kw_only=True)

    def empty(self, system: ComponentSystem) -> SavedStates:
        return _empty(system, self.size, 0, self.size if self.modes else 0)

    def record(self, problem: Problem, state: LoopState, after: LoopState, step: Step) -> LoopState:
        return self.keep(problem, state, after, step.end.motion.x, step.gridded)

    def keep(
        self, problem: Problem, state: LoopState, after: LoopState, x: Components, gridded: Array
    ) -> LoopState:
        saves, number = state.saves, state.counts.num_saved
        assert saves is not None
        # Compared with a running count, since a remainder for every lane would take 7 % of the
        # time of a sweep.
        save = gridded & (after.counts.index == self.first + number * self.every)
        rows, row = {"xs": saves.xs}, {"xs": pack(x, problem.system.dtype)}
        if self.modes:
            rows["modes"], row["modes"] = saves.modes, mode_codes(after.motion.mode)
        written = masked_write(rows, number, row, save)
        after = _with(after, dataclasses.replace(saves, **written), save)
        if self.integrals == 0:
            return after
        # The integrals of the first sample begin one interval before it.
        begins = save | (gridded & (after.counts.index == self.first - self.every))
        x = with_last_zeroed(after.motion.x, self.integrals, begins)
        return dataclasses.replace(after, motion=dataclasses.replace(after.motion, x=x))


def _empty(system: ComponentSystem, size: int, ts: int, modes: int) -> SavedStates:
    """Buffers for the given numbers of states, times and modes; unused entries stay inf, as in
    diffrax."""
    return SavedStates(
        ts=jnp.full((ts,), jnp.inf, system.dtype),
        xs=jnp.full((size, system.n), jnp.inf, system.dtype),
        modes=jnp.zeros((modes, system.m), jnp.int8),
    )


def _with(after: LoopState, saves: SavedStates, save: Array) -> LoopState:
    """`after` with new buffers, and one more saved state if `save`."""
    number = after.counts.num_saved + save.astype(jnp.int32)
    counts = dataclasses.replace(after.counts, num_saved=number)
    return dataclasses.replace(after, saves=saves, counts=counts)


class _InTime(eqx.Module):
    """A vector field as the rate of time and state together."""

    field: ModeField

    def __call__(self, at: Any) -> Any:
        t, x = at
        return jnp.ones_like(t), self.field(t, x)


class _Linearised(eqx.Module):
    """A field with its linearisation, as the rate of a point and its tangent."""

    field: Any
    by_field: Any

    def __call__(self, at: Any) -> Any:
        now, rate = eqx.filter_jvp(lambda f, v: f(v), (self.field, at[0]), (self.by_field, at[1]))
        return now, _or_zero(rate, now)


def _or_zero(rate: Any, of: Any) -> Any:
    """A tangent, with zeros where equinox omits them."""
    return eqx.combine(rate, jax.tree.map(jnp.zeros_like, of))


@eqx.filter_custom_jvp
def _moved(gap: Array, at: Any, field: Any) -> Any:
    """The point `at`, moved along the field by a time `gap` whose value is zero and whose
    derivatives are not. The field is evaluated in the derivatives alone."""
    return at


@_moved.def_jvp
def _moved_jvp(primals: tuple, tangents: tuple) -> tuple:
    gap, at, field = primals
    by_gap, rate, by_field = tangents
    rate = _or_zero(rate, at)
    # The point and its tangent are both moved by `_moved`, so that the rule applies to itself and
    # gives derivatives of every order.
    at, rate = _moved(gap, (at, rate), _Linearised(field, by_field))
    # Equinox has None for a tangent that is zero, and the field is then not evaluated.
    if by_gap is not None:
        rate = jax.tree.map(lambda own, f: own + by_gap * f, rate, field(at))
    return at, rate


def _entered(
    state: LoopState, after: LoopState, system: ComponentSystem, end: tuple, save: Array
) -> LoopState:
    """`after` with a time, a state and a mode saved if `save` and space remains."""
    saves, number = state.saves, state.counts.num_saved
    assert saves is not None
    (t, x, mode), size = end, saves.ts.shape[0]
    entry = SavedStates(t, pack(x, system.dtype), mode_codes(mode))
    yes = save & (number < size)
    # A full table keeps its rows, and the count goes on.
    return _with(after, entered(saves, jnp.minimum(number, size - 1), yes, entry), save)


class SaveTimes(Recorder):
    """Recorder of the states at given times, sorted along the direction of time."""

    name = "ts"
    ts: Array = eqx.field(kw_only=True)

    def since(self, t0: Array) -> "SaveTimes":
        return dataclasses.replace(self, ts=self.ts - t0)

    def empty(self, system: ComponentSystem) -> SavedStates:
        return _empty(system, *self.ts.shape * 3)

    def next_time(self, num_saved: Array) -> tuple[Array, Array, Array]:
        last = self.ts.shape[0] - 1
        # After the last time the flags are False, and the index only stays in range.
        return self.ts[jnp.minimum(num_saved, last)], num_saved <= last, num_saved < last

    def record(self, problem: Problem, state: LoopState, after: LoopState, step: Step) -> LoopState:
        motion = step.end.motion
        t, (at, *_) = problem.grid.t0 + motion.tau, self.next_time(state.counts.num_saved)
        # Where a saving time coincides with a grid point, the step ends at the grid point, which
        # has no derivative with respect to the saving time; `_moved` supplies it.
        field = _InTime(ModeField(problem.system, motion.mode))
        t, x = _moved(at - motion.tau, (t, motion.x), field)
        return _entered(state, after, problem.system, (t, x, motion.mode), step.saving)


class SaveSteps(Recorder):
    """Recorder of the state after every step, including steps that end on contacts."""

    name = "steps"
    at_known_times = False
    follows_contacts = True
    size: int = eqx.field(static=True, kw_only=True)
    """Capacity, in states."""

    def empty(self, system: ComponentSystem) -> SavedStates:
        return _empty(system, self.size, self.size, self.size)

    def record(self, problem: Problem, state: LoopState, after: LoopState, step: Step) -> LoopState:
        motion = step.end.motion
        end = problem.grid.t0 + motion.tau, motion.x, motion.mode
        # A landing is not `moved`. The switch that follows saves the state after the contact. Of
        # several switches at one time the last does, since a state between two maps has no mode.
        return _entered(state, after, problem.system, end, step.settled)

    def at_section(self, problem: Problem, state: LoopState) -> LoopState:
        saves, number, end = state.saves, state.counts.num_saved, state.motion
        assert saves is not None
        t, x, mode = problem.grid.t0 + end.tau, pack(end.x, problem.system.dtype), end.mode
        # A crossing at the start, or at a jump, is at a state that is saved already.
        before = select(number > 0, saves.ts[jnp.maximum(number - 1, 0)], problem.grid.t0)
        ended = (state.result == RESULTS.section_reached) | (state.result == RESULTS.out_of_bounds)
        ended = ended & (t != before)
        # A selection of all rows, since a single write in place has no reverse derivative here.
        here = ended & (jnp.arange(self.size, dtype=number.dtype) == number)
        saves = SavedStates(
            ts=select(here, t, saves.ts),
            xs=select(here[:, None], x, saves.xs),
            modes=select(here[:, None], mode_codes(mode), saves.modes),
        )
        return _with(state, saves, ended)


class SaveDense(SaveSteps):
    """Recorder of the states after every step, from which dense output is interpolated."""

    name = "dense"
