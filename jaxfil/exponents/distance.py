"""Distances between a drive and its response, and the size of a state."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.system.components import Components
from jaxfil.model.system import System
from jaxfil.xla.select import select

# Number of directions, each with its opposite, in one of which a response starts beside walls, and
# the multiple of rounding within which a state is on a wall.
_DIRECTIONS, _HERE = 8, 64


def distance_in(z: Components, unit: Array) -> Array:
    """The distance of drive and response in a `unit` like it, since the square of a small one would
    underflow."""
    if z.is_array:
        return jnp.sqrt(jnp.sum(jnp.square(jnp.subtract(*jnp.split(z.parts[0], 2)) / unit)))
    n = len(z.parts) // 2
    pairs = zip(z.parts[:n], z.parts[n:], strict=True)
    return jnp.sqrt(sum(((a - b) / unit) ** 2 for a, b in pairs))


def size_of(x: Array) -> Array:
    """|x|, also where its square would underflow."""
    largest = jnp.max(abs(x))
    return largest * jnp.sqrt(jnp.sum(jnp.square(x / select(largest > 0, largest, 1.0))))


def or_one(size: Array) -> Array:
    """A size, or 1 if distances much smaller than it would underflow."""
    known = jnp.finfo(size.dtype)
    return select(size > float(known.tiny) / float(known.eps), size, 1.0)


def away(system: System, t: Array, x: Array, distance: Array) -> Array:
    """A state at a distance from x, in a generic direction. Next to walls this is the first of
    several directions that does not lead behind one."""
    # A direction along an axis may be special to the system, such as the direction of the flow.
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, x.shape[0]))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    states = x + distance * jnp.asarray(np.concatenate([directions, -directions]), x.dtype)
    if not system.resets:
        return states[0]

    def surfaces(x: Array) -> Array:
        return jnp.atleast_1d(system.switching(t, x))

    # A motion is where H ≥ 0, and a state on a wall has H = 0 up to rounding.
    rounding = _HERE * jnp.finfo(x.dtype).eps * or_one(size_of(x))
    fine = (jax.vmap(surfaces)(states) >= 0) | (surfaces(x) < -rounding)
    return states[jnp.argmax(jnp.all(fine, axis=1))]
