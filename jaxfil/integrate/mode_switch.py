"""The switch: what is known at the end of a step, and the mode that goes on after a contact.

A trial step's end enters; a `View` of it leaves: the state (reset, and held on the surfaces it
slides on), the mode, its field, the guards and their rates. Only a lane whose last iteration landed
on a contact changes its mode, here, where all fields are taken at the corrected state.
"""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate import filippov
from jaxfil.integrate.components import Blocks, Forcing, Scene, all_finite, any_of, axpy, where
from jaxfil.integrate.state import Ahead, Lane, Span, View, epsilon

# A guard is zero to rounding below this many eps times the size of its terms.
_NOISE = 32


def surface_noise(scene: Scene, t: Array, size: Blocks, h_t: Blocks, normals: tuple) -> Blocks:
    """What rounding of t and x does to H: a multiple of eps and of the size of its terms, given the
    size of x."""
    out = []
    for j in range(scene.m):
        terms = sum(abs(v) * s for v, s in zip(normals[j], size, strict=True))
        out.append(stop_gradient(_NOISE * epsilon(scene) * (terms + abs(h_t[j] * t))))
    return tuple(out)


def _project(x: Blocks, h: Blocks, normals: tuple, on: Blocks) -> Blocks:
    """x moved along the normals onto the surfaces marked `on`, one after the other."""
    for h_j, normal, on_j in zip(h, normals, on, strict=True):
        size = sum(v * v for v in normal)
        push = jnp.where(on_j, h_j / jnp.where(size == 0, 1, size), 0.0)
        x = axpy(x, -push, normal)
    return x


def larger(size: Blocks, x: Blocks) -> Blocks:
    """The largest |x| so far."""
    return tuple(jnp.maximum(s, stop_gradient(abs(v))) for s, v in zip(size, x, strict=True))


def look(
    scene: Scene,
    span: Span,
    lane: Lane,
    tau: Array,
    x: Blocks,
    forcing: Forcing,
    ahead: Ahead | None = None,
) -> View:
    """The state, mode, field, guards and rates at the end of a step; a pending switch is made.

    `forcing` is that of the end: see `Scene.forcing`. What is known `ahead` is taken for a lane
    that stays on its sides, to the last bit.
    """
    t = span.t0 + tau
    one, false = jnp.ones((), jnp.int32), jnp.zeros((), bool)
    if scene.m == 0:
        size = larger(lane.size, x)
        f = scene.field(t, x, (), forcing=forcing)
        return View(tau, x, f, size, (), (), (), (), (), one, false, false)
    moved: Array = false
    if scene.resets:
        surface = jnp.argmax(jnp.stack(lane.hit))
        after = where(lane.pending & ~lane.graze, scene.reset(t, x, surface), x)
        moved = any_of(tuple(a != b for a, b in zip(after, x, strict=True)))
        x = after
    h, h_t, normals = scene.gradients(t, x)
    size = larger(lane.size, x)
    here = tuple(jnp.maximum(abs(a), abs(b)) for a, b in zip(lane.x, x, strict=True))
    noise = surface_noise(scene, t, here, h_t, normals)
    touch = surface_noise(scene, t, size, h_t, normals)
    if scene.slides:
        landed = lane.pending & ~lane.graze & ~moved
        held = zip(lane.mode, lane.hit, strict=True)
        on = tuple(((s == 0) & ~moved) | (landed & hit) for s, hit in held)
        x = _project(x, h, normals, on)
        x = scene.hold(*x)
    fields, rates = filippov.corners(scene, t, x, forcing=forcing)
    mode, num_modes = _switch(scene, span, lane, rates, h, touch, moved)
    if scene.resets:
        # A wall has one side: an impact that does not turn the motion back leads nowhere.
        sides = zip(lane.hit, mode, lane.mode, strict=True)
        through = any_of(tuple(hit & (a != b) for hit, a, b in sides))
        num_modes = jnp.where(moved & through, 0, num_modes)
    mode, num_modes = _once(scene, mode, num_modes)
    shares = filippov.weights(mode, rates) if scene.slides else mode
    f = filippov.blend_fields(scene, fields, mode, shares)
    # Where no mode goes on because a field is not finite, that is what is wrong.
    blind = (num_modes == 0) & ~all_finite(*rates)
    f = scene.hold(*(jnp.where(blind, jnp.nan, v) for v in f))
    repels = ~filippov.attracting(mode, rates, span.direction) if scene.slides else false
    g, rate, noise = guards(scene, t, x, f, mode, noise)
    if ahead is not None:
        stays = ~lane.pending
        for s in lane.mode:
            stays = stays & (s != 0)
        f, g, rate = (
            where(stays, known, new)
            for known, new in ((ahead.f, f), (ahead.g, g), (ahead.rate, rate))
        )
    touch = tuple(jnp.where(s == 0, v, w) for s, v, w in zip(mode, noise, touch, strict=True))
    return View(tau, x, f, size, mode, g, rate, noise, touch, num_modes, repels, moved)


def _once(scene: Scene, mode: Blocks, count: Array) -> tuple[Blocks, Array]:
    """A mode and the number of admissible ones, computed once: as one number, where there is one
    surface."""
    number = mode[0] + 4 * count.astype(scene.dtype)
    number, *others = scene.hold(number, *mode[1:])
    count = jnp.floor(0.25 * number + 0.5)
    return (number - 4 * count, *others), count.astype(jnp.int32)


def guards(
    scene: Scene, t: Array, x: Blocks, f: Blocks, mode: Blocks, noise: Blocks
) -> tuple[Blocks, Blocks, Blocks]:
    """The guards of a mode, their rates along its field f, and their noise, given that of H."""
    g, rate = jax.jvp(lambda t, x: filippov.guard(scene, t, x, mode), (t, x), (jnp.ones_like(t), f))
    # The guard of a slide, 1 - w², is of order one.
    slide = _NOISE * epsilon(scene)
    noise = tuple(jnp.where(s == 0, slide, v) for s, v in zip(mode, noise, strict=True))
    return scene.hold(*g), stop_gradient(scene.hold(*rate)), noise


def _switch(
    scene: Scene,
    span: Span,
    lane: Lane,
    rates: list[Blocks],
    h: Blocks,
    touch: Blocks,
    moved: Array,
) -> tuple[Blocks, Array]:
    """The mode after a landing and the number of admissible ones; elsewhere the old mode and 1.

    A slide that has reached the end of its weight leaves to that side. A reset that has `moved` the
    state may have carried it off a surface, or across another one. Everything else is chosen among
    all modes on the surfaces the state is on: those hit, those slid on, and those met or left at
    the same time.
    """
    rates = jax.tree.map(stop_gradient, rates)
    switching = lane.pending & ~lane.graze
    current = filippov.weights(lane.mode, rates) if scene.slides else lane.mode
    leaving = tuple(hit & (s == 0) for hit, s in zip(lane.hit, lane.mode, strict=True))
    sides = tuple(jnp.where(w > 0, jnp.ones_like(w), -jnp.ones_like(w)) for w in current)
    left = tuple(
        jnp.where(go & switching, side, s)
        for go, side, s in zip(leaving, sides, lane.mode, strict=True)
    )
    met = tuple(hit & ~go for hit, go in zip(lane.hit, leaving, strict=True))
    if scene.resets:
        off = tuple(moved & (abs(v) > least) for v, least in zip(h, touch, strict=True))
        left = tuple(
            jnp.where(o & switching, jnp.where(v > 0, jnp.ones_like(v), -jnp.ones_like(v)), s)
            for o, v, s in zip(off, h, left, strict=True)
        )
        met = tuple(hit & ~o for hit, o in zip(met, off, strict=True))
    same = span.same_time(lane.tau)
    on = []
    for j in range(scene.m):
        close = abs(h[j]) < abs(lane.rate[j]) * same
        on.append(met[j] | (left[j] == 0) | ((lane.mode[j] != 0) & close))
    decide = switching & any_of(met)
    chosen, count = filippov.choose(scene.m, rates, left, tuple(on), span.direction)
    return where(decide, chosen, left), jnp.where(decide, count, 1)


def departure(scene: Scene, span: Span, lane: Lane, view: View) -> tuple[Blocks, ...]:
    """Guards, rates, arming and noise at the start of the next step.

    A surface just met counts as left only when its guard has risen above rounding. Until then the
    guard starts at exactly zero, and its rate at zero or above.
    """
    gs, rates, armed, noises = [], [], [], []
    for j in range(scene.m):
        hit = lane.pending & lane.hit[j]
        old_slide = lane.mode[j] == 0
        kept = (hit | ~lane.armed[j]) & ~old_slide
        noise = jnp.maximum(view.noise[j], jnp.where(kept, lane.noise[j], 0.0))
        sliding = view.mode[j] == 0
        away = sliding | (~hit & lane.armed[j]) | (view.g[j] > noise)
        # Leaving a slide, or a touch, is a double root of the guard: its rate is zero, whatever
        # rounding says.
        double = hit & (old_slide | lane.graze)
        rising = span.direction * jnp.maximum(span.direction * view.rate[j], 0.0)
        gs.append(jnp.where(away, jnp.maximum(view.g[j], 0.0), 0.0))
        rates.append(jnp.where(away, view.rate[j], jnp.where(double, 0.0, rising)))
        armed.append(away)
        noises.append(noise)
    return tuple(stop_gradient(g) for g in gs), tuple(rates), tuple(armed), tuple(noises)
