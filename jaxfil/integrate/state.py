"""The records of one lane of the loop.

The grid of steps (`TimeGrid`), what is kept on the way (`Recording`), the state between two iterations
(`LoopState`) and what is known at the end of a trial step (`StepEnd`): immutable, and without a decision.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.components import Components, ComponentSystem, Forcing
from jaxfil.model.outcomes import RESULTS

# Times closer than this many eps of their size are one time.
SAME_TIME = 8


class TimeGrid(eqx.Module):
    """The grid: `num_steps` steps of `dt` (signed) from `t0`, the last one ending at `length`.

    Times in the loop are elapsed times, so that a huge t0 costs the grid no accuracy.
    """

    t0: Array
    length: Array
    dt: Array
    num_steps: Array
    max_iterations: Array

    @property
    def direction(self) -> Array:
        """+1 forward in time, −1 backward."""
        return jnp.where(self.length < 0, -1.0, 1.0).astype(self.dt.dtype)

    def same_time(self, tau: Array) -> Array:
        """The rounding of times near the elapsed time `tau`."""
        size = jnp.maximum(jnp.maximum(abs(self.t0 + tau), abs(tau)), 1e-3 * abs(self.dt))
        return stop_gradient(SAME_TIME * jnp.finfo(self.dt.dtype).eps * size)

    def grid_point(self, index: Array) -> Array:
        """Elapsed time at the end of step number `index` (from 1)."""
        last = index >= self.num_steps
        return jnp.where(last, self.length, index.astype(self.dt.dtype) * self.dt)


class Recording(eqx.Module):
    """What is compiled and kept.

    `save` is "none", "ts" (the elapsed times `ts`, sorted along the direction of time), "steps"
    (every state between two iterations) or "samples" (every `every`-th grid point from `first`
    on). `max_events` is the length of the event table; None keeps none and sets no limit.
    """

    save: str = eqx.field(static=True)
    max_events: int | None = eqx.field(static=True)
    ts: Array | None = None
    first: Array | None = None
    every: Array | None = None


class EventTable(eqx.Module):
    """Events in order: times (k,), states just before (k, n), sets of surfaces (k, m), kinds, and
    modes just after (k, m)."""

    ts: Array
    xs: Array
    members: Array
    kinds: Array
    modes: Array


class SavedStates(eqx.Module):
    """Saved times (k,), states (k, n) and modes (k, m); of samples the states alone."""

    ts: Array
    xs: Array
    modes: Array


class LoopState(eqx.Module):
    """The state of one lane between two iterations. Blocks of m unless said otherwise."""

    tau: Array  # elapsed time
    rest: Array  # and what its rounding has left out
    x: Components  # state, n components
    f: Components  # field of the mode at (tau, x), n components
    size: Components  # largest |x| so far, n components
    mode: Components  # +1 or -1, 0 while sliding on the surface
    first_mode: Components  # the mode at t0
    g: Components  # guards: positive within the mode
    rate: Components  # dg/dt along f
    armed: Components  # whether the surface has been left since the last contact with it
    noise: Components  # rounding of the guards, kept while not armed
    cut: Array  # signed length to where a contact is expected; 0 if none is
    aim: Components  # the surfaces of that contact
    pending: Array  # whether a landing waits for its switch
    hit: Components  # the surfaces of that landing
    graze: Array  # whether that landing only touches
    index: Array  # grid steps completed
    tries: Array  # rejections in a row
    frozen: Array  # contacts in a row at one and the same time
    contact_tau: Array  # time of the last contact
    num_iterations: Array
    num_accepted: Array
    num_events: Array
    num_saved: Array
    result: RESULTS
    table: EventTable | None
    saves: SavedStates | None


class FreeStep(eqx.Module):
    """State, what is known of its error, and field at the end of a trial step on the sides that a
    lane is on, the guards of these sides with their rates, and the forcing within the step."""

    x: Components
    error: Components
    f: Components
    g: Components
    rate: Components
    forcing: list[Forcing]


class StepEnd(eqx.Module):
    """What is known at the end of a trial step. `num_modes` is how many modes could go on from a
    switch made here (1: all is well); `repels` whether it slides where the surface repels; `moved`
    whether a reset has moved the state. `noise` is the rounding of the guards here, `touch` all
    that may have gathered in them since t0."""

    tau: Array
    x: Components
    f: Components
    size: Components
    mode: Components
    g: Components
    rate: Components
    noise: Components
    touch: Components
    num_modes: Array
    repels: Array
    moved: Array


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


def epsilon(system: ComponentSystem) -> float:
    """Machine epsilon of the scene's precision."""
    return float(jnp.finfo(system.dtype).eps)
