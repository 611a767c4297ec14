"""The records of the loop.

A `Motion` describes a lane at one time. The `LoopState` of a lane between two iterations holds one,
with the contact that it aims at, the landing that waits for its switch, counts and tables; the
`StepEnd` of a trial step holds the next. All are immutable and contain no decisions.
"""

import functools as ft
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import TimeGrid
from jaxfil.integrate.steppers.explicit import Trial
from jaxfil.integrate.system.components import Components, any_of
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.model.outcomes import RESULTS

Column: TypeAlias = Any
"""An array with an entry a row, or its counterpart in a loop with checkpoints."""


class Table(eqx.Module):
    """Arrays with rows that are written once. A loop with checkpoints has buffers for them."""


class EventTable(Table):
    """Events in order."""

    ts: Column
    """Times (k,)."""
    xs: Column
    """States just before, (k, n)."""
    members: Column
    """Sets of surfaces, (k, m)."""
    kinds: Column
    """Codes of `EventKind`, (k,)."""
    modes: Column
    """Modes just after, (k, m)."""


class SavedStates(Table):
    """Saved times (k,), states (k, n) and modes (k, m). Samples of a sweep have no times, and modes
    only if these are recorded."""

    ts: Column
    xs: Column
    modes: Column


class CrossingTable(Table):
    """Crossings of sections in order."""

    ts: Column
    """Times (k,)."""
    xs: Column
    """States (k, n)."""
    sections: Column
    """Numbers of sections, (k,)."""
    modes: Column
    """Modes just after, (k, m)."""


class Motion(eqx.Module):
    """A motion at one time. Components are m, one for each surface, unless stated otherwise."""

    tau: Array
    """Elapsed time."""
    x: Components
    """State, n components."""
    f: Components
    """Field of the mode at (tau, x), n components."""
    scale: Components
    """Running maximum of |x| with geometric forgetting, n components (see `guards.larger`)."""
    mode: Components
    """+1 or −1, 0 while sliding on the surface, +2 or −2 at rest on it from that side."""
    g: Components
    """Guards, positive within the mode."""
    rate: Components
    """dg/dt along f."""
    noise: Components
    """Rounding error of the guards."""
    determinant: Array | None
    """Determinant of the equations of a slide's weights (`weights.determinant`); None for systems
    that never slide."""


class ContactSearch(eqx.Module):
    """The contact that the next trial step aims at."""

    length: Array
    """Signed length to the contact; 0 if none is expected."""
    surfaces: Components
    """Surfaces of the contact, m flags."""
    rejections: Array
    """Number of consecutive rejected trial steps."""


class Pending(eqx.Module):
    """A landing that waits for its switch, and a count of contacts at one time."""

    waits: Array
    """Whether a landing waits."""
    surfaces: Components
    """Surfaces of the landing, m flags."""
    grazes: Array
    """Whether the contact is a graze."""
    jumped: Array
    """Whether a field, H or the state has jumped, at a tick or by a reset."""
    across: Components
    """Surfaces whose H may have jumped at the same time, m flags."""
    together: Array | None
    """Whether the surfaces of the landing are decided together, and not one after the other; None
    for separate surfaces and for systems with resets."""
    planned: Array | None
    """Whether the decision of the switch before holds for this one too; None where there is never
    another switch for it."""
    plan: Components
    """The mode of that decision."""
    repeats: Array
    """Number of consecutive contacts at one time."""
    tau: Array
    """Elapsed time of the last contact."""


class Trust(eqx.Module):
    """The largest length of a trial step (see `loop.halving`)."""

    longest: Array
    """The largest trusted length, without sign; inf where the grid's step is trusted."""
    ceiling: Array
    """The length that was refused last; inf after it has been accepted since."""
    taken: Array
    """Number of steps accepted since the last refusal."""
    refused: Array
    """Number of refusals of the shortest steps since a longer one was accepted."""
    halvings: Array
    """Number of refusals since t0."""
    error: Array | None = None
    """The relative error of the last step; None without a tolerance."""


class Counts(eqx.Module):
    """Counts since t0."""

    index: Array
    """Number of completed grid steps."""
    num_iterations: Array
    """Number of iterations of the loop."""
    num_accepted: Array
    """Number of accepted trial steps."""
    num_events: Array
    """Number of events: contacts, and ticks that change the state or a mode."""
    num_saved: Array
    """Number of saved states."""
    period_start: Array | None = None
    """Grid steps completed before this period of the forcing; None if elapsed times never
    restart."""
    num_ticks: Array | None = None
    """Number of ticks without a surface among the events; None if ticks have no map."""

    @property
    def at_surfaces(self) -> Array:
        """Number of events that are not ticks alone."""
        return self.num_events if self.num_ticks is None else self.num_events - self.num_ticks

    @property
    def in_period(self) -> Array:
        """Grid steps completed in this period of the forcing."""
        return self.index if self.period_start is None else self.index - self.period_start


class LoopState(eqx.Module):
    """The state of one lane between two iterations."""

    motion: Motion
    tau_low: Array
    """The low-order part of the elapsed time (see `later`)."""
    first_mode: Components
    """The mode at t0, m components."""
    armed: Components
    """Whether the guard has exceeded rounding since the last contact with the surface, m flags."""
    search: ContactSearch
    trust: Trust
    pending: Pending
    counts: Counts
    result: RESULTS
    table: EventTable | None
    saves: SavedStates | None
    settled: Array | None
    """Whether the resets of the pending landing are already applied; None without resets."""
    turn: Any
    """The current `turn.Turn`; None if contacts cannot accumulate by turns."""
    extensions: tuple[Any, ...] = ()
    """The states of the run's `Extension`s, in their order."""

    @property
    def held(self) -> Array:
        """Whether the lane slides or rests on any surface."""
        # Only systems with resets rest, and `settled` is None without them.
        slides = any_of(self.motion.mode == 0)
        return slides if self.settled is None else slides | any_of(abs(self.motion.mode) == 2)


class FreeStep(eqx.Module):
    """A trial step in the current mode, with the field, guards and guard rates at its end, and the
    motion within the step if it is a polynomial."""

    trial: Trial
    f: Components
    g: Components
    rate: Components
    path: Polynomial | None


class StepEnd(eqx.Module):
    """The end of a trial step, after a pending switch has been carried out there. Components are m
    unless stated otherwise."""

    motion: Motion
    """State after reset and projection onto its surfaces, with mode, field and guards."""
    gathered: Components
    """Bound of the rounding accumulated in the guards since t0."""
    num_modes: Array
    """Number of modes that could follow the switch; 1 means that the motion is unique."""
    moved: Array
    """Whether a map has changed the state."""
    ticked: Array | None
    """Whether the map of a tick was applied; None without such maps."""
    off: Components
    """Surfaces that the state has been moved off, by a jump of H or by a map."""
    members: Components
    """Surfaces of the switch, including those whose mode it changes."""
    next: Components | None
    """Surfaces that need another switch at the same time; None if no surface can."""
    again: Array | None
    """Whether all other surfaces need another switch, after a jump; None without jumps."""
    plan: Components | None
    """The mode decided here, of which the next switch carries out the rest; None without
    `again`."""
    planned: Array | None
    """Whether `plan` is the next switch's mode."""
    ticks: Array | None
    """Whether the tick of another clock follows at the same time; None without several clocks."""
    misfit: Array | None
    """Whether surfaces cannot be decided one after the other; None if they never are."""
    jump: Array | None
    """Additional time that the switch takes, for a chattering that ends in rest or for all
    remaining turns of an accumulation, and otherwise zero, with the derivative of the time to the
    next surface; None for systems without either."""
    still: Components | None
    """Surfaces that the motion rests on or leaves with zero rate; None without resets."""
    turn: Any
    """The turn after the switch; None if contacts cannot accumulate by turns."""

    @property
    def between(self) -> Array | None:
        """Whether another switch follows at the same time; None if none can. The state is then one
        between two maps, and its mode is not decided yet."""
        follows = [v for v in (self.again, self.ticks) if v is not None]
        if self.next is not None:
            due = any_of(self.next)
            if self.jump is not None:  # time passes before the next switch
                due = due & ~(self.jump > 0)
            follows = [due, *follows]
        return ft.reduce(jnp.logical_or, follows) if follows else None


def tables_of(state: LoopState) -> list[Any]:
    """All tables of a lane, for events, saved states and crossings."""
    # This includes tables in the states of extensions.
    found = jax.tree.leaves(state, is_leaf=lambda v: isinstance(v, Table))
    return [v for v in found if isinstance(v, Table)]


def is_running(grid: TimeGrid, state: LoopState, stop: Array | None = None) -> Array:
    """Whether a lane has steps to do before step number `stop`, by default the last one."""
    unfinished = state.counts.index < (grid.num_steps if stop is None else stop)
    # A lane that has used up its iterations stops here, and `iterate.finish` sets its outcome.
    affordable = state.counts.num_iterations < grid.max_iterations
    return unfinished & affordable & (state.result == RESULTS.successful)


def later(tau: Array, low: Array, h: Array) -> tuple[Array, Array]:
    """The elapsed time tau + low after a further time h, as its rounded value and the remainder.

    Long after t0 a contact is located more finely than the spacing of floating-point times. Without
    the low-order part each contact would shift the motion after it by the rounding of its time, and
    these shifts add up. This is compensated summation.
    """
    h = low + h
    # The order of these operations matters. `end − tau` is the part of h that the rounded sum
    # contains, and the difference from h is the part that it has lost.
    end = tau + h
    # The derivative of the time is carried by `end` alone.
    return end, stop_gradient(h - (end - tau))
