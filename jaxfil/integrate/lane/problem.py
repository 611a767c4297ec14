"""What the loop is given: a problem of one lane.

A system on components, a tableau, a grid of steps and what is to be recorded enter, and travel
together from here on as a `Problem`.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.steppers.explicit import Tableau
from jaxfil.integrate.surfaces.sections import WatchedSections
from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select

# Times closer than this many eps of their size are one time.
SAME_TIME = 8


def iteration_budget(num_steps: Array, max_events: int | None = None) -> Array:
    """Iterations after which a run of `num_steps` steps is given up: 32 for each step, and 64 for
    each of `max_events` contacts, which take about four. What runs into it does not end."""
    contacts = 100_000 if max_events is None else 64 * max_events + 1024
    return 32 * jnp.minimum(num_steps, 2**25) + contacts


class ForcingPeriod(eqx.Module):
    """The time after which elapsed times start anew, and how many steps of the grid that is: a
    period of the forcing, or all of the run."""

    length: Array
    steps: Array


class TimeGrid(eqx.Module):
    """The grid: `num_steps` steps of `dt` (signed) from `t0`, the last one ending at `length`.

    Times in the loop are elapsed times, so that a huge t0 costs the grid no accuracy. With a
    `forcing` they start anew from zero at the end of each of its lengths: see `phase`.
    """

    t0: Array
    length: Array
    dt: Array
    num_steps: Array
    max_iterations: Array
    forcing: ForcingPeriod | None = None

    @property
    def direction(self) -> Array:
        """+1 forward in time, −1 backward."""
        return select(self.length < 0, -1.0, 1.0).astype(self.dt.dtype)

    def same_time(self, tau: Array) -> Array:
        """The rounding of times near the elapsed time `tau`."""
        t0, tau, dt = stop_gradient((self.t0, tau, self.dt))
        size = jnp.maximum(jnp.maximum(abs(t0 + tau), abs(tau)), 1e-3 * abs(dt))
        return SAME_TIME * jnp.finfo(dt.dtype).eps * size

    def grid_point(self, index: Array) -> Array:
        """Elapsed time at the end of step number `index` (from 1), counted as elapsed times are."""
        whole = self if self.forcing is None else self.forcing
        count = self.num_steps if self.forcing is None else self.forcing.steps
        return select(index >= count, whole.length, index.astype(self.dt.dtype) * self.dt)


def even_grid(
    t0: Array, length: Array, num_steps: Array, max_events: int | None = None
) -> TimeGrid:
    """The grid of `num_steps` equal steps, with the budget of `iteration_budget`. Only the end has
    a derivative: the steps before it do not move."""
    dt = stop_gradient(length) / num_steps.astype(length.dtype)
    return TimeGrid(t0, length, dt, num_steps, iteration_budget(num_steps, max_events))


def _is_no_period(period: Array) -> Array:
    """Whether a number is negative, zero or infinite."""
    return (period <= 0) | jnp.isinf(period)


def period_outcome(period: Array, result: RESULTS) -> RESULTS:
    """The outcome of lanes that ran for forcing periods, given the one that the loop has found."""
    return RESULTS.where(_is_no_period(period), RESULTS.invalid_period, result)


def grid_of_periods(
    period: Array,
    count: Array,
    steps: Array,
    start: Array | int = 0,
    *,
    repeats: Array | None = None,
) -> TimeGrid:
    """The grid of `count` periods after the first `start` from t = 0 on, `steps` steps each, with a
    clock that starts anew in each if the system `repeats` after it; None: it is not known to. The
    grid is NaN, and a run over it ends at once, where there is no such period: see
    `period_outcome`."""
    period = select(_is_no_period(period), jnp.nan, period)
    num_steps = count * steps
    length, forcing = count.astype(period.dtype) * period, None
    before = jnp.asarray(start, jnp.int32)
    if repeats is not None:
        whole = select(repeats, period, length), select(repeats, steps, num_steps)
        before, forcing = select(repeats, 0, before), ForcingPeriod(*whole)
    return TimeGrid(
        t0=before.astype(period.dtype) * period,
        length=length,
        dt=period / steps.astype(period.dtype),
        num_steps=num_steps,
        max_iterations=iteration_budget(num_steps),
        forcing=forcing,
    )


class Recording(eqx.Module):
    """What is kept on the way.

    `save` is "none", "ts" (the elapsed times `ts`, sorted along the direction of time), "steps"
    (every state between two iterations) or "samples" (every `every`-th grid point from `first`
    on, with the modes if `modes`), and there is space for `num_saves` of them. `max_events` is the
    length of the event table, and `num_crossings` that of the table of crossings; None keeps none
    and sets no limit.
    """

    save: str = eqx.field(static=True)
    max_events: int | None = eqx.field(static=True)
    num_saves: int = eqx.field(static=True, default=0)
    num_crossings: int | None = eqx.field(static=True, default=None)
    modes: bool = eqx.field(static=True, default=False)
    ts: Array | None = None
    first: Array | None = None
    every: Array | None = None


NOTHING = Recording("none", None)
"""Neither states nor events are kept: the end alone is of interest."""


class KeptMode(eqx.Module):
    """A mode in which a lane starts and stays, as if there were no surfaces, where it is `on`."""

    mode: Components
    on: Array


class Problem(eqx.Module):
    """A system to be integrated over a grid by a method, and what is to be recorded."""

    system: ComponentSystem
    tableau: Tableau
    grid: TimeGrid
    recording: Recording
    watched: WatchedSections | None = None
    """Sections whose crossings are located; None: nothing that does is compiled."""
    kept: KeptMode | None = None
    """A mode to stay in; None: contacts are met."""

    @property
    def compact(self) -> bool:
        """Whether the stages of a step are in a loop: see `compact_step`."""
        return self.system.compact
