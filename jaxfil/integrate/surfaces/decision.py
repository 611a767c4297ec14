"""The decision: in which mode a motion goes on from a point on several surfaces.

The fields on all sides enter, with the surfaces that the state is on; a mode leaves, and in how
many modes the motion could go on. On each surface the unknown is a weight w in [−1, 1] where it can
be slid on, a reaction λ ≥ 0 where it can be rested on. With the rates ψ = dH/dt along the field of
all weights and reactions, and the accelerations a = dψ/dt,

    ψ_i = 0 inside of −1 < w_i < 1,    ψ_i ≥ 0 at w_i = 1,    ψ_i ≤ 0 at w_i = −1,
    a_j = 0 where λ_j > 0,             a_j ≥ 0 at λ_j = 0.

That is one variational inequality on a box. Where few surfaces are active each combination is
tried: (w = 1, w = −1, slide) or (off, rest). Where many are, and the field is affine in its sides,
pivoting solves it (`xla.complementarity`). Several solutions that are one motion, as of blocks that
rub on the ground and on each other, count as one. Where rounding leaves none, the mass at the very
limit of its friction, one that holds to within rounding is taken: the motions agree to that order.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.surfaces.unilateral import Forces, rests_of
from jaxfil.integrate.surfaces.weights import held_together, weights
from jaxfil.integrate.system.components import (
    Components,
    any_of,
    maximum,
    minimum,
    on_each,
    pack,
    total,
    where,
)
from jaxfil.xla.complementarity import is_monotone, solve_on_box
from jaxfil.xla.select import select

# Active surfaces whose combinations are tried, at most, where pivoting can do it instead.
_FEW = 3
# Rounding of rates, accelerations and fields, in eps of the sizes of all that they are made of.
_NOISE = 64
# Times over which velocities are one, in rounding: weights of coupled surfaces magnify it.
_ONE_MOTION = 1024


class Question(eqx.Module):
    """What is to be decided. Components are m."""

    rates: Corners
    """ψ, on each combination of sides."""
    fields: Corners | None
    """The fields of these, n components; None: all modes are taken for different motions."""
    mode: Components
    """The mode where nothing is to be decided, rests included; of a surface that is, its side."""
    on: Components
    """Surfaces to be decided."""
    walls: Components | None
    """Those of them that can be rested on and not slid on; None where none can."""
    kept: Components | None
    """Those of them on which the motion goes on as it was if it can, within rounding; None where
    there are none."""
    now: Components | None
    """The mode of these."""
    forces: Forces | None
    """Reactions; None without walls."""
    direction: Array
    """+1 forward in time, −1 backward."""
    threshold: Array | float
    """A surface is left at a rate of more than this, relative to all rates there."""


def question_of(
    rates: Corners,
    fields: Corners | None,
    mode: Components,
    on: Components,
    direction: Array,
    threshold: Array | float = 0.0,
) -> Question:
    """That of surfaces without resets, of which all is open."""
    return Question(rates, fields, mode, on, None, None, None, None, direction, threshold)


class _Found(eqx.Module):
    """What has been found when so many combinations have been tried."""

    mode: Components
    count: Array
    velocity: Components | None
    number: Array


class _Velocity(eqx.Module):
    """A velocity, n components, and the size of what it is made of."""

    f: Components
    size: Components


def decide(question: Question) -> tuple[Components, Array]:
    """The mode that goes on, and how many could: one where the motion is unique."""
    of_sides = question.forces is not None and question.forces.of_corners is not None
    if question.rates.flipped is None or question.mode.size <= _FEW or of_sides:
        return _by_trial(question)
    active = total(question.on.astype(jnp.int32))
    few = active <= _FEW

    def tried(question: Question) -> tuple[Components, Array]:
        return _by_trial(question, few)

    # Both are programs of a size that does not grow; in a batch both run.
    return jax.lax.cond(few, tried, _by_pivoting, question)


def _by_trial(question: Question, wanted: Array | bool = True) -> tuple[Components, Array]:
    """The first combination in which the motion can go on, and how many there are. In a first round
    surfaces that nothing has happened to go on as they were; a second one asks all of them, and a
    third one what holds to within rounding."""
    on, mode = question.on, question.mode
    dtype = question.direction.dtype
    place, powers = _powers(on, dtype)
    size = place.astype(jnp.int32)

    def goes_on(found: _Found) -> Array:
        rounds = found.number // size
        inside = found.number % size != 0
        return wanted & (rounds < 3) & (inside | (found.count == 0))

    def next_one(found: _Found) -> _Found:
        number, rounds = (found.number % size).astype(dtype), found.number // size
        digit = on_each(lambda power: jnp.floor(number / power + 1e-3) % 3, powers)
        side = where(digit == 0, 1.0, where(digit == 1, -1.0, 0.0)).astype(dtype)
        # Of what holds to within rounding a slide is tried first.
        slide = rounds == 2 if question.walls is None else ~question.walls & (rounds == 2)
        last = where(digit == 0, 0.0, where(digit == 1, 1.0, -1.0)).astype(dtype)
        side = where(slide, last, side)
        return _try(question, found, where(on, side, mode), rounds)

    zero = jnp.zeros((), jnp.int32)
    still = None if question.fields is None else question.fields[0] * 0.0
    found = jax.lax.while_loop(goes_on, next_one, _Found(mode, zero, still, zero))
    return found.mode, found.count


def _powers(on: Components, dtype: Any) -> tuple[Array, Components]:
    """3 to the number of flags that are set, and to the number of those before each."""
    if on.is_array:
        flags = on.parts[0].astype(dtype)
        before = jnp.cumsum(flags) - flags
        # Beyond what is tried, the number is of no account.
        powers = jnp.minimum(3.0 ** jnp.minimum(before, 18.0), 3.0**18)
        return jnp.minimum(3.0 ** jnp.sum(flags), 3.0**18), Components([powers])
    power, powers = jnp.ones((), dtype), []
    for flag in on.parts:
        powers.append(power)
        power = select(flag, 3 * power, power)
    return power, Components(powers)


def _try(question: Question, found: _Found, candidate: Components, rounds: Array) -> _Found:
    """What has been found with one more combination tried."""
    ok, mode, made = _continues(question, candidate, rounds)
    first, new, velocity = ok & (found.count == 0), ok, None
    if made is not None and found.velocity is not None:
        eps = jnp.finfo(question.direction.dtype).eps
        size = made.size + abs(made.f) + abs(found.velocity)
        apart = any_of(abs(made.f - found.velocity) > _ONE_MOTION * eps * size)
        new = ok & ((found.count == 0) | apart)
        velocity = where(first, made.f, found.velocity)
    # What holds to within rounding only is the same motion to that order.
    new = new & ((rounds < 2) | first)
    return _Found(
        where(first, mode, found.mode),
        found.count + new.astype(jnp.int32),
        velocity,
        found.number + 1,
    )


def _continues(
    question: Question, candidate: Components, rounds: Array
) -> tuple[Array, Components, _Velocity | None]:
    """Whether the motion can go on in a combination, the mode that it is, and its velocity."""
    on, walls, forces = question.on, question.walls, question.forces
    rates, ok = question.rates, jnp.ones((), bool)
    direction, eps = question.direction, jnp.finfo(question.direction.dtype).eps
    lenient: Any = rounds == 2
    if question.kept is not None:
        lenient = lenient | ((rounds == 0) & question.kept)
    if walls is None or forces is None:
        sides, rests, accelerations, force = candidate, None, None, None
    else:
        # A wall has two ways: −1 is none of them.
        ok = ok & ~any_of(on & walls & (candidate == -1))
        rests = where(on, walls & (candidate == 0), rests_of(candidate))
        sides = where(walls & on, question.mode, candidate)
        sides = where(rests_of(sides), 0.5 * sides, sides)
        held = held_together(forces, rates, where(ok, sides, 1.0), rests)
        rates, accelerations, force = held
    slid = on if walls is None else on & ~walls
    w = weights(where(ok, sides, 1.0), rates)
    # Rounding may take it out of bounds.
    w = where(slid & (sides == 0), minimum(maximum(w, -1.0), 1.0), w)
    # Also where a reaction holds what a friction would hold: its rate is then nothing but rounding.
    rate, scale = rates.blend(sides, w), question.rates.sizes() + rates.sizes()
    # Where no side moves the state off a surface, nothing but a slide on all of them stays there.
    stays = ~any_of(slid & (sides != 0))
    solved = (abs(rate) <= _NOISE * eps * scale) & ((scale > 0) | stays)
    outward = sides * direction * rate
    rounded = (abs(rate) <= _NOISE * eps * scale) & (scale > 0)
    leaves = (outward > question.threshold * scale) | (rounded & lenient)
    # At the end of a weight both a slide and its side hold, and the next derivative decides: a
    # slide ends at once if that takes its weight out of bounds, a side would be found out late.
    # Where a reaction holds the state no side moves it.
    edge = rounded if rests is None else rounded & ~any_of(rests)
    leaves = where(edge, rounds == 2, leaves)
    ok = ok & ~any_of(slid & ~where(sides == 0, solved, leaves))
    mode = sides
    if rests is not None and accelerations is not None and force is not None and forces is not None:
        fine, pushes = _rests(question, rests, accelerations.blend(sides, w), force.blend(sides, w))
        mode = where(rests, 2 * sides, sides)
        if question.kept is not None and question.now is not None:
            lenient = lenient | (question.kept & (mode == question.now))
        fine = fine | (pushes & lenient)
        asked = on & walls
        if forces is not None and forces.of_corners is not None:
            # A friction on its other side may ask a reaction to pull.
            asked = asked | rests
        ok = ok & ~any_of(asked & ~fine)
    if question.kept is not None and question.now is not None:
        # Beside a slide that goes on another motion may begin.
        stays_so = question.kept & (question.now != 0)
        ok = ok & ((rounds > 0) | ~any_of(stays_so & (mode != question.now)))
    if question.fields is None:
        return ok, mode, None
    return ok, mode, _velocity(question.fields, forces, force, sides, w)


def _velocity(
    fields: Corners, forces: Forces | None, force: Corners | None, sides: Components, w: Components
) -> _Velocity:
    """The velocity of a combination with these weights and reactions."""
    if forces is None or force is None:
        return _Velocity(fields.blend(sides, w), fields.sizes())
    if forces.of_corners is not None:
        f = forces.pushed(fields, force).blend(sides, w)
        return _Velocity(f, forces.sizes_of_fields(fields, force))
    pushes, directions = force.blend(sides, w), forces.response.directions
    f = directions.added(fields.blend(sides, w), pushes)
    return _Velocity(f, abs(directions).added(fields.sizes(), abs(pushes)))


def _rests(
    question: Question, rests: Components, a: Components, force: Components
) -> tuple[Components, Components]:
    """Whether reactions push away from the surfaces rested on, and accelerations lead away from
    others; and the same to within rounding."""
    assert question.forces is not None
    sides, eps = question.mode, jnp.finfo(question.direction.dtype).eps
    known = question.forces.accelerations
    noise = _NOISE * eps * (known.sizes() + question.forces.sizes(force))
    fine = where(rests, sides * force > 0, sides * a >= 0)
    own = question.forces.response.gains.diagonal()
    small = where(rests, abs(force * own) <= noise, abs(a) <= noise)
    return fine, fine | small


def _by_pivoting(question: Question) -> tuple[Components, Array]:
    """The same for many surfaces, with a field that is affine in its sides. Unique where the
    symmetric part of the matrix is positive definite; where it is not, one solution is all that is
    known."""
    q, matrix, low, high = _inequality(question)
    z, found = solve_on_box(q, matrix, low, high)
    on, mode = pack(question.on, bool), pack(question.mode, q.dtype)
    walls = jnp.zeros_like(on) if question.walls is None else pack(question.walls, bool) & on
    weight = select(z >= 1, 1.0, select(z <= -1, -1.0, 0.0))
    chosen = select(on, select(walls, select(z > 0, 2 * mode, mode), weight), mode)
    # Backward in time a slide may have begun at any time before.
    slides = (question.direction < 0) & jnp.any(on & (chosen == 0))
    repels = jax.lax.cond(slides, lambda: ~is_monotone(matrix, on), lambda: jnp.zeros((), bool))
    count = select(found, select(repels, 2, 1), 0).astype(jnp.int32)
    if question.mode.is_array:
        return Components([chosen]), count
    return Components(chosen[j] for j in range(len(mode))), count


def _inequality(question: Question) -> tuple[Array, Array, Array, Array]:
    """q, M and the bounds: with z the weights, and the sizes of reactions, F = −ψ where z is a
    weight and a where it is a reaction. What is not decided has equal bounds."""
    known, direction = question.forces, question.direction
    active, mode = pack(question.on, bool), pack(question.mode, direction.dtype)
    side, resting = jnp.sign(mode), ~active & (abs(mode) == 2)
    base, slopes = -direction * pack(question.rates[0], mode.dtype), question.rates.slopes()
    matrix, wall = -direction * slopes, jnp.zeros_like(active)
    by_weight = matrix
    if known is not None and question.walls is not None:
        wall = (pack(question.walls, bool) & active) | resting
        of_wall = side[:, None]
        a = pack(known.accelerations[0], mode.dtype)
        base = select(wall, side * a, base)
        by_weight = select(wall[:, None], of_wall * known.accelerations.slopes(), matrix)
        forces = [jnp.asarray(v.entries()) for v in (known.response.gains, known.pushes)]
        by_force = select(wall[:, None], of_wall * forces[0], -direction * forces[1])
        matrix = select(wall[None, :], by_force * side[None, :], by_weight)
    # All sides + are w = 1; the side of a wall does not change.
    q = base + by_weight @ (select(wall, side, 0.0) - 1.0)
    low = select(wall, 0.0, select(active, -1.0, side))
    high = select(wall, jnp.inf, select(active, 1.0, side))
    return q, matrix, low, high
