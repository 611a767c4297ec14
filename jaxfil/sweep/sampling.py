"""What each lane of a sweep does: how long it runs, and what is sampled of it.

A `Sampling`, a point in parameter space and an initial state enter; the problem to be integrated
leaves, and at the end of the lane its samples.
"""

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


class Point(eqx.Module):
    """A point in parameter space, or a row of them, as lanes are given it."""

    values: Array
    """The values of the parameters swept, shape (k,)."""
    repeats: Array | None
    """Whether the system is after a forcing period what it was, so that the clock of the lane may
    start anew; None where the time goes on in any case."""


class Samples(eqx.Module, Generic[_Array]):
    """The samples of a lane, or of many."""

    xs: _Array
    """The states, or what is observed of them, shape (…, samples, k)."""
    times: _Array | None
    """The times of the crossings sampled, shape (…, samples); None once a forcing period."""
    halvings: _Array
    """How often a step was halved on the way, shape (…,)."""
    averages: _Array | None = None
    """The numbers of all quantities that are averaged, shape (…, k); None: there are none."""


class Kept(eqx.Module):
    """What a lane, or many, have found on the way, of which samples are made."""

    saved: SavedStates
    """The states at the samples; times at a section alone, and modes if something is observed."""
    halvings: Array
    """How often a step was halved."""
    averages: tuple[Any, ...]
    """The states of the extensions that average."""


class Sampling(eqx.Module):
    """A system, and the part of its motion that each lane samples.

    Once a forcing period, or at the crossings of a `section`. Counts and times are arrays, so that
    new ones compile nothing; `samples` is a shape.
    """

    system: System
    names: tuple[str, ...] = eqx.field(static=True)
    """The parameters swept."""
    transient: Array
    """Forcing periods, or crossings, before the first sample."""
    samples: int = eqx.field(static=True)
    """Forcing periods, or crossings, sampled."""
    steps: Array
    """Steps per forcing period; of an autonomous system per unit of time."""
    stepper: Stepper
    compact: bool = eqx.field(static=True)
    """The grade of the program: see `grade`."""
    share: Array
    """The part of the usual error at which a step is halved."""
    section: Section | None = None
    max_return: Array | None = None
    """The longest time from one crossing to the next, on average."""
    transient_time: Array | None = None
    """The time before which no crossing counts; None: all do."""
    observable: Observable | None = None
    """What is recorded of each sample; None: the state."""
    averaging: Averaging | None = None
    """What is averaged from the end of the transient to the last sample, or from the first sample
    at a section."""
    phased: bool = eqx.field(static=True, default=False)
    """Whether lanes start at the phase of the forcing at which the last one has ended, the last
    number of their initial states."""

    def at(self, values: Array) -> tuple[System, Array]:
        """The system at a point in parameter space, and its period; of an autonomous one the unit
        of time."""
        system = replace_parameters(
            self.system, self.names, [values[i] for i in range(len(self.names))]
        )
        period = 1.0 if system.period is None else system.period
        return system, jnp.asarray(period, values.dtype)

    def points(self, rows: Array, states: Array) -> Point:
        """Points in parameter space, shape (p, k), with what lanes that start in these states ask
        of them."""
        return jax.vmap(self.point, (0, 0 if states.ndim > 1 else None))(rows, states)

    def point(self, values: Array, x0: Array) -> Point:
        """One of them."""
        # At a section all of the run is one span of time, and clocks have phases of their own.
        if self.section is not None or self.system.clocks:
            return Point(values, None)
        system, period = self.at(values)
        carrying, x = self._carried(system, x0)
        return Point(values, repeats(carrying, period, x))

    def _carried(self, system: System, x0: Array) -> tuple[System, Array]:
        """A system with what is integrated along its motion, and its state with these."""
        return (system, x0) if self.averaging is None else self.averaging.carried(system, x0)

    def problem(self, point: Point, start: Array) -> tuple[Problem, Components]:
        """What a lane integrates, and what from."""
        system, period = self.at(point.values)
        x0, phase = self.split(start)
        carrying, x = self._carried(system, x0)
        field = build(carrying, x, compact=self.compact)
        others = ()
        if self.averaging is not None:
            others = self.averaging.extensions(system, field, x, self._first)
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
        """The number of the grid point, or of the crossing, from which on averages are taken."""
        return self.transient * self.steps if self.section is None else self.transient + 1

    def split(self, start: Array) -> tuple[Array, Array]:
        """Of what a lane starts from the state, and the phase of the forcing, a part of 1."""
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
        t0 = phase * unit
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
        """The grid of a lane that returns to its section as seldom as it may."""
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
        """What a lane, or many, have found; the outcome; the last state (n,), and in lanes that are
        `phased` the time since the start behind it."""
        sections = sections_in(state)
        saved = state.saves if sections is None else sections.table
        assert saved is not None
        xs = jnp.where(jnp.isfinite(saved.xs), saved.xs, jnp.nan)
        modes = None if self.observable is None else saved.modes
        timed = self.observable is not None or self.section is not None
        # Components are numbers, or one array of them.
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
        """What the next lane starts from, of one that has started from `start`: its last state, and
        in place of the time since then the phase of the forcing."""
        if not self.phased:
            return end
        _, period = self.at(point.values)
        return end.at[-1].set(jnp.mod(start[-1] + end[-1] / period, 1.0))

    def sampled(self, point: Point, x0: Array, kept: Kept, result: RESULTS) -> Samples[Array]:
        """The samples of a lane that has found this; averages if it has come to its end."""
        saved, averages, times = kept.saved, None, None
        if self.averaging is not None:
            averages = self._averaged(self.averaging, point, x0, kept)
            averages = select(result == RESULTS.successful, averages, jnp.nan)
            saved = dataclasses.replace(saved, xs=saved.xs[:, : self.averaging.n])
        xs = saved.xs
        if self.observable is not None:
            xs = self._observed(self.observable, point, x0, saved)
        if self.section is not None:
            times = jnp.where(jnp.isfinite(saved.ts), saved.ts, jnp.nan)
        return Samples(xs, times, kept.halvings, averages)

    def _averaged(self, averaging: Averaging, point: Point, start: Array, kept: Kept) -> Array:
        """The numbers of all quantities of a lane."""
        problem, _ = self.problem(point, start)
        integrals, ts = kept.saved.xs[:, averaging.n :], kept.saved.ts
        if self.section is None:
            _, period = self.at(point.values)
            means = jnp.mean(integrals, axis=0) / period
        else:
            means = (integrals[-1] - integrals[0]) / (ts[-1] - ts[0])
        return averaging.found(problem, kept.averages, means)

    def _observed(
        self, observable: Observable, point: Point, x0: Array, saved: SavedStates
    ) -> Array:
        """What is observed at the samples, shape (samples, k)."""
        (problem, _), (x0, _) = self.problem(point, x0), self.split(x0)
        system, period = self.at(point.values)
        if self.section is None:
            periods = self.transient + jnp.arange(1, self.samples + 1, dtype=jnp.int32)
            saved = dataclasses.replace(saved, ts=periods.astype(period.dtype) * period)
        values = observed(observable, problem, system, x0, saved)
        return jnp.where(jnp.isfinite(values), values, jnp.nan).reshape(self.samples, -1)


def _at_section(result: RESULTS) -> RESULTS:
    """The outcome of a lane that was to end at its last crossing."""
    missed = RESULTS.where(result == RESULTS.successful, RESULTS.section_not_reached, result)
    return RESULTS.where(result == RESULTS.section_reached, RESULTS.successful, missed)
