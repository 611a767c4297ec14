"""The switch: what is known at the end of a step, and the mode that goes on after a contact.

A trial step's end enters; a `StepEnd` leaves: the state (reset, and held on the surfaces it slides
on), the mode, its field, the guards and their rates. Only a lane whose last iteration landed on a
contact changes its mode, here, where all fields are taken at the corrected state: taken before the
correction, they left the state right and its derivative wrong in the fourth digit.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts import accumulation, resets
from jaxfil.integrate.contacts.guards import (
    NOISE,
    guards,
    larger,
    stays_on,
    surface_noise,
    unguarded,
)
from jaxfil.integrate.contacts.resets import Impact
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import FreeStep, LoopState, StepEnd
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.surfaces import filippov, unilateral, weights as sliding_weights
from jaxfil.integrate.surfaces.normals import project
from jaxfil.integrate.surfaces.weights import Corners
from jaxfil.integrate.system.components import (
    Components,
    Forcing,
    Normals,
    all_finite,
    any_of,
    axpy,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select

# At a graze a rate is told from zero above this multiple of what is left of the motion's own.
_TANGENT = 64
# Backward in time a motion that has left a slide comes to its end with the errors of both ways:
# this multiple of rounding.
_BACKWARD = 1024.0


def evaluate_step_end(
    problem: Problem,
    state: LoopState,
    length: Length,
    x: Components,
    forcing: Forcing,
    free: FreeStep | None = None,
) -> StepEnd:
    """The state, mode, field, guards and rates at the end of a step; a pending switch is made.

    `forcing` is that of the end: see `ComponentSystem.forcing`. What a `free` step has found is
    taken for a lane that stays on its sides, to the last bit.
    """
    system, tau = problem.system, length.end
    t = problem.grid.t0 + tau
    if system.m == 0:
        return _smooth_end(system, state, tau, x, system.field(t, x, (), forcing=forcing))
    reset = resets.make_reset(system, state, t, x) if system.resets else None
    x = x if reset is None else reset.x
    # Everything from here on is taken after the reset: sides, rates and modes are those of the
    # state that goes on.
    h, h_t, normals = system.gradients(t, x)
    size = larger(state.size, x, None if state.turn is None else state.pending)
    # Two scales: what rounding of this step does to H, and what all rounding since t0 may have
    # done, which is of the largest state so far. The first tells whether a contact is here, the
    # second whether a touch is more than rounding.
    both = zip(*stop_gradient((state.x, x)), strict=True)
    here = tuple(jnp.maximum(abs(a), abs(b)) for a, b in both)
    noise = surface_noise(system, t, here, h_t, normals)
    touch = surface_noise(system, t, size, h_t, normals)
    moved = jnp.zeros((), bool) if reset is None else reset.moved
    if system.slides:
        wider = select(problem.grid.direction < 0, _BACKWARD, 1.0)
        touch = tuple(wider * v for v in touch)
    jumped = _jumped(problem, state, h, touch)
    # Whose H the reset has changed: rounding of one that it has not is no way off its surface.
    each = () if reset is None else zip(reset.h, h, touch, strict=True)
    carried = tuple(moved & (abs(v) > least) & (abs(v - u) > least) for u, v, least in each)
    off = tuple(map(jnp.logical_or, jumped, carried)) if carried else jumped
    if problem.kept is not None:  # a slide that is kept needs not be on its surface
        off = tuple(far | problem.kept.on for far in off)
    x = _held(system, state, x, h, normals, off)
    led = None
    if reset is not None:
        x, led = resets.lead(problem, state, length, reset, t, x, (h_t, normals), h, touch)
    fields, rates = filippov.corners(system, t, x, forcing=forcing)
    mode, num_modes = _switch(problem, state, rates, h, touch, carried, jumped, led)
    shares, determinant = mode, None
    if system.slides:
        shares = sliding_weights.weights(mode, rates)
        known = stop_gradient((mode, rates, shares))
        (determinant,) = system.hold(sliding_weights.determinant(*known))
    f = filippov.blend_fields(system, fields, mode, shares)
    # Where no mode goes on because a field is not finite, that is what is wrong.
    blind = (num_modes == 0) & ~all_finite(tuple(jax.tree.leaves(rates)))
    f = system.hold(*(select(blind, jnp.nan, v) for v in f))
    f = with_reactions(system, t, x, mode, f)
    g, rate, noise = guards(system, t, x, f, mode, noise, forcing)
    if free is not None:
        stays = ~state.pending & ~state.held
        f, g, rate = where(stays, free.f, f), where(stays, free.g, g), where(stays, free.rate, rate)
    on = stays_on(system, mode)
    touch = tuple(select(s, v, w) for s, v, w in zip(on, noise, touch, strict=True))
    at_end = StepEnd(
        tau=tau,
        x=x,
        f=f,
        size=size,
        mode=mode,
        g=g,
        rate=rate,
        noise=noise,
        touch=touch,
        num_modes=num_modes,
        determinant=determinant,
        moved=moved,
        members=state.hit,
        next=(),
        jump=None,
        still=(),
        turn=None,
    )
    end = unguarded(problem.kept, at_end)
    if reset is not None and led is not None:
        end = _led_on(state, end, reset, led)
    return accumulation.follow_turns(problem, state, length, end)


def _led_on(state: LoopState, end: StepEnd, reset: resets.Reset, led: Impact) -> StepEnd:
    """The end of a step with what follows from its reset."""
    # Surfaces that wait for their reset are met by another switch.
    members = tuple(
        select(reset.moved, acted | (hit & ~more), hit)
        for acted, hit, more in zip(reset.acted, state.hit, led.next, strict=True)
    )
    x = axpy(end.x, led.jump, end.f)
    x = tuple(a + b for a, b in zip(x, led.kick, strict=True))
    return dataclasses.replace(
        end,
        x=where(led.jump > 0, x, end.x),
        members=members,
        next=led.next,
        jump=led.jump,
        still=led.still,
    )


def with_reactions(
    system: ComponentSystem, t: Array, x: Components, mode: Components, f: Components
) -> Components:
    """The field of a mode, with the reactions of the surfaces that it rests on."""
    if not system.resets:
        return f
    resting = any_of(unilateral.rests_of(mode))

    def reacted(t: Array, x: Components, mode: Components, f: Components) -> Components:
        return unilateral.held_field(system, t, x, mode, f)[0]

    return system.where_any(resting, reacted, lambda t, x, mode, f: f, t, x, mode, f)


def _smooth_end(
    system: ComponentSystem, state: LoopState, tau: Array, x: Components, f: Components
) -> StepEnd:
    """The end of a step where there are no surfaces."""
    one, false = jnp.ones((), jnp.int32), jnp.zeros((), bool)
    size = larger(state.size, x)
    return StepEnd(tau, x, f, size, (), (), (), (), (), one, None, false, (), (), None, (), None)


def _held(
    system: ComponentSystem,
    state: LoopState,
    x: Components,
    h: Components,
    normals: Normals,
    off: Components,
) -> Components:
    """The state on the surfaces that it slides or rests on or has just met: a slide is exact in its
    surface, however long it lasts. Surfaces that are `off` have jumped, or were left by a reset."""
    if not system.slides and not system.resets:
        return x
    landed = state.pending & ~state.graze
    each = zip(stays_on(system, state.mode), state.hit, off, strict=True)
    on = tuple((stays | (landed & hit)) & ~far for stays, hit, far in each)
    return system.hold(*project(system, x, h, normals, on))


def _switch(
    problem: Problem,
    state: LoopState,
    rates: Corners,
    h: Components,
    touch: Components,
    carried: Components,
    jumped: Components,
    led: Impact | None,
) -> tuple[Components, Array]:
    """`_chosen`, computed once."""
    system = problem.system
    mode, count = _chosen(problem, state, rates, h, touch, carried, jumped, led)
    if system.packed:
        (sides, number) = system.hold(*mode, count.astype(system.dtype))
        return (sides,), number.astype(jnp.int32)
    # Where there is one surface, both are one number: mode + 8 count, and the mode is at most 2.
    number = mode[0] + 8 * count.astype(system.dtype)
    number, *others = system.hold(number, *mode[1:])
    count = jnp.floor(0.125 * number + 0.5)
    return (number - 8 * count, *others), count.astype(jnp.int32)


def _chosen(
    problem: Problem,
    state: LoopState,
    rates: Corners,
    h: Components,
    touch: Components,
    carried: Components,
    jumped: Components,
    led: Impact | None,
) -> tuple[Components, Array]:
    """The mode after a landing and the number of admissible ones; elsewhere the old mode, and of a
    slide the number of modes on its surfaces, at least 1.

    A slide that has reached the end of its weight leaves to that side. A reset may have
    `carried` the state off a surface, or across another one; what it has `led` to on others
    is known. Everything else is chosen among all modes on the surfaces the state is on: those hit,
    those slid on, and those met or left at the same time.
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
    current = sliding_weights.weights(state.mode, rates) if system.slides else state.mode
    # A slide ends at w = ±1: it leaves to the side whose field has become the blend. A limit of
    # turns is on their surfaces, and ends nothing.
    limit = jnp.zeros((), bool) if state.turn is None else state.turn.completed
    leaving = tuple(hit & (s == 0) & ~limit for hit, s in zip(state.hit, state.mode, strict=True))
    sides = tuple(select(w > 0, jnp.ones_like(w), -jnp.ones_like(w)) for w in current)
    if state.ticks is not None:  # a surface that has jumped away from a slide leaves it on its side
        sides = tuple(
            select(far, jnp.sign(v), s) for far, v, s in zip(jumped, h, sides, strict=True)
        )
    left = tuple(
        select(go & switching, side, s)
        for go, side, s in zip(leaving, sides, state.mode, strict=True)
    )
    met = tuple(hit & ~go for hit, go in zip(state.hit, leaving, strict=True))
    # A surface that has jumped across the state is left behind.
    across = tuple(
        far & on & (s * v < 0) for far, on, s, v in zip(jumped, met, left, h, strict=True)
    )
    left = tuple(select(over, -s, s) for over, s in zip(across, left, strict=True))
    met = tuple(on & ~over for on, over in zip(met, across, strict=True))
    if led is not None:
        left, met = _left_by_reset(state, left, met, h, carried, led)
    # A surface that will be met within the rounding of times is met now: its contact could not be
    # told from this one, and would follow it at once.
    same = grid.same_time(state.tau)
    decide = switching & any_of(met)
    on = []
    for j in system.surfaces:
        close = (state.mode[j] != 0) & (abs(h[j]) < abs(state.rate[j]) * same)
        if led is not None:
            close = close & ~led.next[j] & ~led.still[j] & (abs(left[j]) != 2)
        slid = (left[j] == 0) if system.slides else jnp.zeros_like(met[j])
        on.append(slid | (decide & (met[j] | close)) | (grazes & met[j]))
    # Where a slide on an intersection ends, another mode begins: rounding must not show both.
    least = select(state.pending, 0.0, NOISE * system.eps)
    beside = unilateral.beside(left) if system.resets else left
    chosen, count = _chosen_on(system, rates, beside, tuple(on), grid.direction, least)
    count = select(decide, count, jnp.maximum(count, 1))
    if led is None:
        return where(decide, chosen, left), count
    rests = unilateral.rests_of(left)
    mode = tuple(
        select(decide & ~rest, new, old) for rest, new, old in zip(rests, chosen, left, strict=True)
    )
    return mode, select(led.consistent, count, 0)


def _jumped(problem: Problem, state: LoopState, h: Components, touch: Components) -> Components:
    """The surfaces whose H has jumped away from zero, by more than rounding of times explains."""
    same = problem.grid.same_time(state.tau)
    return tuple(
        state.pending & state.jumped & (abs(v) > least + 2 * same * abs(stop_gradient(rate)))
        for v, least, rate in zip(h, touch, state.rate, strict=True)
    )


def _left_by_reset(
    state: LoopState,
    left: Components,
    met: Components,
    h: Components,
    carried: Components,
    led: Impact,
) -> tuple[Components, Components]:
    """The mode on surfaces that a reset has carried the state off, that it rests on and that wait
    for another switch, and the surfaces met on which a mode is still to be chosen."""
    switching = state.pending & ~state.graze
    modes, open_ = [], []
    each = zip(left, unilateral.sides_of(left), h, carried, resets.at_limit(state), strict=True)
    for j, (s, beside, v, off, limit) in enumerate(each):
        one = jnp.ones_like(s)
        rested = select(led.rests[j], 2 * beside, beside)
        # What ends a rest, and what asks for a reset, leaves to its side.
        ends = (state.hit[j] & (abs(s) == 2) & ~limit) | led.next[j]
        mode = select(off & switching, select(v > 0, one, -one), s)
        mode = select((ends | led.pushed[j]) & switching, beside, mode)
        modes.append(select(led.still[j], rested, mode))
        open_.append(met[j] & ~off & ~ends & ~led.still[j])
    return tuple(modes), tuple(open_)


def _chosen_on(
    system: ComponentSystem,
    rates: Corners,
    mode: Components,
    on: Components,
    direction: Array,
    least: Array,
) -> tuple[Components, Array]:
    """`filippov.choose`, whose many candidates are tried only where the state is on a surface."""

    def choose(rates: Corners, mode: Components, on: Components, *rest: Array) -> tuple:
        return filippov.choose(system.m, rates, mode, on, *rest)

    def same(rates: Corners, mode: Components, on: Components, *rest: Array) -> tuple:
        return mode, jnp.ones((), jnp.int32)

    if system.structure.separate:
        return choose(rates, mode, on, direction, least)
    return system.where_any(any_of(on), choose, same, rates, mode, on, direction, least)


def _rates_at_graze(
    problem: Problem, state: LoopState, rates: Corners, touch: Components, grazes: Array
) -> Corners:
    """dH/dt along the fields of all sides, those of a surface that is grazed told from rounding.

    They vanish on the side of the motion, which stays there: what is no larger than that leads to
    this side too.
    """
    direction, dt = problem.grid.direction, abs(problem.grid.dt)
    noise = [_TANGENT * abs(r) + v / dt for r, v in zip(state.rate, touch, strict=True)]

    def told(j: int, r: Array) -> Array:
        small = grazes & state.hit[j] & (abs(r) <= noise[j])
        return select(small, state.mode[j] * direction * noise[j], r)

    return sliding_weights.map_components(told, rates)
