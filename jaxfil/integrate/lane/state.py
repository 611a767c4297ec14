"""The records of the loop.

The state of one lane between two iterations (`LoopState`), what a trial step finds (`FreeStep`,
`StepEnd`) and what has been recorded (`EventTable`, `SavedStates`): immutable, and
without a decision.
"""

from typing import Any, TypeAlias

import equinox as eqx
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import TimeGrid
from jaxfil.integrate.steppers.explicit import Trial
from jaxfil.integrate.system.components import Components, any_of
from jaxfil.model.clock import Ticks
from jaxfil.model.outcomes import RESULTS

Rows: TypeAlias = Any
"""An array with an entry a row, or what stands for it in a loop that keeps checkpoints."""


class EventTable(eqx.Module):
    """Events in order."""

    ts: Rows
    """Times (k,)."""
    xs: Rows
    """States just before, (k, n)."""
    members: Rows
    """Sets of surfaces, (k, m)."""
    kinds: Rows
    """Codes of `EventKind`, (k,)."""
    modes: Rows
    """Modes just after, (k, m)."""


class SavedStates(eqx.Module):
    """Saved times (k,), states (k, n) and modes (k, m); of samples no times, and
    modes only if they are recorded."""

    ts: Rows
    xs: Rows
    modes: Rows


class Turn(eqx.Module):
    """A turn through the sides of coupled surfaces, from one contact to the next of its kind: see
    `accumulation`."""

    kind: Array
    """The kind of the contact that it began with; −1: there has been none."""
    tau: Array
    """The time of that,"""
    rest: Array
    """what its rounding has left out,"""
    x: Components
    """and the state there, n components."""
    length: Array
    """The time that the turn before took; 0: there is none."""
    move: Components
    """How far that has moved the state, n components."""
    left: Array
    """The time from there to the limit of turns, as the one before has predicted it; inf: none,"""
    limit: Components
    """and the state at this limit, n components."""
    met: Components
    """The surfaces met since, m components."""
    late: Array
    """How uncertain the times of these contacts are."""
    contacts: Array
    """How many contacts there have been since."""
    completed: Array
    """Whether the next switch is the one at the limit."""


class CrossingTable(eqx.Module):
    """Crossings of sections in order."""

    ts: Rows
    """Times (k,)."""
    xs: Rows
    """States (k, n)."""
    sections: Rows
    """Numbers of sections, (k,)."""
    modes: Rows
    """Modes just after, (k, m)."""


class Watch(eqx.Module):
    """How far a lane has been watched for crossings of k sections: see `crossing`. Lengths are
    signed times from the lane's state."""

    side: Components
    """The last sign of S, beyond rounding; 0: there has been none. k components."""
    value: Components
    """S where it has been watched up to,"""
    rate: Components
    """dS/dt there along the motion,"""
    away: Components
    """whether S is more than rounding there,"""
    owed: Components
    """and whether it has jumped across zero there. k components each."""
    start: Array
    """The length up to there."""
    seeking: Array
    """Whether the next trial step is one to a crossing, looked at and taken back:"""
    length: Array
    """its length,"""
    aim: Components
    """the section, none for a minimum of |S| to be looked at,"""
    low: Array
    """a length before the crossing,"""
    high: Array
    """and one after it."""
    tries: Array
    """Trial steps that this crossing has taken."""
    counts: Components
    """Crossings so far of each of k sections, in its direction."""
    total: Array
    """Crossings of all of them."""


class LoopState(eqx.Module):
    """The state of one lane between two iterations. Components are m, one for each surface, unless
    said otherwise."""

    tau: Array
    """Elapsed time,"""
    rest: Array
    """and what its rounding has left out: see `later`."""
    x: Components
    """State, n components."""
    f: Components
    """Field of the mode at (tau, x), n components."""
    size: Components
    """Largest |x| of late, n components: see `guards.larger`."""
    mode: Components
    """+1 or −1, 0 while sliding on the surface, +2 or −2 at rest on it from that side."""
    first_mode: Components
    """The mode at t0."""
    g: Components
    """Guards: positive within the mode."""
    rate: Components
    """dg/dt along f."""
    determinant: Array | None
    """That of a slide's weights (`sliding_weights`); None where nothing slides."""
    armed: Components
    """Whether the surface has been left since the last contact with it."""
    noise: Components
    """Rounding of the guards, kept while not armed."""
    cut: Array
    """Signed length to where a contact is expected; 0 if none is."""
    aim: Components
    """The surfaces of that contact."""
    pending: Array
    """Whether a landing waits for its switch."""
    hit: Components
    """The surfaces of that landing."""
    graze: Array
    """Whether that landing only touches."""
    jumped: Array
    """Whether one of them has jumped there."""
    settled: Array | None
    """Whether its resets have been made already; None without resets."""
    turn: Turn | None
    """The turn that it is in; None where contacts cannot accumulate by turns."""
    index: Array
    """Grid steps completed."""
    tries: Array
    """Rejections in a row."""
    frozen: Array
    """Contacts in a row at one and the same time."""
    contact_tau: Array
    """Time of the last contact."""
    num_iterations: Array
    num_accepted: Array
    num_events: Array
    num_saved: Array
    result: RESULTS
    table: EventTable | None
    saves: SavedStates | None
    period_start: Array | None = None
    """Grid steps completed before this period of the forcing; None where time goes on."""
    ticks: Ticks | None = None
    """The next tick of each clock, of a system with clocks."""
    left: Components | None = None
    """The field with which a tick was reached that waits for its switch, n components."""
    watch: Watch | None = None
    """Of a lane with sections."""
    crossings: CrossingTable | None = None

    @property
    def held(self) -> Array:
        """Whether it slides or rests on any surface."""
        slides = any_of(self.mode == 0)
        return slides if self.settled is None else slides | any_of(abs(self.mode) == 2)


class FreeStep(eqx.Module):
    """A trial step on the sides that a lane is on, the field at its end, and the guards of these
    sides there with their rates."""

    trial: Trial
    f: Components
    g: Components
    rate: Components


class Start(eqx.Module):
    """Field, mode and guards at t0, the surfaces whose reset comes first, and the number of modes
    that could go on from there."""

    f: Components
    mode: Components
    g: Components
    rate: Components
    armed: Components
    noise: Components
    owed: Components | None
    num_modes: Array
    determinant: Array | None


class StepEnd(eqx.Module):
    """What is known at the end of a trial step. Components are m, unless said otherwise."""

    tau: Array
    x: Components
    """State, reset and held on its surfaces, n components."""
    f: Components
    """Field of the mode there, n components."""
    size: Components
    """Largest |x| of late, n components: see `guards.larger`."""
    mode: Components
    g: Components
    rate: Components
    noise: Components
    """Rounding of the guards here."""
    touch: Components
    """All rounding that may have gathered in the guards since t0."""
    num_modes: Array
    """How many modes could go on from a switch made here; 1: all is well."""
    determinant: Array | None
    """That of a slide's weights; None where nothing slides."""
    moved: Array
    """Whether a reset has moved the state."""
    members: Components
    """The surfaces that a switch made here is of."""
    next: Components | None
    """The surfaces that ask for another switch at once; None where no surface can."""
    jump: Array | None
    """The time that it takes besides, a chattering that ends in rest or all turns that follow; None
    where there can be none."""
    still: Components | None
    """Surfaces that are rested on, or left with a rate of zero; None without resets."""
    turn: Turn | None
    """The turn after a switch made here; None where contacts cannot accumulate by turns."""


def is_running(grid: TimeGrid, state: LoopState, stop: Array | None = None) -> Array:
    """Whether a lane has something left to do before step number `stop`, by default the last."""
    unfinished = state.index < (grid.num_steps if stop is None else stop)
    affordable = state.num_iterations < grid.max_iterations
    return unfinished & affordable & (state.result == RESULTS.successful)


def later(tau: Array, rest: Array, h: Array) -> tuple[Array, Array]:
    """The elapsed time tau + rest a time h later, rounded, and what the rounding leaves out.

    Long after t0 a contact is located more finely than times are told apart. Without the rest each
    one would shift the motion after it by the rounding of its time, and these shifts add up.
    """
    h = rest + h
    end = tau + h
    return end, stop_gradient(h - (end - tau))
