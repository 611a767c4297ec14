"""What a lane of a sweep does: how long it runs, and what is kept of it.

A point in parameter space and an initial state enter; the problem to be integrated leaves, and what
is made of the lane at its end.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.components import build
from jaxfil.integrate.problem import (
    Problem,
    Recording,
    TimeGrid,
    grid_of_periods,
    iteration_budget,
)
from jaxfil.integrate.section_values import watch_sections
from jaxfil.integrate.state import LoopState
from jaxfil.integrate.stepper import Stepper, tableau_of
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import replace_parameter
from jaxfil.model.section import Section
from jaxfil.model.system import System


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

    def problem(self, system: System, names: tuple[str, ...], row: Array, x0: Array) -> Problem:
        """That of one point in parameter space."""
        system, period = at_point(system, names, row)
        field, tableau = build(system, x0), tableau_of(self.stepper)
        if self.section is not None:
            grid = self._until_crossed(period)
            recording = Recording("none", None, num_crossings=self.samples)
            sections = watch_sections((self.section,), field, x0)
            assert sections is not None
            last = self.transient + self.samples
            watched = eqx.tree_at(
                lambda s: (s.terminal, s.unseen),
                sections,
                ((last,), self.transient),
                is_leaf=lambda v: v is None,
            )
            return Problem(field, tableau, grid, recording, self.compact, watched)
        count = self.transient + self.samples
        grid = grid_of_periods(period, count, self.steps, forced=not system.clocks)
        recording = Recording(
            save="samples",
            max_events=None,
            num_saves=self.samples,
            first=(self.transient + 1) * self.steps,
            every=self.steps,
        )
        return Problem(field, tableau, grid, recording, self.compact)

    def _until_crossed(self, unit: Array) -> TimeGrid:
        """The grid of a run to its last crossing."""
        assert self.max_return is not None
        count = (self.transient + self.samples).astype(unit.dtype)
        dt = unit / self.steps.astype(unit.dtype)
        most = jnp.ceil(count * self.max_return / dt)
        num_steps = jnp.minimum(most, 2.0**30).astype(jnp.int32)
        length = num_steps.astype(unit.dtype) * dt
        return TimeGrid(jnp.zeros_like(unit), length, dt, num_steps, iteration_budget(num_steps))

    def outcome(self, state: LoopState) -> tuple[Array, RESULTS, Array]:
        """Samples (samples, n), outcome, and the last state (n,) of a lane, or of many."""
        kept = state.saves if self.section is None else state.crossings
        assert kept is not None
        xs = jnp.where(jnp.isfinite(kept.xs), kept.xs, jnp.nan)
        # Components are numbers, or one array of them.
        rows = [v.reshape(*xs.shape[:-2], -1) for v in state.x]
        result = state.result
        if self.section is not None:
            result = (jax.vmap(_at_section) if state.tau.ndim else _at_section)(result)
        return xs, result, jnp.concatenate(rows, axis=-1)


def _at_section(result: RESULTS) -> RESULTS:
    """The outcome of a lane that was to end at its last crossing."""
    missed = RESULTS.where(result == RESULTS.successful, RESULTS.section_not_reached, result)
    return RESULTS.where(result == RESULTS.section_reached, RESULTS.successful, missed)


def at_point(system: System, names: tuple[str, ...], row: Array) -> tuple[System, Array]:
    """The system at a point in parameter space, and its period; of an autonomous one the unit of
    time."""
    for i, name in enumerate(names):
        system = replace_parameter(system, name, row[i])
    period = 1.0 if system.period is None else system.period
    return system, jnp.asarray(period, row.dtype)
