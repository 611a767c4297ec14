"""The decision for many surfaces, with a field that is affine in its sides, by pivoting.

The conditions of `decision` on the rates ψ = dH/dt, or on dψ/dt where ψ vanishes, are then one
affine variational inequality on a box, for the weights and the reactions of all surfaces together
(`xla.complementarity`). Its size is the number of surfaces, where combinations of modes are 3^m.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.surfaces.question import (
    NOISE,
    Question,
    Velocity,
    are_apart,
    in_place,
    pushed_by_none,
)
from jaxfil.integrate.surfaces.unilateral import rests_of
from jaxfil.integrate.system.components import Components, pack, where
from jaxfil.xla.complementarity import is_monotone, residual_noise, solve_on_box
from jaxfil.xla.select import select
from jaxfil.xla.small_linear import solve


class _Inequality(eqx.Module):
    """The variational inequality F = q + M z on a box, of all surfaces. z has weights, and the
    sizes of reactions; F = −ψ for a weight and a for a reaction. Surfaces that are not decided, and
    do not rest, have equal bounds."""

    q: Array
    matrix: Array
    low: Array
    high: Array
    slid: Array
    """Surfaces with a weight to be found, m flags."""
    level: Array
    """Those of them that dψ/dt decides in place of ψ."""

    @property
    def walls(self) -> Array:
        """Surfaces with a reaction to be found, m flags."""
        return self.high == jnp.inf

    def value(self, z: Array) -> Array:
        """F at z."""
        return self.q + self.matrix @ z

    def noise(self, z: Array) -> Array:
        """The rounding of F at z."""
        return residual_noise(self.q, self.matrix, z, self.high)


def by_pivoting(question: Question) -> tuple[Components, Array]:
    """`decision.decide` by pivoting. The solution is unique if the symmetric part of the matrix is
    positive definite. Otherwise the search starts again from other sides, from the opposite of all
    and of each, until another motion is found. Returns the mode, m components, and the number of
    solutions: 0, 1, or 2 for several."""
    posed = _inequality(question)
    z, found = _solution(question, posed)
    mode, held = _mode_of(question, posed, z)
    # Backward in time a repelling slide may have started at any earlier time. A slide that goes on
    # forward has been decided before, and its matrix is not examined in each step.
    on = pack(question.on, bool)
    back = (question.direction < 0) & jnp.any(on & (mode == 0))
    examined = found & (back | question.leaves)
    monotone = jax.lax.cond(
        examined, lambda: is_monotone(posed.matrix, on), lambda: jnp.ones((), bool)
    )
    several = ~monotone & (back | _has_another(question, posed, z, examined & ~monotone & ~back))
    count = select(found, select(several, 2, select(held, 1, 0)), 0).astype(jnp.int32)
    return _like(question.mode, mode), count


def _mode_of(question: Question, posed: _Inequality, z: Array) -> tuple[Array, Array]:
    """The mode, m numbers, of a solution, which only says which surfaces slide or rest: weights and
    reactions are computed from the mode. Also whether what dψ/dt decides is held in that mode."""
    on, mode = pack(question.on, bool), pack(question.mode, posed.q.dtype)
    weight = select(abs(z) >= 1, jnp.sign(z), 0.0)
    # Where dψ/dt vanishes in place of ψ, the slide of another surface holds both.
    balanced = abs(posed.value(z)) <= posed.noise(z)
    both = posed.level & balanced
    steered = pack(question.steered, bool)
    # Others are held by the weight of one that is steered, or not at all.
    weights = (posed.slid & steered & balanced)[None, :] & (posed.matrix != 0)
    held = ~jnp.any(both & ~steered & ~jnp.any(weights, axis=1))
    holding = balanced & jnp.any((posed.matrix != 0) & both[None, :], axis=1)
    # At z = ±1 both the slide and its side hold. As in `decision`, the slide is preferred.
    sliding = posed.slid & jnp.any((posed.matrix != 0) & posed.slid[None, :], axis=1)
    stays = _stays_on_side(question, posed, z)
    if not question.slides:
        stays = stays | _is_held(question, z)
    edge, rests = balanced & sliding & ~stays, z > 0
    if question.walls is not None:
        edge = edge & ~_pulls(posed, z)
        rests = rests | _takes_over(question, posed, z, balanced)
    weight = select(both | holding | edge, 0.0, weight)
    chosen = select(posed.slid, weight, select(rests, 2 * mode, mode))
    return select(on, chosen, mode), held


def _stays_on_side(question: Question, posed: _Inequality, z: Array) -> Array:
    """Surfaces on whose side the motion is already, m flags, and which it leaves by dψ/dt."""
    following = _following(question)
    if following is None or question.kept is None or question.now is None:
        return jnp.zeros_like(posed.slid)
    bend, noise = _second_rate(question, following, z)
    now = pack(question.now, z.dtype)
    on = pack(question.kept, bool) & (jnp.sign(z) == now) & question.leaves
    return on & (now * bend > noise)


def _takes_over(question: Question, posed: _Inequality, z: Array, balanced: Array) -> Array:
    """Walls, m flags, that begin to bear what a slide bore that has ended at its side. Their
    reactions, zero here, and the accelerations away from them solve the inequality for the
    changes as if the friction became smaller."""
    following, walls = _following(question), posed.walls
    if following is None:
        return jnp.zeros_like(walls)
    bend, noise = _second_rate(question, following, z)

    def beside(changes: Array, others: Array) -> Array:
        # Others change too, so that what they hold is held.
        return changes - posed.matrix @ solve(posed.matrix, changes, others)

    slid = posed.slid & (abs(z) < 1)
    (bend,) = beside(bend[:, None], slid).T
    ended = pack(question.ended(_like(question.mode, z)), bool) & ~walls & (abs(z) == 1) & balanced
    ended = ended & (z * bend > noise) & question.leaves
    changes = jnp.concatenate([(posed.matrix @ select(ended, -z, 0.0))[:, None], posed.matrix], 1)
    changes = beside(changes, slid | (walls & (z > 0)))
    rises, gains = changes[:, 0], changes[:, 1:]
    idle = walls & (z == 0) & balanced & jnp.any(ended)
    bound = jnp.zeros_like(z)
    borne, _ = solve_on_box(rises, gains, bound, select(idle, jnp.inf, bound))
    return idle & (borne > 0)


def _is_held(question: Question, z: Array) -> Array:
    """As in `decision`, for the sides at z = ±1."""
    following = _following(question)
    if following is None:
        return abs(z) >= 1
    bend, noise = _second_rate(question, following, z)
    return (abs(z) >= 1) & (z * bend >= -noise)


def _second_rate(question: Question, following: Corners, z: Array) -> tuple[Array, Array]:
    """dψ/dt with the weights and reactions z, and its rounding."""
    sides, force = _parted(question, z)
    bend, size = following.blend(sides, _like(question.mode, z)), following.sizes()
    if question.forces is not None:
        bend = bend + question.forces.response.gains @ force
        size = size + question.forces.sizes(abs(force))
    return pack(bend, z.dtype), NOISE * jnp.finfo(z.dtype).eps * pack(size, z.dtype)


def _parted(question: Question, z: Array) -> tuple[Components, Components]:
    """The sides of all surfaces, 0 of those with a weight among the weights and reactions z, and
    the reactions λ in z, 0 of others; m components each."""
    slid = question.on if question.walls is None else question.on & ~question.walls
    one = question.mode.like(jnp.ones((), z.dtype))
    sides = where(slid, 0.0, where(question.mode < 0, -one, one))
    rests = rests_of(question.mode) | (question.on & ~slid)
    return sides, where(rests, _like(question.mode, z) * sides, 0.0)


def _following(question: Question) -> Corners | None:
    """dψ/dt on the combinations of sides, without reactions."""
    return question.following if question.forces is None else question.forces.accelerations


def _like(mode: Components, v: Array) -> Components:
    """The numbers of all surfaces in the layout of the mode."""
    return Components([v] if mode.is_array else list(v))


def _solved(posed: _Inequality, signs: Array) -> tuple[Array, Array]:
    """A solution, and whether one was found, with these signs of the unknowns. The search starts at
    the lower bounds, and a sign of −1 makes the upper one the lower."""
    turned = signs < 0
    low, high = select(turned, -posed.high, posed.low), select(turned, -posed.low, posed.high)
    matrix = signs[:, None] * posed.matrix * signs[None, :]
    z, found = solve_on_box(signs * posed.q, matrix, low, high)
    return signs * z, found


def _solution(question: Question, posed: _Inequality) -> tuple[Array, Array]:
    """A solution, and whether one was found, in which no surface bears a load that the slides can
    bear. A mass that its friction can hold at a wall has many solutions, between those of the
    friction alone and of the wall. In a mode that slides and rests there its weight and reaction
    would be undetermined."""
    number, plus = jnp.arange(len(posed.q), dtype=jnp.int32), jnp.ones_like(posed.q)
    if question.walls is None:
        return _solved(posed, plus)
    linked = jnp.any((posed.matrix != 0) & posed.slid[None, :], axis=1) & posed.walls

    def unfinished(state: tuple) -> Array:
        *_, k = state
        return k < len(number)

    def next_one(state: tuple) -> tuple:
        z, found, without, k = state
        # First with all surfaces, then without one more of those that have a reaction.
        tried = without | (number == k)
        fewer = dataclasses.replace(posed, high=select(tried, posed.low, posed.high))
        other, ok = _solved(fewer, plus)
        apart = are_apart(_velocity_of(question, z), _velocity_of(question, other))
        runs_in = tried & (fewer.value(other) < -fewer.noise(z))
        ok = ok & ((k < 0) | ~(apart | jnp.any(runs_in)))
        z, without = select(ok, other, z), select(ok, tried, without)
        later = linked & (z > 0) & (number > k)
        k = select(jnp.any(later), jnp.argmax(later).astype(k.dtype), len(number))
        return z, found | ok, without, k

    start = 0.0 * posed.q, jnp.zeros((), bool), jnp.zeros_like(posed.slid), jnp.int32(-1)
    z, found, *_ = jax.lax.while_loop(unfinished, next_one, start)
    return z, found


def _pulls(posed: _Inequality, z: Array) -> Array:
    """Slides at the end of their weight whose rates reactions hold, m flags, if one of these would
    have to pull without their friction. A slide that reactions hold has the weight 0."""
    rests = posed.walls & (z > 0)
    # The change of the reactions by each weight, and of the rates by both.
    change = solve(posed.matrix, posed.matrix, rests)
    answer = jnp.diag(posed.matrix) - jnp.sum(posed.matrix * change.T, axis=1)
    terms = abs(jnp.diag(posed.matrix)) + jnp.sum(abs(posed.matrix * change.T), axis=1)
    held = posed.slid & (abs(z) >= 1) & (abs(answer) <= NOISE * jnp.finfo(z.dtype).eps * terms)
    return held & jnp.any(rests & (z + change @ select(held, z, 0.0) <= 0))


def _has_another(question: Question, posed: _Inequality, z: Array, wanted: Array) -> Array:
    """Whether a search from other sides finds a solution with another velocity."""
    first, number = _velocity_of(question, z), jnp.arange(len(z), dtype=jnp.int32)

    def unfinished(state: tuple[Array, Array]) -> Array:
        another, k = state
        return wanted & ~another & (k < len(z))

    def next_one(state: tuple[Array, Array]) -> tuple[Array, Array]:
        _, k = state
        signs = select(posed.slid & ((k < 0) | (number == k)), -1.0, 1.0).astype(z.dtype)
        other, found = _solved(posed, signs)
        return found & are_apart(first, _velocity_of(question, other)), k + 1

    start = jnp.zeros((), bool), jnp.full((), -1, jnp.int32)
    another, _ = jax.lax.while_loop(unfinished, next_one, start)
    return another


def _velocity_of(question: Question, z: Array) -> Velocity:
    """The velocity with the weights and reactions z; these themselves if all modes count as
    different motions."""
    weights, forces = _like(question.mode, z), question.forces
    if question.fields is None:
        return Velocity(weights, abs(weights))
    sides, force = _parted(question, z)
    f, size = question.fields.blend(sides, weights), question.fields.sizes()
    if forces is None:
        return Velocity(f, size)
    directions = forces.response.directions
    return Velocity(directions.added(f, force), abs(directions).added(size, abs(force)))


def _inequality(question: Question) -> _Inequality:
    """The inequality of a question with a field that is affine in its sides."""
    known, direction = question.forces, question.direction
    active, mode = pack(question.on, bool), pack(question.mode, direction.dtype)
    side, resting = jnp.sign(mode), ~active & (abs(mode) == 2)
    slid, rates, level = active, question.rates, jnp.zeros_like(active)
    if question.walls is not None:
        slid = active & ~pack(question.walls, bool)
    following = _following(question)
    if following is not None:
        free = pushed_by_none(question) & question.leaves
        free = free if question.walls is None else free & ~question.walls
        rates, replaced = in_place(rates, following, direction, question.instant, free)
        level = pack(replaced, bool)
    base, slopes = -direction * pack(rates[0], mode.dtype), rates.slopes()
    matrix, wall = -direction * slopes, jnp.zeros_like(active)
    by_weight = matrix  # with walls, their rows are others
    if known is not None and question.walls is not None:
        # The reaction of a surface that continues to rest is an unknown too, since the reactions of
        # other surfaces change it.
        wall = (active & ~slid) | resting
        of_wall = side[:, None]
        a = pack(known.accelerations[0], mode.dtype)
        base = select(wall, side * a, base)
        by_weight = select(wall[:, None], of_wall * known.accelerations.slopes(), matrix)
        # The unknown of a wall is |λ|, hence the side in its column. Its row is the acceleration
        # away from the wall, hence the side there.
        gains, pushes = (jnp.asarray(v.entries()) for v in (known.response.gains, known.pushes))
        pushes = select(level[:, None], -gains, -direction * pushes)
        by_force = select(wall[:, None], of_wall * gains, pushes)
        matrix = select(wall[None, :], by_force * side[None, :], by_weight)
    # The base rates belong to w = 1 (all sides +); the side of a wall is fixed.
    q = base + by_weight @ (select(wall, side, 0.0) - 1.0)
    low = select(wall, 0.0, select(active, -1.0, side))
    high = select(wall, jnp.inf, select(active, 1.0, side))
    return _Inequality(q, matrix, low, high, slid, level)
