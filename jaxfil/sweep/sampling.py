"""What a lane of a sweep does: how long it runs, and what is kept of it.

A point in parameter space and an initial state enter; the problem to be integrated leaves, and what
is made of the lane at its end.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

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
from jaxfil.integrate.run.observed import Observable, checked_observable, observed
from jaxfil.integrate.steppers.explicit import Stepper, tableau_of
from jaxfil.integrate.surfaces.sections import watch_sections
from jaxfil.integrate.system.lowered import build
from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast, replace_parameters
from jaxfil.model.section import Section, sections_of
from jaxfil.model.system import System
from jaxfil.model.types import Scalar


class Sampling(eqx.Module):
    """What every lane of a sweep does: `transient` periods unseen, then `samples` periods whose
    ends are kept, `steps` steps each; or so many crossings of a section."""

    transient: Array
    samples: int = eqx.field(static=True)
    steps: Array
    stepper: Stepper
    compact: bool = eqx.field(static=True)
    section: Section | None = None
    max_return: Array | None = None
    """The longest time from one crossing to the next, on average."""
    observable: Observable | None = None
    """What is kept of each sample; None: the state."""
    transient_time: Array | None = None
    """The time before which no crossing counts; None: all do."""

    def rows(self, system: System, names: tuple[str, ...], points: Array, states: Array) -> Array:
        """Points in parameter space, with one more column: 1 where the system is after a period
        what it was, so that a clock may start anew."""
        if self._goes_on(system):
            return points

        def repeated(point: Array, x0: Array) -> Array:
            return repeats(*at_point(system, names, point), x0)

        each = jax.vmap(repeated, in_axes=(0, 0 if states.ndim > 1 else None))(points, states)
        return jnp.append(points, each[:, None].astype(points.dtype), axis=1)

    def _goes_on(self, system: System) -> bool:
        return self.section is not None or bool(system.clocks)

    def problem(self, system: System, names: tuple[str, ...], row: Array, x0: Array) -> Problem:
        """That of one of the `rows`."""
        anew = None if self._goes_on(system) else row[len(names)] > 0
        system, period = at_point(system, names, row)
        field, tableau = build(system, x0, compact=self.compact), tableau_of(self.stepper)
        if self.section is not None:
            grid = self._until_crossed(period)
            recording = Recording(num_crossings=self.samples)
            sections = watch_sections((self.section,), field, x0)
            assert sections is not None
            last = self.transient + self.samples
            watched = eqx.tree_at(
                lambda s: (s.terminal, s.unseen, s.since),
                sections,
                ((last,), self.transient, self.transient_time),
                is_leaf=lambda v: v is None,
            )
            return problem_of(field, tableau, grid, recording, watched)
        count = self.transient + self.samples
        grid = grid_of_periods(period, count, self.steps, repeats=anew)
        recorder = SaveSamples(
            size=self.samples,
            modes=self.observable is not None,
            first=(self.transient + 1) * self.steps,
            every=self.steps,
        )
        return problem_of(field, tableau, grid, Recording(recorder))

    def _until_crossed(self, unit: Array) -> TimeGrid:
        """The grid of a run to its last crossing."""
        assert self.max_return is not None
        count = (self.transient + self.samples).astype(unit.dtype)
        dt = unit / self.steps.astype(unit.dtype)
        before = 0.0 if self.transient_time is None else self.transient_time
        most = jnp.ceil((before + count * self.max_return) / dt)
        num_steps = jnp.minimum(most, 2.0**30).astype(jnp.int32)
        length = num_steps.astype(unit.dtype) * dt
        return TimeGrid(jnp.zeros_like(unit), length, dt, num_steps, iteration_budget(num_steps))

    def outcome(self, state: LoopState) -> tuple[SavedStates, RESULTS, Array]:
        """What is sampled of a lane, or of many, outcome, and the last state (n,): of the samples
        the states, at a section their times, and the modes if there is something to be observed."""
        sections = sections_in(state)
        kept = state.saves if sections is None else sections.table
        assert kept is not None
        xs = jnp.where(jnp.isfinite(kept.xs), kept.xs, jnp.nan)
        seen = self.observable is not None
        timed = seen or self.section is not None
        samples = SavedStates(kept.ts if timed else None, xs, kept.modes if seen else None)
        # Components are numbers, or one array of them.
        rows = [v.reshape(*xs.shape[:-2], -1) for v in state.motion.x.parts]
        result = state.result
        if self.section is not None:
            result = (jax.vmap(_at_section) if state.motion.tau.ndim else _at_section)(result)
        return samples, result, jnp.concatenate(rows, axis=-1)

    def seen(
        self, system: System, names: tuple[str, ...], row: Array, x0: Array, samples: SavedStates
    ) -> Array:
        """What is kept of a lane's samples, shape (samples, k); of those at a section with their
        times behind, (samples, k + 1)."""
        values = self._observed(system, names, row, x0, samples)
        if self.section is None:
            return values
        times = jnp.where(jnp.isfinite(samples.ts), samples.ts, jnp.nan)
        return jnp.concatenate([values, times[:, None]], axis=-1)

    def _observed(
        self, system: System, names: tuple[str, ...], row: Array, x0: Array, samples: SavedStates
    ) -> Array:
        """The samples' states, or what is observed of them."""
        if self.observable is None:
            return samples.xs
        problem = self.problem(system, names, row, x0)
        system, period = at_point(system, names, row)
        if self.section is None:
            periods = self.transient + jnp.arange(1, self.samples + 1, dtype=jnp.int32)
            samples = dataclasses.replace(samples, ts=periods.astype(row.dtype) * period)
        values = observed(self.observable, problem, system, x0, samples)
        return jnp.where(jnp.isfinite(values), values, jnp.nan).reshape(self.samples, -1)


def _at_section(result: RESULTS) -> RESULTS:
    """The outcome of a lane that was to end at its last crossing."""
    missed = RESULTS.where(result == RESULTS.successful, RESULTS.section_not_reached, result)
    return RESULTS.where(result == RESULTS.section_reached, RESULTS.successful, missed)


def at_point(system: System, names: tuple[str, ...], row: Array) -> tuple[System, Array]:
    """The system at a point in parameter space, and its period; of an autonomous one the unit of
    time."""
    system = replace_parameters(system, names, [row[i] for i in range(len(names))])
    period = 1.0 if system.period is None else system.period
    return system, jnp.asarray(period, row.dtype)


def checked_section(
    section: object, max_return: Scalar | None, x0: np.ndarray, dtype: np.dtype
) -> tuple[Section, Array]:
    """A section to sample at, its numbers in the precision of the run, and the time that a return
    may take."""
    if not isinstance(section, Section):
        raise ValueError(f"`section` must be a jaxfil.Section, got {section!r}.")
    sections_of("section", section, jnp.zeros(x0.shape[-1:], dtype))
    if section.is_bound:
        raise ValueError("`section` must be one that motions cross, got a bound.")
    longest = check.scalar("max_return", max_return, dtype, positive=True)
    return dataclasses.replace(section, function=cast(section.function, dtype)), longest


def checked_observe(observe: object, system: System, x0: np.ndarray, dtype: np.dtype) -> Observable:
    """What is to be kept of the samples."""
    state = jnp.zeros(x0.shape[-1:], dtype)
    observable = checked_observable("observe", observe, system, state)
    if len(observable.shape) > 1:
        raise ValueError(
            f"`observe` must return a number, or k of them in a row, got shape {observable.shape}."
        )
    return observable
