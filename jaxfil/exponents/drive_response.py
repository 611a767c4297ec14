"""The system of a drive and a response coupled to it, with twice as many states and surfaces."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.model import check
from jaxfil.model.clock import Clocks
from jaxfil.model.system import System, field_of
from jaxfil.model.types import Scalar
from jaxfil.xla.select import select


def _halves(x: Array) -> tuple[Array, Array]:
    n = x.shape[0] // 2
    return x[:n], x[n:]


class _DriveResponse(System):
    """A drive x and a response y, z = (x, y), each (n,). Surfaces 0 to m − 1 belong to the drive, m
    to 2m − 1 to the response."""

    system: System
    coupling: Array

    @property
    def slides(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.slides

    def vector_field(self, t: Array, x: Array, side: Array, reaction: Array | None = None) -> Array:
        drive, response = _halves(x)
        scalar = jnp.ndim(self.system.switching(t, drive)) == 0
        sides = (side[0], side[1]) if scalar else _halves(side)
        reaction = jnp.zeros_like(side) if reaction is None else reaction
        forces = (reaction[0], reaction[1]) if scalar else _halves(reaction)
        # The response uses its own state and side everywhere; with the drive's in one term it would
        # synchronise at every coupling.
        pull = self.coupling * (drive - response)
        first = field_of(self.system, t, drive, sides[0], forces[0])
        second = field_of(self.system, t, response, sides[1], forces[1])
        return jnp.concatenate([first, second + pull])

    @property
    def feels_reactions(self) -> bool:
        return self.system.feels_reactions

    def switching(self, t: Array, x: Array) -> Array:
        return jnp.concatenate(
            [jnp.atleast_1d(self.system.switching(t, half)) for half in _halves(x)]
        )

    def reset(self, t: Array, x: Array, surface: Array) -> Array:
        # Surfaces 0 … m − 1 belong to the drive, m … 2m − 1 to the response; an impact of one does
        # not move the other.
        drive, response = _halves(x)
        m = jnp.size(self.system.switching(t, drive))
        own = surface % m
        return select(
            surface < m,
            jnp.concatenate([self.system.reset(t, drive, own), response]),
            jnp.concatenate([drive, self.system.reset(t, response, own)]),
        )

    @property
    def resets(self) -> bool:
        return self.system.resets

    def tick(self, t: Array, x: Array, clock: Array) -> Array:
        return jnp.concatenate([self.system.tick(t, half, clock) for half in _halves(x)])

    @property
    def ticks(self) -> bool:
        return self.system.ticks

    @property
    def period(self) -> Array | float | None:
        return self.system.period

    @property
    def clocks(self) -> Clocks:
        return self.system.clocks


def drive_response(system: System, coupling: Scalar) -> System:
    """A system of 2n states z = (x, y), a drive and a response that is coupled to it.

        ẋ = F(t, x),    ẏ = F(t, y) + coupling · (x − y)

    Each half has the m surfaces of `system`, the drive's first, and slides on one or both; each has
    its impacts. A synchronised state x = y stays so exactly.

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
