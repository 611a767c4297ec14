"""The sampling of each lane of a sweep: the length of its run and its samples."""

import dataclasses
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.lane.extension import Extension
from jaxfil.integrate.lane.forcing_phase import repeats
from jaxfil.integrate.lane.problem import (
    SAME_TIME,
    Problem,
    Recording,
    TimeGrid,
    grid_of_periods,
    iteration_budget,
)
from jaxfil.integrate.lane.recorders import SaveSamples
from jaxfil.integrate.lane.state import LoopState, SavedStates
from jaxfil.integrate.loop.extensions import problem_of, sections_in
from jaxfil.integrate.run.averaging import Averaging, averages_in
from jaxfil.integrate.run.observed import Observable, observed, sections_of_run
from jaxfil.integrate.steppers.explicit import Stepper, tableau_of
from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.lowered import ComponentSystem, build
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import replace_parameters
from jaxfil.model.section import Section
from jaxfil.model.system import System
from jaxfil.xla.select import select

_Array = TypeVar("_Array", Array, np.ndarray)
# Rounding of the number of ticks in a period, in eps of that number.
_DIVIDES = 64


class Point(eqx.Module):
    """A point in parameter space, or a row of points, one per lane."""

    values: Array
    """Values of the swept parameters, shape (k,)."""
    repeats: Array | None
    """Whether the system repeats after a forcing period, so that the clock of the lane may restart;
    None if time always continues."""


class Samples(eqx.Module, Generic[_Array]):
    """The samples of a lane, or of many."""

    xs: _Array
    """The states, or observed values, shape (…, samples, k)."""
    times: _Array | None
    """Times of the sampled crossings, shape (…, samples); None for once a forcing period."""
    halvings: _Array
    """Number of halved steps, shape (…,)."""
    averages: _Array | None = None
    """The numbers of all averaged quantities, shape (…, k); None without averages."""


class Kept(eqx.Module):
    """Recorded data of a lane, or of many, from which samples are computed."""

    saved: SavedStates
    """States at the samples, times only at a section, and modes only for observed values."""
    halvings: Array
    """Number of halved steps."""
    averages: tuple[Any, ...]
    """States of the averaging extensions."""


class Sampling(eqx.Module):
    """A system, and the part of its motion that each lane samples.

    Once a forcing period, or at the crossings of a `section`. Counts and times are arrays, so that
    new values do not recompile; `samples` is a shape.
    """

    system: System
    names: tuple[str, ...] = eqx.field(static=True)
    """Names of the swept parameters."""
    transient: Array
    """Forcing periods, or crossings, before the first sample."""
    samples: int = eqx.field(static=True)
    """Number of sampled forcing periods, or crossings."""
    steps: Array
    """Steps per forcing period; for an autonomous system per unit of time."""
    stepper: Stepper
    compact: bool = eqx.field(static=True)
    """The grade of the program (see `grade`)."""
    share: Array
    """The fraction of the usual error at which a step is halved."""
    section: Section | None = None
    max_return: Array | None = None
    """The longest mean time from one crossing to the next."""
    transient_time: Array | None = None
    """The time before which no crossing counts; None if all do."""
    observable: Observable | None = None
    """The function recorded at each sample; None for the state."""
    averaging: Averaging | None = None
    """The averages from the end of the transient to the last sample, or at a section from the first
    sample to the last."""
    phased: bool = eqx.field(static=True, default=False)
    """Whether lanes start at the phase of the forcing and the clocks at which the previous one
    ended, the last number of their initial states."""

    def at(self, values: Array) -> tuple[System, Array]:
        """The system at a point in parameter space, and its period, or the unit of time for an
        autonomous system."""
        system = replace_parameters(
            self.system, self.names, [values[i] for i in range(len(self.names))]
        )
        period = 1.0 if system.period is None else system.period
        return system, jnp.asarray(period, values.dtype)

    def points(self, rows: Array, states: Array) -> Point:
        """Points in parameter space, shape (p, k), with the properties needed by lanes from these
        states."""
        return jax.vmap(self.point, (0, 0 if states.ndim > 1 else None))(rows, states)

    def point(self, values: Array, x0: Array) -> Point:
        """One point."""
        # At a section the whole run is one span of time, and clocks have different phases.
        if self.section is not None or self.system.clocks:
            return Point(values, None)
        system, period = self.at(values)
        carrying, x = self._carried(system, x0)
        return Point(values, repeats(carrying, period, x, self.transient + self.samples))

    def _carried(self, system: System, x0: Array) -> tuple[System, Array]:
        """A system and its state, both extended by the integrals along the motion."""
        return (system, x0) if self.averaging is None else self.averaging.carried(system, x0)

    def problem(
        self, point: Point, start: Array, transposed: bool = False
    ) -> tuple[Problem, Components]:
        """The integration problem of a lane, and its initial components. If `transposed`, what is
        computed from its extensions is differentiated in reverse mode."""
        system, period = self.at(point.values)
        x0, phase = self.split(start)
        carrying, x = self._carried(system, x0)
        field = build(carrying, x, compact=self.compact)
        others = ()
        if self.averaging is not None:
            others = self.averaging.extensions(system, field, x, self._first, transposed)
        if self.section is not None:
            run = self._to_the_last_crossing(carrying, field, period, (x, phase), others)
            return run, field.unpack(x)
        count = self.transient + self.samples
        grid = grid_of_periods(period, count, self.steps, repeats=point.repeats)
        grid = dataclasses.replace(grid, share=self.share)
        recorder = SaveSamples(
            size=self.samples,
            modes=self.observable is not None,
            integrals=0 if self.averaging is None else self.averaging.integrals,
            first=(self.transient + 1) * self.steps,
            every=self.steps,
        )
        tableau, recording = tableau_of(self.stepper), Recording(recorder)
        return problem_of(field, tableau, grid, recording, others=others), field.unpack(x)

    @property
    def _first(self) -> Array:
        """The number of the grid point, or of the crossing, at which averages begin."""
        return self.transient * self.steps if self.section is None else self.transient + 1

    def split(self, start: Array) -> tuple[Array, Array]:
        """The state and the phase, in cycles (see `_cycle_of`), at the start of a lane."""
        return (start[:-1], start[-1]) if self.phased else (start, jnp.zeros((), start.dtype))

    def _to_the_last_crossing(
        self,
        system: System,
        field: ComponentSystem,
        unit: Array,
        start: tuple[Array, Array],
        others: tuple[Extension, ...],
    ) -> Problem:
        """The problem of a lane that ends with its last sample at a section."""
        (x0, phase), section = start, self.section
        assert section is not None
        if self.averaging is not None:
            section = self.averaging.section(section)
        sections = sections_of_run((section,), system, field, x0)
        assert sections is not None
        t0 = phase * _cycle_of(system, unit)[0] if self.phased else jnp.zeros_like(unit)
        since = None if self.transient_time is None else t0 + self.transient_time
        watched = eqx.tree_at(
            lambda s: (s.terminal, s.unseen, s.since),
            sections,
            ((self.transient + self.samples,), self.transient, since),
            is_leaf=lambda v: v is None,
        )
        recording = Recording(num_crossings=self.samples)
        grid = self._longest_grid(unit, t0)
        tableau = tableau_of(self.stepper)
        return problem_of(field, tableau, grid, recording, watched, others=others)

    def _longest_grid(self, unit: Array, t0: Array) -> TimeGrid:
        """The grid of a lane with the longest allowed returns to its section."""
        assert self.max_return is not None
        count = (self.transient + self.samples).astype(unit.dtype)
        dt = unit / self.steps.astype(unit.dtype)
        before = 0.0 if self.transient_time is None else self.transient_time
        most = jnp.ceil((before + count * self.max_return) / dt)
        num_steps = jnp.minimum(most, 2.0**30).astype(jnp.int32)
        length = num_steps.astype(unit.dtype) * dt
        if tableau_of(self.stepper).tolerance is not None:
            num_steps, dt = jnp.ones_like(num_steps), length
        return TimeGrid(t0, length, dt, num_steps, iteration_budget(num_steps), share=self.share)

    def outcome(self, state: LoopState) -> tuple[Kept, RESULTS, Array]:
        """The recorded data of a lane, or of many; the outcome; the last state (n,), in `phased`
        lanes followed by the time since the start."""
        sections = sections_in(state)
        saved = state.saves if sections is None else sections.table
        assert saved is not None
        xs = jnp.where(jnp.isfinite(saved.xs), saved.xs, jnp.nan)
        modes = None if self.observable is None else saved.modes
        timed = self.observable is not None or self.section is not None
        # Components are numbers, or one array of numbers.
        rows = [v.reshape(*xs.shape[:-2], -1) for v in state.motion.x.parts]
        if self.averaging is not None:
            rows = [jnp.concatenate(rows, axis=-1)[..., : self.averaging.n]]
        result = state.result
        if self.section is not None:
            result = (jax.vmap(_at_section) if state.motion.tau.ndim else _at_section)(result)
        at = SavedStates(saved.ts if timed else None, xs, modes)
        if self.phased:
            rows.append(state.motion.tau[..., None])
        kept = Kept(at, state.trust.halvings, averages_in(state))
        return kept, result, jnp.concatenate(rows, axis=-1)

    def ended(self, point: Point, start: Array, end: Array) -> Array:
        """The start of the next lane after one from `start`: its last state, followed by the phase
        instead of the time."""
        if not self.phased:
            return end
        system, unit = self.at(point.values)
        cycle, repeats_itself = _cycle_of(system, unit)
        phase = _at_tick(system, start[-1] + end[-1] / cycle, end[-1], cycle)
        return end.at[-1].set(select(repeats_itself, jnp.mod(phase, 1.0), phase))

    def sampled(self, point: Point, x0: Array, kept: Kept, result: RESULTS) -> Samples[Array]:
        """The samples of a lane from its recorded data; averages if it has reached its end."""
        saved, averages, times = kept.saved, None, None
        if self.averaging is not None:
            averages = self.averaged(*self.around(point, x0), kept, result)
            saved = dataclasses.replace(saved, xs=saved.xs[:, : self.averaging.n])
        xs = saved.xs
        if self.observable is not None:
            xs = self._observed(self.observable, point, x0, saved)
        if self.section is not None:
            times = jnp.where(jnp.isfinite(saved.ts), saved.ts, jnp.nan)
        return Samples(xs, times, kept.halvings, averages)

    def around(self, point: Point, start: Array) -> tuple[Problem, Array]:
        """The integration problem of a lane for what is computed from its extensions, and its
        period."""
        # The run is differentiated forward, in a kernel, and what follows as the user asks.
        problem, _ = self.problem(point, start, transposed=True)
        return problem, self.at(point.values)[1]

    def averaged(self, problem: Problem, period: Array, kept: Kept, result: RESULTS) -> Array:
        """The numbers of all quantities of a lane (see `around`) from its recorded data; NaN unless
        it has reached its end. It uses no function of the user."""
        averaging, xs, ts = self.averaging, kept.saved.xs, kept.saved.ts
        assert averaging is not None
        if self.section is None:
            means = jnp.mean(xs[:, averaging.n :], axis=0) / period
        else:
            means = averaging.since(xs) / (ts[-1] - ts[0])
        numbers = averaging.found(problem, kept.averages, means)
        return select(result == RESULTS.successful, numbers, jnp.nan)

    def _observed(
        self, observable: Observable, point: Point, x0: Array, saved: SavedStates
    ) -> Array:
        """The observed values at the samples, shape (samples, k)."""
        (problem, _), (x0, _) = self.problem(point, x0), self.split(x0)
        system, period = self.at(point.values)
        if self.section is None:
            periods = self.transient + jnp.arange(1, self.samples + 1, dtype=jnp.int32)
            saved = dataclasses.replace(saved, ts=periods.astype(period.dtype) * period)
        values = observed(observable, problem, system, x0, saved)
        return jnp.where(jnp.isfinite(values), values, jnp.nan).reshape(self.samples, -1)


def depends_on_time(system: System) -> bool:
    """Whether a system has a forcing period or clocks."""
    return system.period is not None or len(system.clocks) > 0


def _cycle_of(system: System, unit: Array) -> tuple[Array, Array]:
    """The time in which phases of a system are counted, and whether it repeats itself after that: a
    forcing period, which is the unit of its grids, or else the longest period of a clock."""
    periods = [jnp.asarray(clock.period, unit.dtype) for clock in system.clocks]
    if system.period is None:
        unit = jnp.max(jnp.stack(periods))
    # Clocks that do not divide the cycle never return together, so that time goes on instead.
    turns = jnp.stack([unit / period for period in [unit, *periods]])
    rounding = _DIVIDES * float(jnp.finfo(unit.dtype).eps) * turns
    return unit, jnp.all(abs(turns - jnp.round(turns)) <= rounding)


def _at_tick(system: System, phase: Array, took: Array, cycle: Array) -> Array:
    """A phase after a run, moved to a tick from which it differs by rounding. Otherwise the run
    that follows would begin with that tick again."""
    eps, size = float(jnp.finfo(phase.dtype).eps), jnp.maximum(abs(phase), took / cycle)
    for clock in system.clocks:
        # In cycles, since a number of periods need not be whole again after it is divided by one.
        period, first = (jnp.asarray(v, phase.dtype) / cycle for v in (clock.period, clock.phase))
        tick = first + jnp.round((phase - first) / period) * period
        phase = select(abs(phase - tick) <= SAME_TIME * eps * size, tick, phase)
    return phase


def _at_section(result: RESULTS) -> RESULTS:
    """The outcome of a lane that was to end at its last crossing."""
    missed = RESULTS.where(result == RESULTS.successful, RESULTS.section_not_reached, result)
    return RESULTS.where(result == RESULTS.section_reached, RESULTS.successful, missed)
