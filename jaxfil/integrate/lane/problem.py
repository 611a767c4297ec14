"""The problem of one lane: a system on components, a tableau, a time grid and recording options.

The loop and its extensions receive these together, as a `Problem`.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.steppers.explicit import Tableau
from jaxfil.integrate.system.components import Components
from jaxfil.integrate.system.functions import size_of_time
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select

# Factor on the error at which a step is halved, for the run at half the step that estimates the
# error of another run. Without it both could halve to the same lengths, and their difference would
# not show the error.
FINER = 1 / 64
# Times closer than this many eps of their size are one time.
SAME_TIME = 8
# The same, as a multiple, where an orbit is closed, whose states have the error of a solution.
_SAME_END = 4


def iteration_budget(num_steps: Array, max_events: int | None = None) -> Array:
    """The number of iterations after which a run of `num_steps` steps is given up: 32 for each
    step, up to 2²⁵ steps, and 64 for each of `max_events` contacts, which take about four, with
    1,024 to spare; 100,000 for contacts without a limit. A run that exhausts it is treated as one
    that does not terminate."""
    # Both terms are at most 2³⁰, so that their sum is within an int32.
    contacts = 100_000 if max_events is None else min(64 * max_events + 1024, 2**30 - 1)
    return 32 * jnp.minimum(num_steps, 2**25) + contacts


class ForcingPeriod(eqx.Module):
    """The interval after which elapsed times restart, and its number of grid steps. It is a period
    of the forcing, or the whole run."""

    length: Array
    steps: Array


class TimeGrid(eqx.Module):
    """The grid: `num_steps` steps of `dt` (signed) from `t0`, the last one ending at `length`.

    Times in the loop are elapsed times, so that a large t0 does not reduce the accuracy of the
    grid. With a `forcing` they restart from zero after each of its intervals (`forcing_phase`).
    """

    t0: Array
    length: Array
    dt: Array
    num_steps: Array
    max_iterations: Array
    forcing: ForcingPeriod | None = None
    share: Array | None = None
    """The factor on the usual error limit at which a step is halved; None stands for 1."""
    end: Array | None = None
    """The time at the end, which t0 + length misses by rounding; None stands for that sum. Ticks of
    clocks belong to a run by its two ends (`lane/clocks`)."""
    closes: bool = eqx.field(static=True, default=False)
    """Whether this is an arc of a closed orbit, which starts where another one ends, or itself, up
    to the error of a solution."""

    @property
    def direction(self) -> Array:
        """+1 forward in time, −1 backward."""
        # Not the sign of the length, which is 0 for an empty span and NaN for an invalid one.
        return select(self.length < 0, -1.0, 1.0).astype(self.dt.dtype)

    def grid_point(self, index: Array) -> Array:
        """Elapsed time at the end of step number `index` (from 1), within the forcing interval."""
        # Products, since a sum of steps would add up their rounding. The last point is the end
        # itself, which a product may miss by rounding.
        whole = self if self.forcing is None else self.forcing
        count = self.num_steps if self.forcing is None else self.forcing.steps
        return select(index >= count, whole.length, index.astype(self.dt.dtype) * self.dt)


def even_grid(
    t0: Array,
    length: Array,
    num_steps: Array,
    max_events: int | None = None,
    end: Array | None = None,
) -> TimeGrid:
    """The grid of `num_steps` equal steps, with the budget of `iteration_budget`. Only its end has
    a derivative with respect to `length`; the grid points before it are constants."""
    dt = stop_gradient(length) / num_steps.astype(length.dtype)
    return TimeGrid(t0, length, dt, num_steps, iteration_budget(num_steps, max_events), end=end)


def budget_with_ticks(grid: TimeGrid, clocks: Sequence[tuple[Array, Array]]) -> Array:
    """The iteration budget of a grid, with one more step for each tick of the clocks in its span,
    since ticks end steps."""
    ticks = sum(abs(grid.length) / period for period, _ in clocks)
    # A span or a period that is no number ends the run at once.
    ticks = stop_gradient(jnp.nan_to_num(jnp.minimum(ticks, 2.0**25))).astype(jnp.int32)
    given, most = grid.max_iterations, 2**31 - 1
    # A budget of zero stays zero, for a run that is to end at once.
    return select(given == 0, 0, given + jnp.minimum(32 * ticks, most - given))


def _is_no_period(period: Array) -> Array:
    """Whether a number is negative, zero or infinite."""
    return (period <= 0) | jnp.isinf(period)


def period_outcome(period: Array, result: RESULTS) -> RESULTS:
    """The outcome of a lane whose forcing or clock has this period, given its other outcome."""
    return RESULTS.where(_is_no_period(period), RESULTS.invalid_period, result)


def grid_of_periods(
    period: Array,
    count: Array,
    steps: Array,
    start: Array | int = 0,
    *,
    repeats: Array | None = None,
) -> TimeGrid:
    """The grid of `count` periods, `steps` steps each, after the first `start` periods from t = 0.
    Elapsed times restart in each period where `repeats` is true; None means that this is unknown.
    For an invalid period the grid is NaN, which ends the run at once (see `period_outcome`)."""
    period = select(_is_no_period(period), jnp.nan, period)
    num_steps = count * steps
    length, forcing = count.astype(period.dtype) * period, None
    before = jnp.asarray(start, jnp.int32)
    if repeats is not None:
        # The interval of a system that may not repeat is the whole run, so that elapsed times do
        # not restart.
        whole = select(repeats, period, length), select(repeats, steps, num_steps)
        # A system that repeats is the same after any number of periods, so it starts at t0 = 0.
        before, forcing = select(repeats, 0, before), ForcingPeriod(*whole)
    return TimeGrid(
        t0=before.astype(period.dtype) * period,
        length=length,
        dt=period / steps.astype(period.dtype),
        num_steps=num_steps,
        max_iterations=iteration_budget(num_steps),
        forcing=forcing,
        # The same number as the t0 of the periods that follow.
        end=(before + count).astype(period.dtype) * period,
    )


class Recorder(eqx.Module):
    """The rule for which states of a lane are saved, and where; this base class saves no state.

    A subclass defines the space it takes (`empty`), the time at which a step must end
    (`next_time`) and the data saved for a step (`record`).
    """

    name: ClassVar[str] = "t1"
    """The name in messages; the argument of `diffrax.SaveAt` if there is one."""
    at_known_times: ClassVar[bool] = True
    """Whether the saving times are independent of the steps."""
    follows_contacts: ClassVar[bool] = False
    """Whether the run follows every contact: an accumulation is then not completed by a jump to its
    limit before its flights take no time."""
    in_free_steps: ClassVar[bool] = False
    """Whether states are saved at grid points alone, by a method `keep` for steps without contact;
    lanes of a batch then need no full iteration for these steps."""
    with_t0: bool = eqx.field(static=True, default=False)
    """Whether the state at t0 is saved too."""

    def since(self, t0: Array) -> "Recorder":
        """The same recorder with elapsed times in place of times."""
        return self

    def empty(self, system: ComponentSystem) -> Any:
        """Empty buffers for the saved states, a `Table`; None for a recorder without. The state at
        t0 is not known here; an extension receives it in `begin`."""
        return None

    def next_time(self, num_saved: Array) -> tuple[Array, Array, Array] | None:
        """The next elapsed time at which a step must end to be saved, whether there is one, and
        whether there are more after it; None if steps end at grid points alone."""
        return None

    def record(self, problem: "Problem", state: Any, after: Any, step: Any) -> Any:
        """The lane `after` a `Step` from `state`, a `LoopState`, with the states to be saved.
        `after` has the counts and the events of the step. The loop calls this before `after_step`
        of extensions. The state to be saved is `step.end.motion` where `step.settled`, or `saving`
        at a time between grid points; a landing is saved with the last switch that follows it."""
        return after

    def at_section(self, problem: "Problem", state: Any) -> Any:
        """The lane `state` after the loop, with its end saved if a section has ended the run there
        and the rule selects it."""
        return state

    def keep(self, problem: "Problem", state: Any, after: Any, x: Any, gridded: Array) -> Any:
        """The lane `after`, with the state x saved if it is at a grid point just reached
        (`gridded`) that the recorder selects."""
        raise NotImplementedError(f"{type(self).__name__} does not save in free steps.")


class Recording(eqx.Module):
    """Options of recording."""

    recorder: Recorder = Recorder()
    """The rule for saved states."""
    max_events: int | None = eqx.field(static=True, default=None)
    """Length of the table of events; None for no table and no limit."""
    num_crossings: int | None = eqx.field(static=True, default=None)
    """Length of the table of crossings of sections; None for no table and no limit."""


NOTHING = Recording()
"""Recording of neither states nor events, for runs of which only the end is used."""


class KeptMode(eqx.Module):
    """A mode that a lane stays in from the start, without contacts, while `on` is true."""

    mode: Components
    on: Array


class Look(eqx.Module):
    """A trial step that only searches for a crossing of a section."""

    seeking: Array
    length: Array
    """The signed length of the trial step."""


class Problem(eqx.Module):
    """A system to be integrated over a grid by a method, and the recording options."""

    system: ComponentSystem
    tableau: Tableau
    grid: TimeGrid
    recording: Recording
    extensions: tuple[Any, ...] = ()
    """Features with a state of their own (`Extension`)."""
    kept: KeptMode | None = None
    """A mode to stay in; None for a run with contacts."""
    tick: Array | None = None
    """The elapsed time of the next tick of a clock, which no step passes."""
    ticked: Array | None = None
    """The number of the clock whose tick waits for its switch; −1 without one."""
    look: Look | None = None
    """The step by which a crossing is searched for."""

    @property
    def compact(self) -> bool:
        """Whether the stages of a step are in a loop (see `compact_step`)."""
        return self.system.compact

    def same_time(self, tau: Array) -> Array:
        """The rounding of times near the elapsed time `tau`, within which two times are one."""
        # A tolerance is a constant in derivatives.
        grid, clocks = self.grid, self.system.clocks
        t0, tau, dt, clocks = stop_gradient((grid.t0, tau, grid.dt, clocks))
        # The last term is a floor, so that the rounding is not zero at t = 0.
        size = jnp.maximum(jnp.maximum(abs(t0 + tau), abs(tau)), 1e-3 * abs(dt))
        return SAME_TIME * self.system.eps * size_of_time(clocks, size)

    def ticks_at(self, tau: Array) -> Array:
        """Whether the next tick is at the elapsed time `tau`, or within rounding of it."""
        assert self.tick is not None
        ahead = stop_gradient(self.tick - tau) * self.grid.direction
        return ahead <= self.same_time(tau)

    @property
    def same_end(self) -> Array | None:
        """The time from either end of an arc of a closed orbit within which a contact belongs to
        the arc that ends there; None for any other run, whose start is exact."""
        return _SAME_END * self.same_time(self.grid.length) if self.grid.closes else None
