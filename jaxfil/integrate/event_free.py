"""Steps of lanes that meet nothing.

In most iterations a lane does no more than step from one grid point to the next, on its own side of
every surface. A `LoopState` and the length of its step enter; what is `FreeStep` at the end of that step
leaves, whether the way there is clear of contacts, and the lane there. Nothing is decided here: the
way is clear only where `flow.judge` would accept the step too, with the same numbers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.components import ComponentSystem, all_finite, any_of, where
from jaxfil.integrate.event_location import stays_off
from jaxfil.integrate.mode_switch import larger, surface_noise
from jaxfil.integrate.recording import keep_sample
from jaxfil.integrate.state import FreeStep, LoopState, Recording, TimeGrid
from jaxfil.integrate.stepper import Tableau, is_too_long, step


def try_free_step(
    system: ComponentSystem, table: Tableau, grid: TimeGrid, state: LoopState, h: Array, end: Array
) -> FreeStep:
    """A step of length h to the elapsed time `end` on the sides that the lane is on; where it
    slides, on side +1, which is not where it goes."""
    t = grid.t0 + end
    sides = tuple(jnp.where(s < 0, -jnp.ones_like(s), jnp.ones_like(s)) for s in state.mode)

    def field(t, x, forcing=None):
        return system.field(t, x, sides, True, forcing)

    start = grid.t0 + state.tau
    forcing = system.forcing(start, h, table.times)
    x, error = step(table, field, forcing, start, state.x, state.f, h, system.once)
    f = system.hold(*system.field(t, x, sides, forcing=forcing[-1]))
    value, slope = jax.jvp(system.switching, (t, x), (jnp.ones_like(t), f))
    g = tuple(s * v for s, v in zip(sides, value, strict=True))
    rate = tuple(s * v for s, v in zip(sides, slope, strict=True))
    return FreeStep(x, error, f, system.hold(*g), system.hold(*rate), forcing)


def is_sliding(state: LoopState) -> Array:
    """Whether a lane slides on any surface."""
    return any_of(tuple(s == 0 for s in state.mode))


def is_near_surface(state: LoopState) -> Array:
    """Whether a lane slides, or is at or near a contact."""
    near = any_of(tuple(~armed for armed in state.armed))
    return is_sliding(state) | state.pending | (state.cut != 0) | near


def is_event_free(
    system: ComponentSystem,
    table: Tableau,
    grid: TimeGrid,
    state: LoopState,
    h: Array,
    end: Array,
    ahead: FreeStep,
) -> Array:
    """Whether a step is all there is: on no surface, and no guard comes near zero in it."""
    t, size = grid.t0 + end, larger(state.size, ahead.x)
    _, h_t, normals = system.gradients(t, ahead.x)
    touch = surface_noise(system, t, size, h_t, normals)
    clear = ~is_near_surface(state) & all_finite(ahead.x, ahead.f, ahead.g)
    clear = clear & ~is_too_long(table, ahead.error, ahead.f, h, size)
    for j in range(system.m):
        d0, d1 = h * state.rate[j], h * ahead.rate[j]
        clear = clear & stays_off(state.g[j], d0, ahead.g[j], d1, touch[j])
    return clear


def accept_free_step(
    recording: Recording, state: LoopState, end: Array, ahead: FreeStep, clear: Array
) -> LoopState:
    """The lane at the end of a step that was clear, its sample kept; the same lane otherwise."""
    one = clear.astype(jnp.int32)
    after = eqx.tree_at(
        lambda state: (
            state.tau,
            state.rest,
            state.x,
            state.f,
            state.size,
            state.g,
            state.rate,
            state.index,
            state.num_iterations,
            state.num_accepted,
        ),
        state,
        (
            jnp.where(clear, end, state.tau),
            jnp.where(clear, 0.0, state.rest),
            where(clear, ahead.x, state.x),
            where(clear, ahead.f, state.f),
            where(clear, larger(state.size, ahead.x), state.size),
            where(clear, tuple(map(stop_gradient, ahead.g)), state.g),
            where(clear, ahead.rate, state.rate),
            state.index + one,
            state.num_iterations + one,
            state.num_accepted + one,
        ),
    )
    return keep_sample(recording, state, after, ahead.x, clear)
