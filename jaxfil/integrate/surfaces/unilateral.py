"""Unilateral constraints: surfaces with resets that reverse the motion, and rest on them.

For a state and the sides it is on, a `Constraints` describes the effect of a reset on each surface
and of the reaction that holds a motion at rest there.

At rest on surface j both H_j = 0 and ψ_j = dH_j/dt = 0, and the field presses the motion against
the surface. The reaction acts as the reset does, along the direction d_j in which the reset moves a
state that arrives slowly. With the change M = D reset_j − I of such a state, d_j is along
p = M ∇ψ_j. A state that was moved along p arrives again and is moved by M p, so that

    ∇ψ_j·d_j = −(∇ψ_j·M p)/(∇ψ_j·p) = 1 + e_j,    ψ_j after it = −e_j ψ_j

A reset with e_j ≥ 0 reverses the motion, any other lets it pass. The reaction is

    ẋ = F + Σ_j λ_j d_j,    Σ_j (∇ψ_i·d_j) λ_j = −a_i,    a_i = dψ_i/dt along F

over the resting surfaces; the rest ends where λ_j no longer pushes away from the surface.

A field that takes its reactions, F(t, x, side, r), affine in r, may contain their full effect on
their own surfaces; then d_j = ∂F/∂r_j and r_j = |λ_j|. Otherwise they act as the reset does, and
∂F/∂r_j is an additional effect, with r_j = (1 + e_j) |λ_j|. Either depends on the sides, as dry
friction does. Reactions are then computed on each combination of sides separately, and the held
fields are blended.

Impacts in ever shorter intervals end in rest. With the pressing acceleration a and the rate ψ just
after an impact the flights last 2ψ/|a|, e times that, e² times that, so that the rest starts after
T = 2ψ/(|a| (1 − e)), up to a relative error T ȧ/a. (Complete chattering: Nordmark and Piiroinen,
Simulation and stability analysis of impacting systems with complete chattering, Nonlinear Dynamics
58, 2009.)
"""

import functools as ft
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.system.components import (
    Components,
    all_finite,
    any_of,
    dot,
    largest,
    pack,
    side_of,
    where,
)
from jaxfil.integrate.system.functions import size_of_time
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.rows import Rows
from jaxfil.xla.select import select
from jaxfil.xla.small_linear import inverse, solve, solve_small

# Rounding of a rate or of an acceleration, in eps of its terms.
_NOISE = 64


class Constraints(eqx.Module):
    """The surfaces as constraints, at one state on given sides."""

    rate: Components
    """ψ_j = dH_j/dt, m components."""
    gradients: Rows
    """∇ψ_j, n components each."""
    impulse: "Response"
    """The effect of resets."""
    reaction: "Response"
    """The effect of reactions, equal to `impulse` unless the field takes reactions."""
    known: Components
    """Whether the derivative of the reset is finite, so that d_j is known, m flags."""


class ResetEffect(eqx.Module):
    """The effect of the reset of each surface on a state that arrives there, m flags each."""

    changes: Components
    """Whether it changes the state, there and just after."""
    throws_back: Components
    """Whether it reverses the motion there, e_j ≥ 0, and does not move it off the surface."""


class Response(eqx.Module):
    """The effect of forces at surfaces on the state, and on the rates of all surfaces."""

    directions: Rows
    """d_j, n numbers each; zero where the reset has no effect."""
    gains: Rows
    """∇ψ_i·d_j, m numbers each."""

    def answered(self, a: Components, force: Components) -> Components:
        """Rates or accelerations a with forces λ included, a + Σ_k λ_k ∇ψ·d_k."""
        return a + self.gains @ force


def contact_rates(
    system: ComponentSystem, t: Array, x: Components, sides: Components
) -> Components:
    """ψ = dH/dt along the field of some sides, m components."""
    return system.rate(t, x, system.field(t, x, sides))


def constraints(system: ComponentSystem, t: Array, x: Components, sides: Components) -> Constraints:
    """The surfaces as constraints at (t, x), for a motion on `sides`."""
    rate, pull = jax.vjp(lambda x: contact_rates(system, t, x, sides), x)
    gradients = system.rows_of(pull)
    direction, (_, _, normals) = ft.partial(_direction, system, t, x), system.gradients(t, x)
    if gradients.is_array:
        numbers = jnp.arange(system.m, dtype=jnp.int32)
        given = sides.parts[0], rate.parts[0], gradients.rows[0], normals.rows[0], numbers
        found, finite = jax.vmap(direction)(*given)
        directions, known = Rows.array(found.parts[0]), Components([finite])
    else:
        each = zip(sides.parts, rate.parts, gradients.rows, normals.rows, strict=True)
        found, finite = zip(*(direction(*of_j, j) for j, of_j in enumerate(each)), strict=True)
        directions, known = Rows(list(found)), Components(finite)
    impulse = Response(directions, gradients.products(directions))
    reaction = impulse
    if system.feels_reactions:
        reaction = felt_response(system, (t, x), sides, sides, gradients, impulse)
    return Constraints(rate, gradients, impulse, reaction, known)


def reset_effect(
    system: ComponentSystem,
    t: Array,
    x: Components,
    c: Constraints,
    normals: Rows,
    later: tuple[Array, Components] | None = None,
) -> ResetEffect:
    """The effect of resets at (t, x), given the constraints and ∇H there. With a `later` time and
    state on the motion, a reset must change that state too in order to count as a change."""

    def own(normal: Components, j: int | Array) -> tuple[Array, Array]:
        # At x itself, since an incoming state may be off a curved surface.
        after = system.reset(t, x, jnp.int32(j))
        step, sizes = stop_gradient((after - x, abs(after) + abs(x)))
        # Far above the rounding of a state, and of a reset that puts it back on its surface.
        least = system.eps**0.5 * dot(abs(stop_gradient(normal)), sizes)
        changes = any_of(step != 0)
        if later is not None:
            # On its surface a comparison in a reset, such as of a force and the limit that it has
            # just exceeded, is decided by rounding.
            changes = changes & any_of(system.reset(*later, jnp.int32(j)) != later[1])
        return changes, abs(dot(normal, step)) > least

    if normals.is_array:
        flags = jax.vmap(own)(normals.rows[0], jnp.arange(system.m, dtype=jnp.int32))
        changes, clears = (Components([v]) for v in flags)
    else:
        flags = [own(normal, j) for j, normal in enumerate(normals.rows)]
        changes, clears = map(Components, zip(*flags, strict=True))
    gains = stop_gradient(c.impulse.gains.diagonal())
    # With e = 0 the gain is 1 only up to more than rounding, since the reset is differentiated
    # at an incoming state (`_direction`). A reset that lets pass has a gain far below.
    return ResetEffect(changes, (gains >= 1 - system.eps**0.5) & ~clears)


def lets_through(outward: Components, noise: Components) -> Components:
    """Whether resets let a motion through that has come to their surfaces, given its rate away from
    each after the reset. A reset may do so with a fast motion, or in some states, even if by its
    derivative it throws slow ones back (`ResetEffect`)."""
    return outward < -noise


def felt_response(
    system: ComponentSystem,
    at: tuple[Array, Components],
    walls: Components,
    sides: Components,
    gradients: Rows,
    impulse: Response,
) -> Response:
    """The response to reactions of a field that takes them, on `sides`, for walls on their sides
    `walls`."""
    alone = system.of_surfaces(jnp.asarray(system.holds_itself))
    # r_j for a unit reaction, |λ_j| or (1 + e_j) |λ_j|. The gain of the reset is 1 + e_j.
    sizes = where(alone, walls, walls * impulse.gains.diagonal())

    def felt(unit: Components) -> Components:
        return system.felt(*at, sides, sizes * unit)

    directions = system.for_units(felt)
    directions = directions.where(system.holds_itself, directions.plus(impulse.directions))
    return Response(directions, gradients.products(directions))


def _direction(
    system: ComponentSystem,
    t: Array,
    x: Components,
    side: Array,
    rate: Array,
    gradient: Components,
    normal: Components,
    j: int | Array,
) -> tuple[Components, Array]:
    """d_j, from the derivative of the reset along y = ∇ψ_j at an incoming state, 0 where the reset
    does not throw back; and whether that derivative is finite."""
    size = dot(gradient, gradient)
    inverse = select(size > 0, 1 / select(size > 0, size, 1), 0.0)
    # The reset may be defined only for incoming states, so it is differentiated at one. The state
    # is moved just far enough that ψ has the incoming sign beyond rounding.
    terms = dot(abs(gradient), abs(x))
    # Positive even at a state of zero. A Python number, since one of NumPy would promote float32.
    least = float(np.finfo(system.dtype).tiny) ** 0.5
    depth = stop_gradient(_NOISE * system.eps * terms + least + side * rate)
    moving = x + -side * depth * stop_gradient(inverse) * stop_gradient(gradient)
    reset = ft.partial(system.reset, t, surface=jnp.int32(j))
    thrown, moved = jax.linearize(reset, moving)
    push = moved(gradient) - gradient
    again, own = moved(push) - push, dot(gradient, push)
    known = own != 0
    # 1 + e_j, by which a state that has been pushed comes back.
    gain = -dot(gradient, again) / select(known, own, 1)
    direction = push * select(known, gain / select(known, own, 1), 0)
    (after,) = jax.linear_transpose(moved, moving)(gradient)
    known = stop_gradient((gain - 1, rate, x, moving, thrown, gradient, after, normal))
    reflects = _reflects(*known, eps=system.eps)
    # A reset may be undefined far from its contacts, where no motion feels it.
    finite = all_finite(direction)
    return where(finite & reflects, direction, 0.0), finite


def _reflects(
    e: Array,
    rate: Array,
    x: Components,
    before: Components,
    after: Components,
    gradient: Components,
    pulled: Components,
    normal: Components,
    eps: float,
) -> Array:
    """Whether ψ after a reset is −e times ψ before it, in a state that may rest and in others on
    the surface, given (D reset)ᵀ ∇ψ; true where the state is too fast to rest.

    A switch that stops the flow to a level has the derivative of a wall with e = 0. After it ψ is
    the rate of the other flows, and no reaction keeps it zero.
    """
    came, went = (rate + dot(gradient, state - x) for state in (before, after))
    terms = dot(abs(gradient), abs(x) + abs(before) + abs(after))
    # States on the surface differ in directions orthogonal to ∇H.
    other, square = pulled + e * gradient, dot(normal, normal)
    other = other - dot(other, normal) / select(square > 0, square, 1) * normal
    alike = ~any_of(abs(other) > eps**0.5 * largest(abs(pulled) + abs(gradient)))
    # Faster states are moved so far in order to arrive slowly that curvature counts.
    fast = abs(rate) > eps**0.75 * terms
    return fast | (alike & (abs(went + e * came) <= eps**0.5 * terms))


def accelerations(
    system: ComponentSystem, t: Array, x: Components, sides: Components, f: Components
) -> Components:
    """a: the derivatives of ψ along the field f, m components."""
    _, a = jax.jvp(lambda t, x: contact_rates(system, t, x, sides), (t, x), (jnp.ones_like(t), f))
    return a


def rate_noise(
    system: ComponentSystem,
    t: Array,
    x: Components,
    inside: Components | None,
    dt: Array,
    f: Components,
    c: Constraints,
    by_time: Components,
    surfaces: tuple[Components, Rows],
) -> Components:
    """The rounding error of ψ, from t and x, from its terms, and from the preceding steps.
    `surfaces` are ∂H/∂t and ∂H/∂x, `by_time` is ∂ψ/∂t, `inside` is
    `ComponentSystem.rate_rounding`; x and f are sizes."""
    (h_t, normals), clock = surfaces, size_of_time(system.clocks, t)
    # Steps accumulate rounding in proportion to these terms, even if ψ itself stays zero, as for
    # bodies that fall side by side.
    gained = abs(c.gradients) @ abs(f)
    terms = abs(h_t) + abs(normals) @ abs(f) + abs(c.gradients) @ x
    terms = terms + abs(by_time * clock) + (gained + abs(by_time)) * abs(dt)
    # Rounding inside ψ does not accumulate over steps. The factor 2 is the largest difference
    # between two evaluations.
    terms = _NOISE * terms if inside is None else _NOISE * terms + 2 * inside
    return stop_gradient(jnp.finfo(t.dtype).eps * terms)


def multipliers(gains: Rows, a: Components, rests: Components) -> Components:
    """λ of the resting surfaces, 0 for others, given the accelerations a without reactions."""
    return multipliers_of_each(gains, [a], rests)[0]


def multipliers_of_each(
    gains: Rows, each: Sequence[Components], rests: Components
) -> list[Components]:
    """`multipliers` for several accelerations, by one elimination."""
    rights = [where(rests, -a, 0.0) for a in each]
    if gains.is_array:
        (on,), forces = rests.parts, jnp.stack([v.parts[0] for v in rights], axis=1)
        found = solve(_among_rests(gains, rests), forces, on)
        return [Components([found[:, r]]) for r in range(len(rights))]
    found = solve_small(_among_rests(gains, rests), [v.parts for v in rights])
    return list(map(Components, found))


def change_of_multipliers(gains: Rows, change: Components, rests: Components) -> Components:
    """`multipliers` for a tangent of a, in which it is linear for reverse mode too."""
    if change.size <= 2 and not gains.is_array:  # written out, without a loop
        return multipliers(gains, change, rests)
    on = rests.parts[0] if gains.is_array else None
    found = inverse(_among_rests(gains, rests), on) @ pack(where(rests, -change, 0.0), float)
    return Components([found] if gains.is_array else list(found))


def _among_rests(gains: Rows, rests: Components) -> Any:
    """The matrix of the equations of λ, an array or a list of rows. Surfaces without a rest have
    rows and columns of the identity."""
    if gains.is_array:
        (on,) = rests.parts
        entries = jnp.asarray(gains.entries())
        both, unit = on[:, None] & on[None, :], jnp.eye(len(on), dtype=entries.dtype)
        return select(both, entries, unit)
    matrix, on = [], rests.parts
    for i, row in enumerate(gains.rows):
        both = [on[i] if i == j else on[i] & other for j, other in enumerate(on)]
        entries = enumerate(zip(both, row.parts, strict=True))
        matrix.append([select(flag, gain, float(i == j)) for j, (flag, gain) in entries])
    return matrix


def held_field(
    system: ComponentSystem, t: Array, x: Components, mode: Components, f: Components
) -> tuple[Components, Components]:
    """The field f of a mode at (t, x) with the reactions of the resting surfaces, and the sizes λ
    of these, positive if they push away; without rests f unchanged, and 0."""
    sides, rests = sides_of(mode), rests_of(mode)
    of = constraints(system.in_mode(mode), t, x, sides).reaction
    force = multipliers(of.gains, accelerations(system, t, x, sides, f), rests)
    held = where(any_of(rests), of.directions.added(f, force), f)
    return held, sides * force


def reaction_scale(
    system: ComponentSystem, t: Array, x: Components, mode: Components
) -> Components:
    """The size of the terms in the reactions of a mode, m components."""
    c = constraints(system, t, x, sides_of(mode))
    f = system.field(t, x, sides_of(mode))
    # λ_j = −a_j/(∇ψ_j·d_j) without the coupling to other surfaces, and a_j has the terms ∇ψ_j·F.
    own = abs(c.reaction.gains.diagonal())
    return abs(c.gradients) @ abs(f) / where(own > 0, own, 1)


def rests_of(mode: Components) -> Components:
    """Flags of the surfaces that a mode rests on, ±2 by the side."""
    return abs(mode) == 2


def beside(mode: Components) -> Components:
    """The same mode with sides ±1 in place of rests ±2."""
    return where(rests_of(mode), 0.5 * mode, mode)


def sides_of(mode: Components) -> Components:
    """The sides of a mode, + for a slide; rates of constraints are the same on both sides there."""
    return side_of(mode)


def pressed(
    of: Response, a: Components, sides: Components, candidates: Components
) -> tuple[Components, Array]:
    """Which of the resting surfaces stay at rest, and whether this is consistent: λ_j pushes away
    from each surface that holds, and a_j leads away from each that does not.

    Surfaces whose reaction would have to pull, or is zero, are released all at once, repeatedly,
    until the set no longer changes.
    """
    of, a, sides = stop_gradient((of, a, sides))
    m = a.size

    def let_go(on: Components) -> Components:
        return on & (sides * multipliers(of.gains, a, on) > 0)

    def next_round(rounds: tuple[Components, Components]) -> tuple[Components, Components]:
        return rounds[1], let_go(rounds[1])

    if m == 1:
        # A second round would not change the set.
        on = let_go(candidates)
    else:
        # The set only shrinks, so there are at most m rounds.
        start = candidates, let_go(candidates)
        _, on = jax.lax.while_loop(lambda v: any_of(v[0] & ~v[1]), next_round, start)
    left = of.answered(a, multipliers(of.gains, a, on))
    # Negated twice, so that a NaN counts as inconsistent.
    return on, ~any_of(candidates & ~on & ~(sides * left >= 0))
