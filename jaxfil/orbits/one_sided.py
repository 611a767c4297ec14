"""Detection of orbits behind a wall, which no motion reaches.

Newton's method does not distinguish the sides of a wall, and may converge to such an orbit.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfil.integrate.contacts.beginning import thrown_at
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.run.solution import Events
from jaxfil.integrate.system.components import pack


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
    behind = (mode < 0) & pack(thrown.back, bool)
    if events is not None:
        behind = behind & ~jnp.any(events.modes > 0, axis=0)
    return jnp.any(behind)
