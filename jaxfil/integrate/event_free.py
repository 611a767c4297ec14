"""Steps of lanes that meet nothing.

In most iterations a lane does no more than step from one grid point to the next, on its own side of
every surface. A `Lane` and the length of its step enter; what is `Ahead` at the end of that step
leaves, whether the way there is clear of contacts, and the lane there. Nothing is decided here: the
way is clear only where `flow.judge` would accept the step too, with the same numbers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.components import Scene, all_finite, any_of, where
from jaxfil.integrate.event_location import stays_off
from jaxfil.integrate.mode_switch import larger, surface_noise
from jaxfil.integrate.recording import keep_sample
from jaxfil.integrate.state import Ahead, Lane, Policy, Span
from jaxfil.integrate.stepper import Tableau, is_too_long, step


def look_ahead(scene: Scene, table: Tableau, span: Span, lane: Lane, h: Array, end: Array) -> Ahead:
    """A step of length h to the elapsed time `end` on the sides that the lane is on; where it
    slides, on side +1, which is not where it goes."""
    t = span.t0 + end
    sides = tuple(jnp.where(s < 0, -jnp.ones_like(s), jnp.ones_like(s)) for s in lane.mode)

    def field(t, x, forcing=None):
        return scene.field(t, x, sides, True, forcing)

    start = span.t0 + lane.tau
    forcing = scene.forcing(start, h, table.times)
    x, error = step(table, field, forcing, start, lane.x, lane.f, h, scene.once)
    f = scene.hold(*scene.field(t, x, sides, forcing=forcing[-1]))
    value, slope = jax.jvp(scene.switching, (t, x), (jnp.ones_like(t), f))
    g = tuple(s * v for s, v in zip(sides, value, strict=True))
    rate = tuple(s * v for s, v in zip(sides, slope, strict=True))
    return Ahead(x, error, f, scene.hold(*g), scene.hold(*rate), forcing)


def is_sliding(lane: Lane) -> Array:
    """Whether a lane slides on any surface."""
    return any_of(tuple(s == 0 for s in lane.mode))


def busy(lane: Lane) -> Array:
    """Whether a lane slides, or is at or near a contact."""
    near = any_of(tuple(~armed for armed in lane.armed))
    return is_sliding(lane) | lane.pending | (lane.cut != 0) | near


def is_clear(
    scene: Scene, table: Tableau, span: Span, lane: Lane, h: Array, end: Array, ahead: Ahead
) -> Array:
    """Whether a step is all there is: on no surface, and no guard comes near zero in it."""
    t, size = span.t0 + end, larger(lane.size, ahead.x)
    _, h_t, normals = scene.gradients(t, ahead.x)
    touch = surface_noise(scene, t, size, h_t, normals)
    clear = ~busy(lane) & all_finite(ahead.x, ahead.f, ahead.g)
    clear = clear & ~is_too_long(table, ahead.error, ahead.f, h, size)
    for j in range(scene.m):
        d0, d1 = h * lane.rate[j], h * ahead.rate[j]
        clear = clear & stays_off(lane.g[j], d0, ahead.g[j], d1, touch[j])
    return clear


def coast(policy: Policy, lane: Lane, end: Array, ahead: Ahead, clear: Array) -> Lane:
    """The lane at the end of a step that was clear, its sample kept; the same lane otherwise."""
    one = clear.astype(jnp.int32)
    after = eqx.tree_at(
        lambda lane: (
            lane.tau,
            lane.rest,
            lane.x,
            lane.f,
            lane.size,
            lane.g,
            lane.rate,
            lane.index,
            lane.num_iterations,
            lane.num_accepted,
        ),
        lane,
        (
            jnp.where(clear, end, lane.tau),
            jnp.where(clear, 0.0, lane.rest),
            where(clear, ahead.x, lane.x),
            where(clear, ahead.f, lane.f),
            where(clear, larger(lane.size, ahead.x), lane.size),
            where(clear, tuple(map(stop_gradient, ahead.g)), lane.g),
            where(clear, ahead.rate, lane.rate),
            lane.index + one,
            lane.num_iterations + one,
            lane.num_accepted + one,
        ),
    )
    return keep_sample(policy, lane, after, ahead.x, clear)
