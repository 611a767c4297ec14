"""What the loop is given: a problem of one lane.

A system on components, a tableau, a grid of steps and what is to be recorded enter, and travel
together from here on as a `Problem`.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.steppers.explicit import Tableau
from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select

# In a run at half the step, by which the error of another is known, a step is halved at this part
# of the error that the other halves it at: where both halve, the lengths of their steps differ.
FINER = 1 / 64
# Times closer than this many eps of their size are one time.
SAME_TIME = 8


def iteration_budget(num_steps: Array, max_events: int | None = None) -> Array:
    """Iterations after which a run of `num_steps` steps is given up: 32 for each step, and 64 for
    each of `max_events` contacts, which take about four. A run that needs more would hardly end."""
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
    `forcing` they start anew from zero at the end of each of its lengths: see `forcing_phase`.
    """

    t0: Array
    length: Array
    dt: Array
    num_steps: Array
    max_iterations: Array
    forcing: ForcingPeriod | None = None
    share: Array | None = None
    """The part of the usual error at which a step is halved; None: all of it."""

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


class Recorder(eqx.Module):
    """Decides which states of a lane are saved, and where; this one saves none.

    A subclass says how much space it takes (`empty`), which time a step must end at (`next_time`)
    and what is saved of a step (`record`).
    """

    name: ClassVar[str] = "t1"
    """What `diffrax.SaveAt` calls it."""
    at_known_times: ClassVar[bool] = True
    """Whether it saves at times that do not depend on the steps."""
    in_free_steps: ClassVar[bool] = False
    """Whether it saves at grid points alone, and has a `keep` for steps that meet nothing: lanes of
    a batch then need no full iteration for them."""
    with_t0: bool = eqx.field(static=True, default=False)
    """Whether the state at t0 is saved too."""

    def since(self, t0: Array) -> "Recorder":
        """The same with elapsed times in place of times."""
        return self

    def empty(self, system: ComponentSystem) -> Any:
        """Space for what is saved, as `SavedStates`; None if nothing is."""
        return None

    def next_time(self, num_saved: Array) -> tuple[Array, Array] | None:
        """The elapsed time that a step must end at to be saved next, and whether there is one;
        None if steps may go to their grid points."""
        return None

    def record(self, problem: "Problem", state: Any, after: Any, step: Any) -> Any:
        """`after`, the `LoopState` that a `Step` has led to from `state`, with what is saved. It is
        called before the extensions follow the lane."""
        return after

    def keep(self, problem: "Problem", state: Any, after: Any, x: Any, gridded: Array) -> Any:
        """`after`, with the state x saved if it is at a grid point just reached (`gridded`) and one
        of those to be saved."""
        raise NotImplementedError(f"{type(self).__name__} does not save in free steps.")


class Recording(eqx.Module):
    """What is kept on the way."""

    recorder: Recorder = Recorder()
    """What is saved of the states."""
    max_events: int | None = eqx.field(static=True, default=None)
    """Length of the table of events; None keeps none and sets no limit."""
    num_crossings: int | None = eqx.field(static=True, default=None)
    """Length of the table of crossings of sections; None keeps none and sets no limit."""


NOTHING = Recording()
"""Neither states nor events are kept: the end alone is of interest."""


class KeptMode(eqx.Module):
    """A mode in which a lane starts and stays, as if there were no surfaces, where it is `on`."""

    mode: Components
    on: Array


class Look(eqx.Module):
    """A trial step that only looks for a crossing of a section, where one is sought."""

    seeking: Array
    length: Array
    """Its signed length."""


class Problem(eqx.Module):
    """A system to be integrated over a grid by a method, and what is to be recorded."""

    system: ComponentSystem
    tableau: Tableau
    grid: TimeGrid
    recording: Recording
    extensions: tuple[Any, ...] = ()
    """Features with a state of their own, `Extension`s."""
    kept: KeptMode | None = None
    """A mode to stay in; None: contacts are met."""
    tick: Array | None = None
    """The elapsed time of the next tick of a clock, that no step goes beyond."""
    ticked: Array | None = None
    """The number of the clock whose tick waits for its switch; −1: none does."""
    look: Look | None = None
    """How far a step goes to look for a crossing."""

    @property
    def compact(self) -> bool:
        """Whether the stages of a step are in a loop: see `compact_step`."""
        return self.system.compact
