"""The system of a drive and a response coupled to it, with twice as many states and surfaces."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.model import check
from jaxfil.model.system import System, field_of
from jaxfil.model.types import Scalar
from jaxfil.model.wrapped import Wrapped
from jaxfil.xla.select import select


class _DriveResponse(Wrapped):
    """A drive x and a response y, z = (x, y), each (n,). Surfaces 0 to m − 1 belong to the drive, m
    to 2m − 1 to the response."""

    coupling: Array

    def vector_field(self, t: Array, x: Array, side: Array, reaction: Array | None = None) -> Array:
        drive, response = jnp.split(x, 2)
        scalar = jnp.ndim(self.system.switching(t, drive)) == 0
        sides = (side[0], side[1]) if scalar else jnp.split(side, 2)
        reaction = jnp.zeros_like(side) if reaction is None else reaction
        forces = (reaction[0], reaction[1]) if scalar else jnp.split(reaction, 2)
        # Each half uses its own state and side. A term with the drive's in both would synchronise
        # them at every coupling.
        pull = self.coupling * (drive - response)
        first = field_of(self.system, t, drive, sides[0], forces[0])
        second = field_of(self.system, t, response, sides[1], forces[1])
        return jnp.concatenate([first, second + pull])

    def switching(self, t: Array, x: Array) -> Array:
        return jnp.concatenate(
            [jnp.atleast_1d(self.system.switching(t, half)) for half in jnp.split(x, 2)]
        )

    def reset(self, t: Array, x: Array, surface: Array) -> Array:
        # An impact of one half does not move the other.
        drive, response = jnp.split(x, 2)
        m = jnp.size(self.system.switching(t, drive))
        own = surface % m
        return select(
            surface < m,
            jnp.concatenate([self.system.reset(t, drive, own), response]),
            jnp.concatenate([drive, self.system.reset(t, response, own)]),
        )

    def tick(self, t: Array, x: Array, clock: Array) -> Array:
        return jnp.concatenate([self.system.tick(t, half, clock) for half in jnp.split(x, 2)])


def drive_response(system: System, coupling: Scalar) -> System:
    """A system of 2n states z = (x, y), a drive and a response that is coupled to it.

        ẋ = F(t, x),    ẏ = F(t, y) + coupling · (x − y)

    The new system has 2m surfaces, the drive's first. Each half slides and has impacts on its own
    surfaces. A synchronised state x = y stays exactly synchronised.

    **Arguments**

    - `system`: any `System`; its parameters are called `system.name` in the new one.
    - `coupling`: the coupling rate, per unit of time; a parameter of the new system.

    **Returns** a `System` with the period and the clocks of `system`.

    **Source**: A. Stefański and T. Kapitaniak, Using chaos synchronization to estimate the largest
    Lyapunov exponent of nonsmooth systems, Discrete Dynamics in Nature and Society 4 (2000)
    207–215.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> pair = jf.drive_response(jf.systems.CoulombOscillator(), 0.3)
    >>> sol = jf.solve(pair, jnp.array([3.0, 0.0, 2.5, 0.0]), 0.0, 20.0, 0.1)
    >>> sol.modes[-1].tolist()
    [0, 0]
    """
    check.system("system", system)
    return _DriveResponse(system, jnp.asarray(check.leaf("coupling", coupling)))
