"""Unilateral constraints: surfaces that a reset throws back from, and rest on them.

A system with resets, a state and the sides it is on enter; how a reset acts on a surface, and the
reaction that holds a motion at rest there, leave.

At rest on surface j both H_j = 0 and ψ_j = dH_j/dt = 0, and the field presses the motion against
the surface. What keeps it there acts as the reset does: along the direction d_j in which the reset
moves a state that comes in slowly. Near such a state the reset is x − d_j ψ_j: with y = ∇ψ_j

    d_j = −(D reset_j − I) y / (∇ψ_j·y),    ψ_j after it = (1 − ∇ψ_j·d_j) ψ_j = −e_j ψ_j

and ∇ψ_j·d_j is 1 + e_j: a reset with e_j ≥ 0 throws back, any other lets through. The reaction is

    ẋ = F + Σ_j λ_j d_j,    Σ_j (∇ψ_i·d_j) λ_j = −a_i,    a_i = dψ_i/dt along F

over the surfaces rested on; the rest ends where λ_j ceases to push away from the surface.

Impacts that follow each other ever faster end in rest: with the pressing acceleration a and the
rate ψ just after an impact the flights last 2ψ/|a|, e of that, e² of that, so that the rest begins
after T = 2ψ/(|a| (1 − e)), up to a part T ȧ/a. (Complete chattering: Nordmark and Piiroinen,
Simulation and stability analysis of impacting systems with complete chattering, Nonlinear Dynamics
58, 2009.)
"""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.surfaces.corners import Corners
from jaxfil.integrate.system.components import Components, any_of, dot, side_of, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.rows import Rows
from jaxfil.xla.select import select
from jaxfil.xla.small_linear import solve, solve_small

# Rounding of a rate or of an acceleration, in eps of its terms.
_NOISE = 64
# What is left of terms that cancel, in eps of these.
_CANCELLED = 8


class Constraints(eqx.Module):
    """The surfaces as constraints, at one state on given sides."""

    rate: Components
    """ψ_j = dH_j/dt, m components."""
    gradients: Rows
    """∇ψ_j, n components each."""
    directions: Rows
    """d_j, n components each; zero where the reset does nothing."""
    gains: Rows
    """∇ψ_i·d_j, m components each."""

    @property
    def throws_back(self) -> Components:
        """Whether the reset of a surface turns the motion back, e_j ≥ 0."""
        own = stop_gradient(self.gains.diagonal())
        return own >= 1 - 64 * jnp.finfo(own.parts[0].dtype).eps


class Forces(eqx.Module):
    """What the reactions of surfaces do to the rates of all, at one state."""

    gains: Rows
    """∇ψ_i·d_j, m numbers each."""
    pushes: Rows
    """∇H_i·d_j, m numbers each."""
    directions: Rows
    """d_j, n numbers each."""
    accelerations: Corners
    """dψ/dt, m numbers, along the field on each combination of sides."""


def contact_rates(
    system: ComponentSystem, t: Array, x: Components, sides: Components
) -> Components:
    """ψ: dH/dt along the field of some sides, m components."""
    return system.rate(t, x, system.field(t, x, sides))


def constraints(system: ComponentSystem, t: Array, x: Components, sides: Components) -> Constraints:
    """The surfaces as constraints at (t, x), for a motion on `sides`."""
    rate, pull = jax.vjp(lambda x: contact_rates(system, t, x, sides), x)
    gradients = system.rows_of(pull)
    direction = ft.partial(_direction, system, t, x)
    if gradients.is_array:
        numbers = jnp.arange(system.m, dtype=jnp.int32)
        given = sides.parts[0], rate.parts[0], gradients.rows[0], numbers
        directions = Rows.array(jax.vmap(direction)(*given).parts[0])
    else:
        each = zip(sides.parts, rate.parts, gradients.rows, strict=True)
        directions = Rows(direction(*of_j, j) for j, of_j in enumerate(each))
    return Constraints(rate, gradients, directions, gradients.products(directions))


def _direction(
    system: ComponentSystem,
    t: Array,
    x: Components,
    side: Array,
    rate: Array,
    gradient: Components,
    j: int | Array,
) -> Components:
    """d_j, from the derivative of the reset along y = ∇ψ_j at a state that comes in."""
    size = dot(gradient, gradient)
    inverse = select(size > 0, 1 / select(size > 0, size, 1), 0.0)
    # A reset may be written for motions that come in only: its derivative is that at such a state,
    # by so little that nothing else is told of it.
    terms = dot(abs(gradient), abs(x))
    least = float(np.finfo(system.dtype).tiny) ** 0.5
    depth = stop_gradient(_NOISE * system.eps * terms + least + side * rate)
    moving = x + -side * depth * stop_gradient(inverse) * stop_gradient(gradient)
    _, moved = jax.jvp(lambda x: system.reset(t, x, jnp.int32(j)), (moving,), (gradient,))
    return (gradient - moved) * inverse


def accelerations(
    system: ComponentSystem, t: Array, x: Components, sides: Components, f: Components
) -> Components:
    """a: the derivatives of ψ along the field f, m components."""
    _, a = jax.jvp(lambda t, x: contact_rates(system, t, x, sides), (t, x), (jnp.ones_like(t), f))
    return a


def rate_noise(
    t: Array,
    x: Components,
    inside: Components | None,
    dt: Array,
    f: Components,
    c: Constraints,
    by_time: Components,
    surfaces: tuple[Components, Rows],
) -> Components:
    """What rounding does to ψ: of t and x, of the terms that it is made of, and of the steps by
    which the state has come here. `surfaces` are ∂H/∂t and ∂H/∂x, `by_time` is ∂ψ/∂t, `inside` is
    `ComponentSystem.rate_rounding`; x and f are sizes."""
    h_t, normals = surfaces
    # Of bodies that fall side by side ψ stays zero, and its terms do not.
    gained = abs(c.gradients) @ abs(f)
    terms = abs(h_t) + abs(normals) @ abs(f) + abs(c.gradients) @ x
    terms = terms + abs(by_time * t) + (gained + abs(by_time)) * abs(dt)
    # What is rounded inside of ψ does not gather: twice its bound is how far evaluations differ.
    terms = _NOISE * terms if inside is None else _NOISE * terms + 2 * inside
    return stop_gradient(jnp.finfo(t.dtype).eps * terms)


def multipliers(gains: Rows, a: Components, rests: Components) -> Components:
    """λ of the surfaces rested on, 0 of others, given the accelerations a without reactions."""
    right = where(rests, -a, 0.0)
    if gains.is_array:
        (on,), (force,), unit = rests.parts, right.parts, jnp.eye(len(rests.parts[0]))
        both = on[:, None] & on[None, :]
        matrix = select(both, jnp.asarray(gains.entries()), unit.astype(force.dtype))
        return Components([solve(matrix, force, on)])
    matrix, on = [], rests.parts
    for i, row in enumerate(gains.rows):
        both = [on[i] if i == j else on[i] & other for j, other in enumerate(on)]
        entries = enumerate(zip(both, row.parts, strict=True))
        matrix.append([select(flag, gain, float(i == j)) for j, (flag, gain) in entries])
    return Components(solve_small(matrix, right.parts))


def forces(
    system: ComponentSystem, t: Array, x: Components, mode: Components, fields: Corners
) -> Forces:
    """What reactions do where the fields on all sides are these."""
    sides = sides_of(mode)
    c, first = constraints(system, t, x, sides), fields[0]
    # ψ does not depend on a side: only the field along which it changes does.
    by_time = accelerations(system, t, x, sides, first) - c.gradients @ first
    _, _, normals = system.gradients(t, x)
    return forces_of(c, by_time, normals, fields)


def forces_of(c: Constraints, by_time: Components, normals: Rows, fields: Corners) -> Forces:
    """The same of surfaces that are known as constraints; `by_time` is ∂ψ/∂t."""
    pushes = normals.products(c.directions)
    return Forces(c.gains, pushes, c.directions, fields.each(lambda f: by_time + c.gradients @ f))


def held(known: Forces, rates: Corners, rests: Components) -> tuple[Corners, Corners, Corners]:
    """Rates of H, accelerations and reactions λ on each combination of sides, with the reactions of
    the surfaces rested on: linear in the field, so that they blend as it does."""

    def reaction(a: Components) -> Components:
        return multipliers(known.gains, a, rests)

    def pushed(rows: Rows, rate: Components, force: Components) -> Components:
        # What reactions cancel is not rounding of either sign: weights would be made of it.
        after, size = rate + rows @ force, abs(rate) + abs(rows) @ abs(force)
        small = abs(after) <= _CANCELLED * float(jnp.finfo(size.parts[0].dtype).eps) * size
        return after - stop_gradient(where(small, after, 0.0))

    force = known.accelerations.each(reaction)
    rates = rates.each(ft.partial(pushed, known.pushes), force)
    return rates, known.accelerations.each(ft.partial(pushed, known.gains), force), force


def answered(gains: Rows, a: Components, force: Components) -> Components:
    """Rates or accelerations a, with what pushes along the directions add: a + Σ_k λ_k ∇ψ·d_k."""
    return a + gains @ force


def held_field(
    system: ComponentSystem, t: Array, x: Components, mode: Components, f: Components
) -> tuple[Components, Components]:
    """The field f of a mode at (t, x) with the reactions of the surfaces that it rests on, and
    their sizes λ, positive where they push away; without a rest f as it was, and 0."""
    sides, rests = sides_of(mode), rests_of(mode)
    c = constraints(system, t, x, sides)
    force = multipliers(c.gains, accelerations(system, t, x, sides, f), rests)
    held = where(any_of(rests), c.directions.added(f, force), f)
    return held, sides * force


def reaction_scale(
    system: ComponentSystem, t: Array, x: Components, mode: Components
) -> Components:
    """The size of the terms that the reactions of a mode are made of, m components."""
    c = constraints(system, t, x, sides_of(mode))
    f = system.field(t, x, sides_of(mode))
    own = c.gains.diagonal()
    return abs(c.gradients) @ abs(f) / where(own > 0, own, 1)


def rests_of(mode: Components) -> Components:
    """The surfaces that a mode rests on: ±2, by the side it is on."""
    return abs(mode) == 2


def beside(mode: Components) -> Components:
    """The mode that does not rest where this one does: ±1 in place of ±2."""
    return where(rests_of(mode), 0.5 * mode, mode)


def sides_of(mode: Components) -> Components:
    """The sides of a mode, + where it slides: rates of constraints do not depend on that."""
    return side_of(mode)


def pressed(
    gains: Rows, a: Components, sides: Components, candidates: Components
) -> tuple[Components, Array]:
    """Which of the surfaces at rest stay so, and whether that is consistent: λ_j pushes away from
    each surface that holds, and a_j leads away from each that does not.

    Surfaces that would have to pull, or need not push, let go, all of them at once, until none
    would.
    """
    gains, a, sides = stop_gradient((gains, a, sides))
    m = a.size

    def let_go(on: Components) -> Components:
        return on & (sides * multipliers(gains, a, on) > 0)

    def next_round(rounds: tuple[Components, Components]) -> tuple[Components, Components]:
        return rounds[1], let_go(rounds[1])

    if m == 1:
        on = let_go(candidates)
    else:
        start = candidates, let_go(candidates)
        _, on = jax.lax.while_loop(lambda v: any_of(v[0] & ~v[1]), next_round, start)
    left = answered(gains, a, multipliers(gains, a, on))
    return on, ~any_of(candidates & ~on & ~(sides * left >= 0))
