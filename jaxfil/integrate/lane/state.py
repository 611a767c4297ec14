"""The records of the loop.

A `Motion` is what is known of a lane at one time. The `LoopState` of a lane between two iterations
holds one, with the contact it aims at, the landing that waits for its switch, counts and tables;
the `StepEnd` of a trial step holds the next. All are immutable, and without a decision.
"""

from typing import Any, TypeAlias

import equinox as eqx
import jax
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import TimeGrid
from jaxfil.integrate.steppers.explicit import Trial
from jaxfil.integrate.system.components import Components, Polynomial, any_of
from jaxfil.model.outcomes import RESULTS

Column: TypeAlias = Any
"""An array with an entry a row, or what stands for it in a loop that keeps checkpoints."""


class EventTable(eqx.Module):
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


class SavedStates(eqx.Module):
    """Saved times (k,), states (k, n) and modes (k, m); of samples no times, and
    modes only if they are recorded."""

    ts: Column
    xs: Column
    modes: Column


class CrossingTable(eqx.Module):
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
    """A motion at one time. Components are m, one for each surface, unless said otherwise."""

    tau: Array
    """Elapsed time."""
    x: Components
    """State, n components."""
    f: Components
    """Field of the mode at (tau, x), n components."""
    scale: Components
    """Running maximum of |x| with geometric forgetting, n components: see `guards.larger`."""
    mode: Components
    """+1 or −1, 0 while sliding on the surface, +2 or −2 at rest on it from that side."""
    g: Components
    """Guards: positive within the mode."""
    rate: Components
    """dg/dt along f."""
    noise: Components
    """Rounding of the guards."""
    determinant: Array | None
    """Determinant of the equations of a slide's weights (`weights.determinant`); None where nothing
    slides."""


class ContactSearch(eqx.Module):
    """The contact that the next trial step aims at."""

    length: Array
    """Signed length to it; 0 if none is expected."""
    surfaces: Components
    """Its surfaces, m flags."""
    rejections: Array
    """Trial steps rejected in a row."""


class Pending(eqx.Module):
    """A landing that waits for its switch, and how often contacts have followed each other."""

    waits: Array
    """Whether there is one."""
    surfaces: Components
    """Its surfaces, m flags."""
    grazes: Array
    """Whether it only touches."""
    jumped: Array
    """Whether a field, H or the state has jumped: a tick, or what a map has led to."""
    across: Components
    """Surfaces whose H may have jumped with it, m flags."""
    together: Array | None
    """Whether its surfaces are decided together, and not one after the other; None where there is
    nothing to choose between."""
    repeats: Array
    """Contacts in a row at one and the same time."""
    tau: Array
    """Elapsed time of the last contact."""


class Trust(eqx.Module):
    """How long a trial step may be: see `loop.halving`."""

    longest: Array
    """Its length at most, of any direction; inf where that of the grid is trusted."""
    ceiling: Array
    """The length that was refused last; inf where it has been taken since."""
    taken: Array
    """Steps taken since then."""
    refused: Array
    """Refusals of the shortest steps since one was taken that was not so short."""
    halvings: Array
    """All refusals since t0."""
    error: Array | None = None
    """The relative error of the last step; None where no tolerance is asked for."""


class Counts(eqx.Module):
    """What has been counted since t0."""

    index: Array
    """Grid steps completed."""
    num_iterations: Array
    """Iterations of the loop."""
    num_accepted: Array
    """Trial steps accepted."""
    num_events: Array
    """Contacts."""
    num_saved: Array
    """States saved."""
    period_start: Array | None = None
    """Grid steps completed before this period of the forcing; None where elapsed times go on."""

    @property
    def in_period(self) -> Array:
        """Grid steps completed in this period of the forcing."""
        return self.index if self.period_start is None else self.index - self.period_start


class LoopState(eqx.Module):
    """The state of one lane between two iterations."""

    motion: Motion
    tau_low: Array
    """The low-order part of the elapsed time: see `later`."""
    first_mode: Components
    """The mode at t0, m components."""
    armed: Components
    """Whether a surface has been left since the last contact with it, m flags."""
    search: ContactSearch
    trust: Trust
    pending: Pending
    counts: Counts
    result: RESULTS
    table: EventTable | None
    saves: SavedStates | None
    settled: Array | None
    """Whether resets of the pending landing have been made already; None without resets."""
    turn: Any
    """The `accumulation.Turn` it is in; None where contacts cannot accumulate by turns."""
    extensions: tuple[Any, ...] = ()
    """The states of the `Extension`s of the run, in their order."""

    @property
    def held(self) -> Array:
        """Whether it slides or rests on any surface."""
        slides = any_of(self.motion.mode == 0)
        return slides if self.settled is None else slides | any_of(abs(self.motion.mode) == 2)


class FreeStep(eqx.Module):
    """A trial step on the sides that a lane is on, the field at its end, the guards of these sides
    there with their rates, and the motion within the step where it is a polynomial."""

    trial: Trial
    f: Components
    g: Components
    rate: Components
    path: Polynomial | None


class StepEnd(eqx.Module):
    """The end of a trial step, a pending switch made there. Components are m, unless said
    otherwise."""

    motion: Motion
    """State reset and projected onto its surfaces, mode, field and guards."""
    gathered: Components
    """All rounding that may have gathered in the guards since t0."""
    num_modes: Array
    """How many modes could go on from a switch made here; 1: the motion is unique."""
    moved: Array
    """Whether a map has moved the state."""
    ticked: Array | None
    """Whether that of a tick has; None where there is none."""
    off: Components
    """Surfaces that a jump of H, or a map, has led the state off."""
    members: Components
    """The surfaces of a switch made here, or those whose mode it changes."""
    next: Components | None
    """The surfaces that ask for another switch at once; None where no surface can."""
    again: Array | None
    """Whether all others do, since something has jumped; None where nothing can."""
    misfit: Array | None
    """Whether surfaces cannot be met one after the other; None where they are not."""
    jump: Array | None
    """The time that it takes besides: a chattering that ends in rest, or all turns that follow, or
    none, with the derivative of the time to the next surface; None where there can be neither."""
    still: Components | None
    """Surfaces that are rested on, or left with a rate of zero; None without resets."""
    turn: Any
    """The turn after a switch made here; None where contacts cannot accumulate by turns."""


def tables_of(state: LoopState) -> list[Any]:
    """All tables of a lane: of events, of saved states and of crossings."""
    kinds = EventTable, SavedStates, CrossingTable
    found = jax.tree.leaves(state, is_leaf=lambda v: isinstance(v, kinds))
    return [v for v in found if isinstance(v, kinds)]


def is_running(grid: TimeGrid, state: LoopState, stop: Array | None = None) -> Array:
    """Whether a lane has something left to do before step number `stop`, by default the last."""
    unfinished = state.counts.index < (grid.num_steps if stop is None else stop)
    affordable = state.counts.num_iterations < grid.max_iterations
    return unfinished & affordable & (state.result == RESULTS.successful)


def later(tau: Array, low: Array, h: Array) -> tuple[Array, Array]:
    """The elapsed time tau + low a time h later, as its rounded value and what rounding leaves out.

    Long after t0 a contact is located more finely than times are told apart. Without the low-order
    part each one would shift the motion after it by the rounding of its time, and these shifts add
    up.
    """
    h = low + h
    end = tau + h
    return end, stop_gradient(h - (end - tau))
