"""The decision: the mode in which a motion continues from a point on several surfaces.

Given the fields on all sides and the surfaces that the state is on, it is the mode, and the number
of modes in which the motion could continue. The unknown of a surface is a weight w in [−1, 1] if
the motion can slide on it, and a reaction λ ≥ 0 if it can rest on it. With the rates ψ = dH/dt
along the field of all weights and reactions, and the accelerations a = dψ/dt,

    ψ_i = 0 inside of −1 < w_i < 1,    ψ_i ≥ 0 at w_i = 1,    ψ_i ≤ 0 at w_i = −1,
    a_j = 0 where λ_j > 0,             a_j ≥ 0 at λ_j = 0.

This is one variational inequality on a box. For a few active surfaces each combination of (w = 1,
w = −1, slide) or (off, rest) is tried. For many, with a field that is affine in its sides, it is
solved by pivoting (`xla.complementarity`). Several solutions with one velocity, as for blocks that
rub on the ground and on each other, count as one motion. If rounding excludes every solution, as
for a mass at the limit of its friction, a solution to within rounding is taken; the motions agree
to that order.

Where ψ_j vanishes and no weight can change it, the next derivative of H_j decides, a_j = dψ_j/dt.
An example is x″ = f − g sgn x − h sgn x′ with H = (x, x′), at rest, where ψ of x is x′. The motion
slides on x only together with x′, which the weight of x holds at zero, and leaves towards a_j. A
brake whose force grows from zero is another one. There ψ_j vanishes on every side, and a_j is in
its place throughout (`in_place`).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.surfaces.pivoting import by_pivoting
from jaxfil.integrate.surfaces.question import (
    NOISE,
    Question,
    Velocity,
    are_apart,
    in_place,
    pushed_by_none,
)
from jaxfil.integrate.surfaces.reactions import Forces
from jaxfil.integrate.surfaces.unilateral import rests_of
from jaxfil.integrate.surfaces.weights import (
    governs,
    held_together,
    is_governed,
    response,
    weights,
)
from jaxfil.integrate.system.components import (
    Components,
    any_of,
    maximum,
    minimum,
    on_each,
    total,
    where,
)
from jaxfil.xla.select import select

# The largest number of active surfaces whose combinations are tried if pivoting is possible too.
_FEW = 3


class _Found(eqx.Module):
    """The result after a number of combinations have been tried."""

    mode: Components
    count: Array
    velocity: Components | None
    number: Array


def decide(question: Question) -> tuple[Components, Array]:
    """The mode that continues the motion, and the number of modes that could; 1 means unique."""
    of_sides = question.forces is not None and question.forces.of_corners is not None
    if question.rates.flipped is None or question.mode.size <= _FEW or of_sides:
        return _by_trial(question)
    active = total(question.on.astype(jnp.int32))
    few = active <= _FEW

    def tried(question: Question) -> tuple[Components, Array]:
        return _by_trial(question, few)

    # The sizes of both programs are bounded; in a batch both are executed.
    return jax.lax.cond(few, tried, by_pivoting, question)


def _by_trial(question: Question, wanted: Array | bool = True) -> tuple[Components, Array]:
    """The first combination in which the motion can continue, and the number of them. The first
    round keeps the mode of surfaces without an event, the second tries all combinations, and the
    third accepts those that hold to within rounding."""
    on, mode = question.on, question.mode
    dtype = question.direction.dtype
    place, powers = _powers(on, dtype)
    size = place.astype(jnp.int32)

    # `number` counts through the combinations, as digits to base 3, one for each surface to decide,
    # and through the three rounds.
    def goes_on(found: _Found) -> Array:
        # A round is completed after a first solution too, so that all are counted. The next one is
        # tried only if it has found no solution.
        rounds = found.number // size
        inside = found.number % size != 0
        return wanted & (rounds < 3) & (inside | (found.count == 0))

    def next_one(found: _Found) -> _Found:
        number, rounds = (found.number % size).astype(dtype), found.number // size
        # A quotient of whole numbers as floats; 1e-3 keeps rounding from lowering its floor.
        digit = on_each(lambda power: jnp.floor(number / power + 1e-3) % 3, powers)
        side = where(digit == 0, 1.0, where(digit == 1, -1.0, 0.0)).astype(dtype)
        # In the third round, within rounding, a slide is tried first.
        slide = rounds == 2 if question.walls is None else ~question.walls & (rounds == 2)
        last = where(digit == 0, 0.0, where(digit == 1, 1.0, -1.0)).astype(dtype)
        side = where(slide, last, side)
        return _try(question, found, where(on, side, mode), rounds)

    zero = jnp.zeros((), jnp.int32)
    still = None if question.fields is None else question.fields[0] * 0.0
    found = jax.lax.while_loop(goes_on, next_one, _Found(mode, zero, still, zero))
    return found.mode, found.count


def _powers(on: Components, dtype: Any) -> tuple[Array, Components]:
    """3 to the number of set flags, and to the number of set flags before each."""
    if on.is_array:
        flags = on.parts[0].astype(dtype)
        before = jnp.cumsum(flags) - flags
        # Larger exponents occur only where trying is not used, and would overflow.
        powers = jnp.minimum(3.0 ** jnp.minimum(before, 18.0), 3.0**18)
        return jnp.minimum(3.0 ** jnp.sum(flags), 3.0**18), Components([powers])
    power, powers = jnp.ones((), dtype), []
    for flag in on.parts:
        powers.append(power)
        power = select(flag, 3 * power, power)
    return power, Components(powers)


def _try(question: Question, found: _Found, candidate: Components, rounds: Array) -> _Found:
    """The result after trying one more combination."""
    ok, mode, made = _continues(question, candidate, rounds)
    first, new, velocity = ok & (found.count == 0), ok, None
    taken = first
    if made is not None and found.velocity is not None:
        # Each is compared with the first alone, since all counts above 1 mean the same, not unique.
        apart = are_apart(made, Velocity(found.velocity, abs(found.velocity)))
        new = ok & ((found.count == 0) | apart)
        velocity = where(first, made.f, found.velocity)
        shared = question.walls is not None and question.slides
        if shared and question.kept is not None and question.now is not None:
            # Of several shares of one load between frictions and walls, the mode before has one.
            # Of several of these the last one is taken, in which the most surfaces slide.
            taken = taken | (ok & ~apart & ~any_of(question.kept & (mode != question.now)))
    # A combination that holds only to within rounding is the same motion to that order.
    new = new & ((rounds < 2) | first)
    return _Found(
        where(taken, mode, found.mode),
        found.count + new.astype(jnp.int32),
        velocity,
        found.number + 1,
    )


def _continues(
    question: Question, candidate: Components, rounds: Array
) -> tuple[Array, Components, Velocity | None]:
    """Whether the motion can continue in a combination, the resulting mode, and the velocity."""
    on, walls, forces = question.on, question.walls, question.forces
    rates, ok = question.rates, jnp.ones((), bool)
    direction, eps = question.direction, jnp.finfo(question.direction.dtype).eps
    lenient: Any = rounds == 2
    if question.kept is not None:
        lenient = lenient | ((rounds == 0) & question.kept)
    if walls is None or forces is None:
        sides, rests, accelerations, force = candidate, None, None, None
    else:
        # A wall has only two options, off (+1) and rest (0).
        ok = ok & ~any_of(on & walls & (candidate == -1))
        rests = where(on, walls & (candidate == 0), rests_of(candidate))
        sides = where(walls & on, question.mode, candidate)
        sides = where(rests_of(sides), 0.5 * sides, sides)
        held = held_together(forces, rates, where(ok, sides, 1.0), rests)
        rates, accelerations, force = held
    slid = on if walls is None else on & ~walls
    following = question.following if accelerations is None else accelerations
    stays = held_too = jnp.zeros((), bool)
    if following is not None:
        # A surface that the slide of another one holds has a weight from that one's rate.
        small = NOISE * eps * rates.sizes()
        held_too = governs(sides, rates, sides, small, slid & (sides == 0))
        alone = ~held_too & slid & question.leaves & question.steered & pushed_by_none(question)
        rates, replaced = in_place(rates, following, direction, question.instant, alone)
        if question.kept is not None and question.now is not None:
            stays = replaced & question.kept & (sides == question.now)
    w = weights(where(ok, sides, 1.0), rates)
    # Rounding may put the weight outside [−1, 1].
    w = where(slid & (sides == 0), minimum(maximum(w, -1.0), 1.0), w)
    # Scaled by the rates before reactions too. If a reaction already balances a friction, the rate
    # that remains is only rounding.
    rate, scale = rates.blend(sides, w), question.rates.sizes() + rates.sizes()
    small = NOISE * eps * scale
    flat = abs(rate) <= small
    # By their own forces or by those of reactions, which cancel where a wall holds the same rate.
    governed = steers = is_governed(sides, rates, w, small)
    if rests is not None:
        governed = governed | is_governed(sides, question.rates, w, small)
    outward = sides * direction * rate
    rounded = flat & (scale > 0)
    leaves = (outward > question.threshold * scale) | (rounded & lenient)
    # At w = ±1 both the slide and its side hold, and the next derivative decides. The slide is
    # preferred: it ends at once if its weight leaves [−1, 1], whereas a wrong side would be
    # detected late. Where a reaction holds this rate, no side moves it. A motion that dψ/dt keeps
    # on its side has no slide there that could end.
    edge = rounded & ~stays
    if rests is not None:
        edge = edge & (steers | ~any_of(rests))
    solved, turned = flat & governed, None
    if following is not None:
        turned = _turned(question, following, force, sides, w, rounds)
        if question.kept is not None and question.now is not None:
            # A surface that has just been left, at the end of its slide, is not slid on again
            # because another one is left at the same time. Of two frictions that share a load
            # each would otherwise be left and slid on in turn, without end.
            edge = edge & ~(question.kept & (sides == question.now) & turned & question.leaves)
    stands = rounds == 2
    if not question.slides:
        stands = stands | _is_held(question, following, force, sides, w)
    leaves = where(edge, stands, leaves)
    if following is not None and turned is not None:
        still = (scale == 0) & (following.sizes() == 0)
        turned = where(still, sides == where(question.mode < 0, -1.0, 1.0), turned)
        leaves = where(flat & ~governed, turned & question.leaves, leaves)
        solved = solved | (flat & held_too)
    if rests is not None and question.kept is not None and question.now is not None:
        # A slide that has ended at its side, at this time, does not begin again there.
        ended = question.kept & question.leaves & (abs(question.now) == 1)
        if following is not None:
            again = ended & (sides == 0) & (w * question.now > 1 - NOISE * eps)
            beside = where(again, question.now, sides)
            bend, noise = _bend(question, following, force, beside, w)
            # The weights of other slides change with the time.
            change = response(beside, rates, where(beside == 0, -bend, 0.0))
            more = jax.jvp(lambda w: rates.blend(beside, w), (w,), (change,))[1]
            solved = solved & ~(again & (question.now * (bend + more) > noise))
    ok = ok & ~any_of(slid & ~where(sides == 0, solved, leaves))
    mode = sides
    if rests is not None and accelerations is not None and force is not None and forces is not None:
        ended = rounded & (abs(sides) == 1) & ~rests & question.ended(sides)
        fine, pushes = _rests(question, rests, rates, accelerations, force, sides, w, ended)
        mode = where(rests, 2 * sides, sides)
        if question.kept is not None and question.now is not None:
            lenient = lenient | (question.kept & (mode == question.now))
        fine = fine | (pushes & lenient)
        asked = on & walls
        if forces is not None and forces.of_corners is not None:
            # A friction on its other side may require a pulling reaction, which is inadmissible.
            asked = asked | rests
        ok = ok & ~any_of(asked & ~fine)
    if question.kept is not None and question.now is not None:
        # Next to a slide that continues, another motion may start.
        stays_so = question.kept & (question.now != 0)
        ok = ok & ((rounds > 0) | ~any_of(stays_so & (mode != question.now)))
    if question.fields is None:
        return ok, mode, None
    return ok, mode, _velocity(question.fields, forces, force, sides, w)


def _is_held(
    question: Question,
    following: Corners | None,
    force: Corners | None,
    sides: Components,
    w: Components,
) -> Components:
    """Whether dψ/dt leads from no surface's side, on which ψ vanishes, back to the surface."""
    if following is None:
        return sides == sides
    bend, noise = _bend(question, following, force, sides, w)
    return sides * bend >= -noise


def _turned(
    question: Question,
    following: Corners,
    force: Corners | None,
    sides: Components,
    w: Components,
    rounds: Array,
) -> Components:
    """Whether dψ/dt leads away from each surface on its side; to within rounding in the third round
    and where the motion is on that side already."""
    known = rounds == 2
    bend, noise = _bend(question, following, force, sides, w)
    if question.kept is not None and question.now is not None:
        known = known | (question.kept & (sides == question.now))
    return (sides * bend > noise) | (known & (abs(bend) <= noise))


def _bend(
    question: Question, following: Corners, force: Corners | None, sides: Components, w: Components
) -> tuple[Components, Components]:
    """dψ/dt, and its rounding."""
    forces, eps = question.forces, jnp.finfo(question.direction.dtype).eps
    bend, size = following.blend(sides, w), following.sizes()
    if forces is not None and force is not None:
        size = forces.accelerations.sizes() + forces.sizes(force.blend(sides, w))
    return bend, NOISE * eps * size


def _velocity(
    fields: Corners, forces: Forces | None, force: Corners | None, sides: Components, w: Components
) -> Velocity:
    """The velocity of a combination with the given weights and reactions."""
    if forces is None or force is None:
        return Velocity(fields.blend(sides, w), fields.sizes())
    if forces.of_corners is not None:
        f = forces.pushed(fields, force).blend(sides, w)
        return Velocity(f, forces.sizes_of_fields(fields, force))
    pushes, directions = force.blend(sides, w), forces.response.directions
    f = directions.added(fields.blend(sides, w), pushes)
    return Velocity(f, abs(directions).added(fields.sizes(), abs(pushes)))


def _rests(
    question: Question,
    rests: Components,
    rates: Corners,
    accelerations: Corners,
    force: Corners,
    sides: Components,
    w: Components,
    ended: Components,
) -> tuple[Components, Components]:
    """Whether reactions push away from resting surfaces and accelerations lead away from others,
    exactly, and to within rounding.

    A wall that a friction has kept the motion off has a reaction and an acceleration of zero where
    the slide has just `ended` at its side. They grow from zero as if the friction became smaller,
    and other slides held the motion as before.
    """
    assert question.forces is not None
    away, eps = question.mode, jnp.finfo(question.direction.dtype).eps
    known = question.forces.accelerations
    smaller = where(ended, 0.0, w)
    moved = jax.jvp(lambda w: rates.blend(where(ended, 0.0, sides), w), (w,), (smaller - w,))[1]
    smaller = smaller + response(sides, rates, where(sides == 0, -moved, 0.0))
    halfway = where(ended, 0.0, sides), smaller
    a, pushes = accelerations.blend(sides, w), force.blend(sides, w)
    noise = NOISE * eps * (known.sizes() + question.forces.sizes(pushes))
    own = question.forces.response.gains.diagonal()
    # λ times its own gain is an acceleration, as the noise is.
    small = where(rests, abs(pushes * own) <= noise, abs(a) <= noise)
    grows = where(rests, force.blend(*halfway) - pushes, accelerations.blend(*halfway) - a)
    grows = where(any_of(ended) & small & (abs(grows) > noise), away * grows, 0.0)
    fine = where(rests, away * pushes > 0, away * a >= 0)
    fine = where(grows == 0, fine, grows > 0)
    return fine, fine | (small & (grows == 0))
