"""The solution of equations that depend on a system's parameters, and its derivative.

For equations r(z; θ) = 0 and a system whose float leaves are θ, the derivative of the solution z is
dz/dθ = −(∂r/∂z)⁻¹ ∂r/∂θ, forward and reverse. With S = dz/dθ, the derivative of S along any
direction is −(∂r/∂z)⁻¹ (d(∂r/∂θ) + d(∂r/∂z) S), along θ and z.

`jax.lax.custom_root` has the same rule but differentiates r along one tangent of θ, which reverse
mode would have to transpose, through an integrator's loop that only has forward derivatives. Here
the whole matrix dz/dθ is formed by forward mode; its product with a tangent can be transposed.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from jaxfil.model.parameter import is_parameter
from jaxfil.model.system import System
from jaxfil.orbits.newton import solve_in_numpy
from jaxfil.xla.known import compiled_if_traced, is_known, without_derivatives
from jaxfil.xla.masked_product import masked_product, masked_row_product
from jaxfil.xla.select import select, select_all

SystemOf = Callable[[Array], System]
"""The system for the vector θ of all its float leaves."""


class Equations(eqx.Module):
    """Equations r(z; θ) = 0 for N unknowns, and their solver. If all inputs are known (`is_known`)
    both methods are called outside of every transformation, and compile their programs in
    pieces."""

    @abc.abstractmethod
    def solve(self, system: System, guess: Array) -> tuple[Array, Array, Any]:
        """The solution z, shape (N,), ∂r/∂z there, shape (N, N), and further data."""

    @abc.abstractmethod
    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """∂r/∂θ, shape (N, p)."""

    def by_unknowns(self, system_of: SystemOf, theta: Array, z: Array) -> Array | None:
        """∂r/∂z, shape (N, N), as a function of θ and z up to a constant, for second derivatives of
        the solution. None: these are NaN."""
        return None


class _SystemOf(eqx.Module):
    """A system without its float leaves, and their slices of one vector."""

    rest: System
    unravel: Callable[[Array], System] = eqx.field(static=True)

    def __call__(self, theta: Array) -> System:
        return eqx.combine(self.unravel(theta), self.rest)

    def of_known(self, theta: Array) -> System:
        """The same, sliced in NumPy, because as a program each leaf would be compiled."""
        shapes, tree = jax.tree.flatten(eqx.filter_eval_shape(self.unravel, theta))
        rest, leaves = np.asarray(theta), []
        for v in shapes:
            leaves.append(rest[: v.size].reshape(v.shape))
            rest = rest[v.size :]
        return eqx.combine(jax.tree.unflatten(tree, jax.device_put(leaves)), self.rest)


def solve_implicit(
    equations: Equations, system: System, guess: Float[Array, " N"]
) -> tuple[Float[Array, " M"], Any]:
    """The solution near a guess, and further data. The solution has derivatives with respect to the
    float leaves of the system; all other derivatives are NaN."""
    theta, unravel = ravel_pytree(eqx.filter(system, is_parameter))
    system_of = _SystemOf(eqx.filter(system, is_parameter, inverse=True), unravel)
    if not is_known((equations, guess)):
        equations, guess = without_derivatives((equations, guess))
    z, _, more = _solution(theta, equations=equations, system_of=system_of, guess=guess)
    return z, more


@compiled_if_traced
def _solve(theta: Array, equations: Equations, system_of: _SystemOf, guess: Array) -> tuple:
    known = is_known((theta, system_of))
    return equations.solve(system_of.of_known(theta) if known else system_of(theta), guess)


@compiled_if_traced
def _sensitivity(
    theta: Array, equations: Equations, system_of: _SystemOf, z: Array, by_z: Array
) -> Array:
    by_theta = equations.by_parameters(system_of, theta, z)
    if is_known((by_z, by_theta)):
        return jax.device_put(-solve_in_numpy(np.asarray(by_z), np.asarray(by_theta)))
    return -jnp.linalg.solve(by_z, by_theta)


@eqx.filter_custom_jvp
def _slopes(
    theta: Array, z: Array, *, equations: Equations, system_of: _SystemOf, by_z: Array
) -> Array:
    """S = dz/dθ, given ∂r/∂z; only its derivative needs the derivatives of ∂r/∂θ and ∂r/∂z."""
    return _sensitivity(theta, equations, system_of, z, by_z)


@_slopes.def_jvp
def _slopes_jvp(
    primals: tuple,
    tangents: tuple,
    *,
    equations: Equations,
    system_of: _SystemOf,
    by_z: Array,
) -> tuple[Array, Array]:
    slopes = _slopes(*primals, equations=equations, system_of=system_of, by_z=by_z)
    moves = tuple(
        jnp.zeros_like(v) if d is None else d for v, d in zip(primals, tangents, strict=True)
    )

    def matrices(theta: Array, z: Array) -> tuple[Array, Array | None]:
        by_theta = equations.by_parameters(system_of, theta, z)
        return by_theta, equations.by_unknowns(system_of, theta, z)

    _, (by_theta, turned) = jax.jvp(matrices, primals, moves)
    if turned is None:
        return slopes, jnp.full_like(slopes, jnp.nan)
    # Of a solution without slopes, such as one that is not isolated, a cotangent of zero must leave
    # other cotangents alone. Its NaN is therefore multiplied last, and the numbers before are safe.
    lost = ~jnp.all(jnp.isfinite(slopes))
    matrix, safe = select_all(
        lost, (jnp.eye(len(by_z), dtype=by_z.dtype), jnp.zeros_like(slopes)), (by_z, slopes)
    )
    moved = -jnp.linalg.solve(matrix, by_theta + turned @ safe)
    none = select(lost, jnp.full_like(slopes, jnp.nan), jnp.ones_like(slopes))
    return slopes, masked_product(none, moved)


@eqx.filter_custom_jvp
def _solution(theta: Array, *, equations: Equations, system_of: _SystemOf, guess: Array) -> tuple:
    return _solve(theta, equations, system_of, guess)


@_solution.def_jvp
def _solution_jvp(
    primals: tuple, tangents: tuple, *, equations: Equations, system_of: _SystemOf, guess: Array
) -> tuple[tuple, tuple]:
    (theta,), (direction,) = primals, tangents
    z, by_z, more = _solution(theta, equations=equations, system_of=system_of, guess=guess)
    # A NaN exposes an undefined derivative; a zero would not.
    none = jax.tree.map(
        lambda v: np.full(v.shape, np.nan, v.dtype) if eqx.is_inexact_array(v) else None,
        (by_z, more),
    )
    if direction is None:
        return (z, by_z, more), (jnp.zeros_like(z), *none)
    known = {"equations": equations, "system_of": system_of, "by_z": stop_gradient(by_z)}
    slopes = _slopes(theta, z, **known)
    return (z, by_z, more), (masked_row_product(direction, slopes.T), *none)
