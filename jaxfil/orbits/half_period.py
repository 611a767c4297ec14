"""Detection of orbits that run twice through an orbit of half the period.

On a branch of doubled period the change of the state over half the period changes its sign where
the branch joins the branch of half the period, its parent. Beyond, the same orbits repeat, shifted
by half a period.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.model.system import System
from jaxfil.orbits.closing import OrbitProblem
from jaxfil.orbits.shooting import ShootingOptions, Shot, flow_map
from jaxfil.xla.known import array_of


def may_be_doubled(problem: OrbitProblem) -> bool:
    """Whether half the period of an orbit may be a period too; for a forced system it must be an
    integer number of forcing periods."""
    return problem.autonomous or problem.periods % 2 == 0


def half_gap(problem: OrbitProblem, u: np.ndarray, shot: Shot) -> np.ndarray:
    """x(t0 + T/2) − x(t0) on an orbit, each component relative to its scale there."""
    m, n = np.shape(shot.ends)
    starts, size = u[: m * n].reshape(m, n), np.asarray(shot.size)
    if m % 2 == 0:
        return (starts[m // 2] - starts[0]) / size
    system, period = problem.setting(array_of(u[m * n :]))
    half = _half_way(system, problem.options, array_of(starts[0]), period)
    return (np.asarray(half) - starts[0]) / size


@eqx.filter_jit
def _half_way(system: System, options: ShootingOptions, x0: Array, period: Array) -> Array:
    forward = flow_map(lambda q: (system, period), options, jnp.zeros(0, x0.dtype), 0.5)
    return forward(x0, jnp.zeros((), x0.dtype))
