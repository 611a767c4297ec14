"""`grazing_margin`: how far an orbit stays from a surface, as a function of all parameters.

A system and an orbit close to its own enter; a number leaves, positive while the orbit stays clear
of the surface and zero where it grazes, with derivatives with respect to every parameter.
"""

import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from jaxfil.bifurcations.locate import Problem, defining_problem, guesses
from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast, is_parameter
from jaxfil.model.system import System
from jaxfil.orbits.newton import Evaluation, newton
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.kernel import kernel_if_it_fits

_NEWTON_STEPS = 40


def grazing_margin(system: System, orbit: Orbit) -> Float[Array, ""]:
    """The smallest |H| of the flight on which `orbit` comes closest to grazing, signed.

    The flight is followed as if the surface were not there, so that the margin goes on smoothly
    through zero into negative values, where the orbit would cut the surface. `orbit` is one of
    `system` at parameters close by: it says which flight is meant, and is where Newton's method
    starts. NaN where that finds no orbit, or where no flight approaches a surface.

    Differentiable with respect to every float leaf of `system`, forward and reverse; `jit` and
    `vmap` over the system work.

    >>> import jax, jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system = jf.systems.SDOscillator(omega=0.8)
    >>> orbit = jf.periodic_orbit(system, jnp.array([1.7, 0.0]))
    >>> slope = jax.grad(lambda s: jf.grazing_margin(s, orbit))(system)
    >>> print(round(float(jf.grazing_margin(system, orbit)), 6), round(float(slope.f0), 4))
    0.306915 -2.7723
    """
    check.system("system", system)
    if not isinstance(orbit, Orbit) or orbit.x0.ndim != 1:
        raise ValueError(f"`orbit` must be a single Orbit, got {orbit!r}.")
    if isinstance(orbit.x0, jax.core.Tracer):
        raise ValueError("`orbit` must be known numbers, got a traced Orbit: find it outside.")
    # The orbit's numbers are looked at, also while the system is being traced.
    with jax.core.eval_context():
        tangency, missing = guesses(orbit, "grazing")[0]
    system = cast(system, orbit.x0.dtype)
    theta, unravel = ravel_pytree(eqx.filter(system, is_parameter))
    problem = defining_problem(system, orbit, tangency, "flight", ())
    phase = orbit.period if system.period is None else tangency.phase
    z = jnp.append(tangency.x, phase)
    rest = eqx.filter(system, is_parameter, inverse=True)
    problem = eqx.tree_at(lambda p: p.system, problem, rest, is_leaf=lambda v: v is None)
    margin = _margin(theta, problem=problem, unravel=unravel, z=stop_gradient(z))
    return jnp.where(missing, jnp.nan, margin)


def _evaluation(problem: Problem, z: Array) -> Evaluation:
    """Closing and Ḣ = 0: where the guard is smallest, whatever its value there."""
    jacobian, (value, closing) = kernel_if_it_fits(jax.jacfwd(problem.residual, has_aux=True))(z)
    equations, unknowns = problem.scales(z, closing)
    n = z.shape[0] - 1
    keep = jnp.array([*range(n), n + 1])
    return Evaluation(
        value[keep], jacobian[keep], equations[keep], unknowns, closing.result, value[n]
    )


@eqx.filter_custom_jvp
def _margin(theta, *, problem, unravel, z):
    return _solved(theta, problem, unravel, z)[0]


@eqx.filter_jit
def _solved(theta, problem, unravel, z) -> tuple[Array, Array]:
    problem = _with(problem, unravel, theta)
    root = newton(ft.partial(_evaluation, problem), z, _NEWTON_STEPS)
    margin = jnp.where(root.result == RESULTS.successful, root.at.aux, jnp.nan)
    return margin, root.z


def _with(problem: Problem, unravel: Any, theta: Array) -> Problem:
    return eqx.tree_at(lambda p: p.system, problem, eqx.combine(unravel(theta), problem.system))


@_margin.def_jvp
def _margin_jvp(primals, tangents, *, problem, unravel, z):
    (theta,) = primals
    margin, z = _solved(theta, problem, unravel, z)
    if tangents[0] is None:
        return margin, jnp.zeros_like(margin)
    return margin, _slope(theta, problem, unravel, z) @ tangents[0]


# Compiled: a search by gradient that is not, calls it again and again.
@eqx.filter_jit
def _slope(theta: Array, problem: Problem, unravel: Any, z: Array) -> Array:
    """The derivative of the margin by all parameters, that of the implicit function."""
    n = z.shape[0] - 1

    def both(v: Array) -> Array:
        return _with(problem, unravel, v[n + 1 :]).residual(v[: n + 1])[0]

    matrix = kernel_if_it_fits(jax.jacfwd(both))(jnp.concatenate([z, theta]))
    keep = jnp.array([*range(n), n + 1])
    moved = -jnp.linalg.solve(matrix[keep, : n + 1], matrix[keep, n + 1 :])
    return matrix[n, n + 1 :] + matrix[n, : n + 1] @ moved
