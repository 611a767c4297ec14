"""`Approach`: the motion across the sliding surfaces of a pseudo-equilibrium, near it.

There dH/dt is a constant on each combination of sides, with a sliding motion between some. On one
surface its signs decide whether the sides attract. On two, motions slide on the half-axes of the
plane of (H_1, H_2), or turn about its origin, which multiplies their distance by a constant for
each turn. On more the decision is that of the smoothed system.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfil.xla.select import select

# The quadrants of two surfaces in the order of a turn.
QUADRANTS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


class Approach(eqx.Module):
    """Rates across the sliding surfaces."""

    slid: Bool[Array, " m"]
    """The sliding surfaces."""
    response: Float[Array, "m m"]
    """The inverse of ∂(dH/dt)/∂w of the sliding surfaces, −1 for others."""
    speeds: Float[Array, "4 2"] | None
    """dH/dt of the first two sliding surfaces on `QUADRANTS`; None for a single surface."""

    @property
    def sound(self) -> Bool[Array, ""]:
        """Whether all numbers are finite."""
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(self)]))

    def repelling(self) -> Int[Array, ""]:
        """The number of directions in which the motion leaves the surfaces; zero if it reaches
        them in a finite time from everywhere. It does not depend on the units of H."""
        if not self.slid.size:
            return jnp.zeros((), int)
        # In the unit of each H in which its largest response is 1.
        size = jnp.max(abs(self.response), axis=0)
        scaled = self.response / select(size > 0, size, jnp.ones_like(size))
        count = jnp.sum(jnp.real(jnp.linalg.eigvals(scaled)) > 0)
        if self.speeds is None:
            return count
        # A saddle has one, and its determinant is negative: −1 of each other surface is positive.
        saddle = jnp.linalg.det(-scaled) < 0
        of_two = select(attracts(self.speeds), 0, select(saddle, 1, 2))
        return select(jnp.sum(self.slid) == 2, of_two, count)


def attracts(speeds: Float[Array, "4 2"]) -> Bool[Array, ""]:
    """Whether motions with a constant velocity in each of `QUADRANTS` reach the origin in a finite
    time from everywhere.

    They do unless a velocity leads away from the origin in a whole quadrant, or along a half-axis
    on which motions slide, or they turn about it further away each time."""
    # Along the half-axes at which a turn enters and leaves each quadrant, away from the origin.
    u, v = speeds[:, 0], speeds[:, 1]
    enters = jnp.stack([u[0], v[1], -u[2], -v[3]])
    leaves = jnp.stack([v[0], -u[1], -v[2], u[3]])
    away = (enters >= 0) & (leaves >= 0)
    # Across a half-axis with the turn, in the quadrants before and after it, and along it.
    before, after = -enters, jnp.roll(leaves, -1)
    slides = before * after < 0
    closing = select(slides, before - after, jnp.ones_like(u))
    along = (before * jnp.roll(enters, -1) - after * leaves) / closing
    turns = jnp.all(before > 0) & jnp.all(leaves > 0)
    turns_back = jnp.all(before < 0) & jnp.all(leaves < 0)
    grows, shrinks = jnp.prod(abs(leaves)), jnp.prod(abs(enters))
    further = (turns & (grows >= shrinks)) | (turns_back & (grows <= shrinks))
    return ~(jnp.any(away) | jnp.any(slides & (along >= 0)) | further)
