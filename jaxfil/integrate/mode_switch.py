"""The switch: what is known at the end of a step, and the mode that goes on after a contact.

A trial step's end enters; a `StepEnd` leaves: the state (reset, and held on the surfaces it slides
on), the mode, its field, the guards and their rates. Only a lane whose last iteration landed on a
contact changes its mode, here, where all fields are taken at the corrected state: taken before the
correction, they left the state right and its derivative wrong in the fourth digit.
"""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate import filippov
from jaxfil.integrate.components import (
    Components,
    ComponentSystem,
    Forcing,
    all_finite,
    any_of,
    axpy,
    where,
)
from jaxfil.integrate.problem import Problem
from jaxfil.integrate.state import FreeStep, LoopState, StepEnd

# A guard is zero to rounding below this many eps times the size of its terms.
_NOISE = 32
# At a graze a rate is told from zero above this multiple of what is left of the motion's own.
_TANGENT = 64
# Backward in time a motion that has left a slide comes to its end with the errors of both ways:
# this multiple of rounding.
_BACKWARD = 1024.0


def surface_noise(
    system: ComponentSystem, t: Array, size: Components, h_t: Components, normals: tuple
) -> Components:
    """What rounding of t and x does to H: a multiple of eps and of the size of its terms, given the
    size of x."""
    out = []
    for j in range(system.m):
        terms = sum(abs(v) * s for v, s in zip(normals[j], size, strict=True))
        out.append(stop_gradient(_NOISE * system.eps * (terms + abs(h_t[j] * t))))
    return tuple(out)


def _project(x: Components, h: Components, normals: tuple, on: Components) -> Components:
    """x moved along the normals onto the surfaces marked `on`, one after the other."""
    for h_j, normal, on_j in zip(h, normals, on, strict=True):
        size = sum(v * v for v in normal)
        push = jnp.where(on_j, h_j / jnp.where(size == 0, 1, size), 0.0)
        x = axpy(x, -push, normal)
    return x


def larger(size: Components, x: Components) -> Components:
    """The largest |x| so far."""
    return tuple(jnp.maximum(s, stop_gradient(abs(v))) for s, v in zip(size, x, strict=True))


def evaluate_step_end(
    problem: Problem,
    state: LoopState,
    tau: Array,
    x: Components,
    forcing: Forcing,
    free: FreeStep | None = None,
) -> StepEnd:
    """The state, mode, field, guards and rates at the end of a step; a pending switch is made.

    `forcing` is that of the end: see `ComponentSystem.forcing`. What a `free` step has found is
    taken for a lane that stays on its sides, to the last bit.
    """
    system, t = problem.system, problem.grid.t0 + tau
    if system.m == 0:
        return _smooth_end(system, state, tau, x, system.field(t, x, (), forcing=forcing))
    x, moved = _reset(system, state, t, x)
    # Everything from here on is taken after the reset: sides, rates and modes are those of the
    # state that goes on.
    h, h_t, normals = system.gradients(t, x)
    size = larger(state.size, x)
    # Two scales: what rounding of this step does to H, and what all rounding since t0 may have
    # done, which is of the largest state so far. The first tells whether a contact is here, the
    # second whether a touch is more than rounding.
    here = tuple(jnp.maximum(abs(a), abs(b)) for a, b in zip(state.x, x, strict=True))
    noise = surface_noise(system, t, here, h_t, normals)
    touch = surface_noise(system, t, size, h_t, normals)
    if system.slides:
        wider = jnp.where(problem.grid.direction < 0, _BACKWARD, 1.0)
        touch = tuple(wider * v for v in touch)
    x = _held(system, state, x, h, normals, moved)
    fields, rates = filippov.corners(system, t, x, forcing=forcing)
    mode, num_modes = _switch(problem, state, rates, h, touch, moved)
    shares, determinant = mode, None
    if system.slides:
        shares, determinant = filippov.weights_and_determinant(mode, rates)
        (determinant,) = system.hold(stop_gradient(determinant))
    f = filippov.blend_fields(system, fields, mode, shares)
    # Where no mode goes on because a field is not finite, that is what is wrong.
    blind = (num_modes == 0) & ~all_finite(*rates)
    f = system.hold(*(jnp.where(blind, jnp.nan, v) for v in f))
    # Of a switch the modes are counted, and of a slide between its contacts.
    repels = (num_modes > 1) & ~state.pending
    g, rate, noise = guards(system, t, x, f, mode, noise)
    if free is not None:
        stays = ~state.pending & ~state.sliding
        f, g, rate = where(stays, free.f, f), where(stays, free.g, g), where(stays, free.rate, rate)
    touch = tuple(jnp.where(s == 0, v, w) for s, v, w in zip(mode, noise, touch, strict=True))
    modes = num_modes, repels, determinant
    return StepEnd(tau, x, f, size, mode, g, rate, noise, touch, *modes, moved)


def _smooth_end(
    system: ComponentSystem, state: LoopState, tau: Array, x: Components, f: Components
) -> StepEnd:
    """The end of a step where there are no surfaces."""
    one, false = jnp.ones((), jnp.int32), jnp.zeros((), bool)
    size = larger(state.size, x)
    return StepEnd(tau, x, f, size, (), (), (), (), (), one, false, None, false)


def _reset(
    system: ComponentSystem, state: LoopState, t: Array, x: Components
) -> tuple[Components, Array]:
    """The state after the reset of a pending switch, and whether that has moved it."""
    if not system.resets:
        return x, jnp.zeros((), bool)
    # Of surfaces hit together the reset hears of the first: its signature takes one.
    surface = jnp.argmax(jnp.stack(state.hit))
    after = where(state.pending & ~state.graze, system.reset(t, x, surface), x)
    return after, any_of(tuple(a != b for a, b in zip(after, x, strict=True)))


def _held(
    system: ComponentSystem,
    state: LoopState,
    x: Components,
    h: Components,
    normals: tuple,
    moved: Array,
) -> Components:
    """The state on the surfaces that it slides on or has just met: a slide is exact in its surface,
    however long it lasts."""
    if not system.slides:
        return x
    landed = state.pending & ~state.graze & ~moved
    each = zip(state.mode, state.hit, strict=True)
    on = tuple(((s == 0) & ~moved) | (landed & hit) for s, hit in each)
    return system.hold(*_project(x, h, normals, on))


def guards(
    system: ComponentSystem,
    t: Array,
    x: Components,
    f: Components,
    mode: Components,
    noise: Components,
) -> tuple[Components, Components, Components]:
    """The guards of a mode, their rates along its field f, and their noise, given that of H."""
    g, rate = jax.jvp(
        lambda t, x: filippov.guard(system, t, x, mode), (t, x), (jnp.ones_like(t), f)
    )
    # The guard of a slide, 1 - w², is of order one.
    slide = _NOISE * system.eps
    noise = tuple(jnp.where(s == 0, slide, v) for s, v in zip(mode, noise, strict=True))
    return system.hold(*g), stop_gradient(system.hold(*rate)), noise


def _switch(
    problem: Problem,
    state: LoopState,
    rates: list[Components],
    h: Components,
    touch: Components,
    moved: Array,
) -> tuple[Components, Array]:
    """`_chosen`, computed once."""
    system = problem.system
    mode, count = _chosen(problem, state, rates, h, touch, moved)
    if system.resets:
        # A wall has one side: an impact that does not turn the motion back leads nowhere.
        sides = zip(state.hit, mode, state.mode, strict=True)
        through = any_of(tuple(hit & (a != b) for hit, a, b in sides))
        count = jnp.where(moved & through, 0, count)
    # Where there is one surface, both are one number: mode + 4 count, and the mode is at most 1.
    number = mode[0] + 4 * count.astype(system.dtype)
    number, *others = system.hold(number, *mode[1:])
    count = jnp.floor(0.25 * number + 0.5)
    return (number - 4 * count, *others), count.astype(jnp.int32)


def _chosen(
    problem: Problem,
    state: LoopState,
    rates: list[Components],
    h: Components,
    touch: Components,
    moved: Array,
) -> tuple[Components, Array]:
    """The mode after a landing and the number of admissible ones; elsewhere the old mode, and of a
    slide the number of modes on its surfaces, at least 1.

    A slide that has reached the end of its weight leaves to that side. A reset that has `moved` the
    state may have carried it off a surface, or across another one. Everything else is chosen among
    all modes on the surfaces the state is on: those hit, those slid on, and those met or left at
    the same time.
    """
    system, grid = problem.system, problem.grid
    # Which mode goes on is no number that could have a derivative; its field has.
    rates = jax.tree.map(stop_gradient, rates)
    # A graze only touches: it switches nothing, even where two modes could go on. Backward in time
    # it may be the end of a slide, to which all motions come that have left the slide there.
    switching, grazes = state.pending & ~state.graze, jnp.zeros((), bool)
    if system.slides and not system.resets:
        grazes = state.pending & state.graze & (grid.direction < 0)
        rates = _rates_at_graze(problem, state, rates, touch, grazes)
    current = filippov.weights(state.mode, rates) if system.slides else state.mode
    # A slide ends at w = ±1: it leaves to the side whose field has become the blend.
    leaving = tuple(hit & (s == 0) for hit, s in zip(state.hit, state.mode, strict=True))
    sides = tuple(jnp.where(w > 0, jnp.ones_like(w), -jnp.ones_like(w)) for w in current)
    left = tuple(
        jnp.where(go & switching, side, s)
        for go, side, s in zip(leaving, sides, state.mode, strict=True)
    )
    met = tuple(hit & ~go for hit, go in zip(state.hit, leaving, strict=True))
    if system.resets:
        off = tuple(moved & (abs(v) > least) for v, least in zip(h, touch, strict=True))
        left = tuple(
            jnp.where(o & switching, jnp.where(v > 0, jnp.ones_like(v), -jnp.ones_like(v)), s)
            for o, v, s in zip(off, h, left, strict=True)
        )
        met = tuple(hit & ~o for hit, o in zip(met, off, strict=True))
    # A surface that will be met within the rounding of times is met now: its contact could not be
    # told from this one, and would follow it at once.
    same = grid.same_time(state.tau)
    decide = switching & any_of(met)
    on = []
    for j in range(system.m):
        close = (state.mode[j] != 0) & (abs(h[j]) < abs(state.rate[j]) * same)
        slid = (left[j] == 0) if system.slides else jnp.zeros((), bool)
        on.append(slid | (decide & (met[j] | close)) | (grazes & met[j]))
    # Where a slide on an intersection ends, another mode begins: rounding must not show both.
    least = jnp.where(state.pending, 0.0, _NOISE * system.eps)
    chosen, count = filippov.choose(system.m, rates, left, tuple(on), grid.direction, least)
    return where(decide, chosen, left), jnp.where(decide, count, jnp.maximum(count, 1))


def _rates_at_graze(
    problem: Problem, state: LoopState, rates: list[Components], touch: Components, grazes: Array
) -> list[Components]:
    """dH/dt along the fields of all sides, those of a surface that is grazed told from rounding.

    They vanish on the side of the motion, which stays there: what is no larger than that leads to
    this side too.
    """
    direction, dt = problem.grid.direction, abs(problem.grid.dt)
    noise = [_TANGENT * abs(r) + v / dt for r, v in zip(state.rate, touch, strict=True)]
    return [
        tuple(
            jnp.where(grazes & hit & (abs(r) <= least), s * direction * least, r)
            for r, s, hit, least in zip(row, state.mode, state.hit, noise, strict=True)
        )
        for row in rates
    ]


def rearm_guards(problem: Problem, state: LoopState, end: StepEnd) -> tuple[Components, ...]:
    """Guards, rates, arming and noise at the start of the next step.

    A surface just met counts as left only when its guard has risen above rounding. Until then the
    guard starts at exactly zero, and its rate at zero or above.
    """
    direction = problem.grid.direction
    gs, rates, armed, noises = [], [], [], []
    for j in range(problem.system.m):
        hit = state.pending & state.hit[j]
        old_slide = state.mode[j] == 0
        # The rounding of the landing counts until the surface is left, also where the state has
        # become smaller since.
        kept = (hit | ~state.armed[j]) & ~old_slide
        noise = jnp.maximum(end.noise[j], jnp.where(kept, state.noise[j], 0.0))
        sliding = end.mode[j] == 0
        away = sliding | (~hit & state.armed[j]) | (end.g[j] > noise)
        # Leaving a slide, or a touch, is a double root of the guard: its rate is zero, whatever
        # rounding says. Taken as computed, 3e-15 of it held one lane on its stick for ever.
        double = hit & (old_slide | state.graze)
        rising = direction * jnp.maximum(direction * end.rate[j], 0.0)
        gs.append(jnp.where(away, jnp.maximum(end.g[j], 0.0), 0.0))
        rates.append(jnp.where(away, end.rate[j], jnp.where(double, 0.0, rising)))
        armed.append(away)
        noises.append(noise)
    return tuple(stop_gradient(g) for g in gs), tuple(rates), tuple(armed), tuple(noises)
