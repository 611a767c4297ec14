"""Detection of orbits behind a wall, which no motion reaches.

Newton's method does not distinguish the sides of a wall, and may converge to such an orbit.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfil.integrate.contacts.beginning import thrown_at
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.run.solution import Events
from jaxfil.integrate.surfaces import unilateral
from jaxfil.integrate.system.components import pack
from jaxfil.xla.select import select


def is_behind(
    problem: Problem, x: Float[Array, " n"], mode: Int[Array, " m"], events: Events | None
) -> Bool[Array, ""]:
    """Whether an orbit lies where H < 0 behind a surface that throws back, given its first state
    and mode and its events.

    An orbit that is at H > 0 at some time has been let through, whatever the reset would do to its
    first state, far from the surface.
    """
    if not problem.system.resets:
        return jnp.zeros((), bool)
    thrown = thrown_at(problem, problem.system.unpack(x))
    slowly = _leaves_slowly(problem, x, thrown.constraints)
    behind = (mode < 0) & pack(thrown.back, bool) & slowly
    if events is not None:
        behind = behind & ~jnp.any(events.modes > 0, axis=0)
    return jnp.any(behind)


def _leaves_slowly(
    problem: Problem, x: Float[Array, " n"], c: unilateral.Constraints
) -> Bool[Array, " m"]:
    """Whether a motion that comes slowly to a surface leaves it slowly too.

    A switch that stops one of several flows has the derivative of a wall with e = 0, but leaves the
    rate of the other flows. Far from its surface `thrown_at` does not tell them apart.
    """
    system, t, eps = problem.system, problem.grid.t0, float(jnp.finfo(x.dtype).eps)
    above = system.for_each_surface(jnp.ones_like(t))

    def psi(x: Array) -> Array:
        return pack(unilateral.contact_rates(system, t, system.unpack(x), above), x.dtype)

    def of(j: Array, rate: Array, slope: Array, gain: Array) -> Array:
        square = slope @ slope
        depth = eps**0.5 * (abs(slope) @ abs(x) + abs(rate))
        slow = x - (rate + depth) / select(square == 0, 1, square) * slope
        after = pack(system.reset(t, system.unpack(slow), j), x.dtype)
        came, went = psi(slow)[j], psi(after)[j]
        # `slow` is one step of Newton's method away from x, and not exact on a curved surface.
        noise = eps**0.5 * (abs(slope) @ (abs(slow) + abs(after)))
        return abs(went) <= 2 * gain * abs(came) + noise

    rates, gains = pack(c.rate, x.dtype), pack(c.impulse.gains.diagonal(), x.dtype)
    rows = c.gradients.rows  # those of an array are one array
    slopes = jnp.stack([pack(v, x.dtype) for v in rows]).reshape(system.m, -1)
    numbers = jnp.arange(system.m, dtype=jnp.int32)
    return jax.vmap(of)(numbers, rates, slopes, gains)
