"""Detection of orbits behind a wall, which no motion reaches.

Newton's method does not distinguish the sides of a wall, and may converge to such an orbit.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfil.integrate.surfaces import unilateral
from jaxfil.integrate.system.lowered import build
from jaxfil.model.system import System


def is_behind(
    system: System, t: Float[Array, ""], x: Float[Array, " n"], mode: Int[Array, " m"]
) -> Bool[Array, ""]:
    """Whether some surface that bounds H ≥ 0 has H < 0."""
    if not system.resets:
        return jnp.zeros((), bool)
    on_components = build(system, x, compact=True)
    far = on_components.of_surfaces(-jnp.ones(mode.shape, x.dtype))
    here = t, on_components.unpack(x)
    found = unilateral.constraints(on_components, *here, far)
    _, _, normals = on_components.gradients(*here)
    effect = unilateral.reset_effect(on_components, *here, found, normals)
    bounds = jnp.stack([jnp.asarray(v) for v in effect.throws_back.parts])
    return jnp.any((mode < 0) & jnp.reshape(bounds, mode.shape))
