"""A system twice: a drive, and a response that is pulled towards it.

A system and a coupling enter; a system of twice as many states and surfaces leaves.
"""

import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.model import check
from jaxfil.model.system import System, has_resets


def _halves(x: Array) -> tuple[Array, Array]:
    n = x.shape[0] // 2
    return x[:n], x[n:]


class _DriveResponse(System):
    system: System
    coupling: Array

    @property
    def slides(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.slides

    def vector_field(self, t, x, side):
        drive, response = _halves(x)
        scalar = jnp.ndim(self.system.switching(t, drive)) == 0
        sides = (side[0], side[1]) if scalar else _halves(side)
        pull = self.coupling * (drive - response)
        first = self.system.vector_field(t, drive, sides[0])
        return jnp.concatenate([first, self.system.vector_field(t, response, sides[1]) + pull])

    def switching(self, t, x):
        return jnp.concatenate(
            [jnp.atleast_1d(self.system.switching(t, half)) for half in _halves(x)]
        )

    @property
    def period(self):
        return self.system.period


class _ImpactingDriveResponse(_DriveResponse):
    def reset(self, t, x, surface):
        drive, response = _halves(x)
        m = jnp.size(self.system.switching(t, drive))
        own = surface % m
        return jnp.where(
            surface < m,
            jnp.concatenate([self.system.reset(t, drive, own), response]),
            jnp.concatenate([drive, self.system.reset(t, response, own)]),
        )


def drive_response(system: System, coupling: Array | float) -> System:
    """The system z = (x, y) of 2n states: ẋ = F(t, x), ẏ = F(t, y) + coupling·(x − y).

    Each half has the m surfaces of `system`, the drive's first, and slides on one or both; each has
    its impacts. A synchronised state x = y stays so exactly.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> pair = jf.drive_response(jf.systems.CoulombOscillator(), 0.3)
    >>> sol = jf.solve(pair, jnp.array([3.0, 0.0, 2.5, 0.0]), 0.0, 20.0, 0.1)
    >>> sol.modes[-1].tolist()
    [0, 0]
    """
    check.system("system", system)
    coupling = jnp.asarray(coupling)
    return (_ImpactingDriveResponse if has_resets(system) else _DriveResponse)(system, coupling)
