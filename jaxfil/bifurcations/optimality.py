"""The equations of the tangency that is nearest to given parameters.

A defining system r(u) = 0 with k free parameters p, the last of its unknowns u, and a metric G give
the Lagrange equations, with all derivatives for Newton's method:

    G(p − p₀) + (∂r/∂p)ᵀ λ = 0,   (∂r/∂z)ᵀ λ = 0,   r(u) = 0,   u = (z, p)

p₀ are the parameters of the system itself. Newton's matrix has the second derivatives of r, exact
through every contact. The search starts with λ = 0 and without them, so that the first step is
the projection on the linearised set.

Source: J. Nocedal, S. J. Wright, Numerical Optimization (2006), chapters 16 and 18.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfil.bifurcations.defining_system import DefiningSystem, scales
from jaxfil.model.parameter import get_parameter
from jaxfil.model.system import System
from jaxfil.orbits.implicit import Equations, SystemOf
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.xla.kernel import kernel_if_it_fits
from jaxfil.xla.select import select


class AtPoint(eqx.Module):
    """The defining system at a point, and whether the distance would be a minimum there."""

    defining: Evaluation
    convex: Bool[Array, ""]


class Nearest(Equations):
    """The Lagrange equations for the smallest distance. Unknowns are the unknowns of the defining
    system, and a multiplier for each of its equations."""

    defining: DefiningSystem
    metric: Float[Array, "k k"] | None

    def distance(self, system: System, p: Float[Array, " k"]) -> Float[Array, ""]:
        """√((p − p₀)ᵀ G (p − p₀))."""
        given, metric = self._from(system)
        square = (p - given) @ metric @ (p - given)
        # At zero the root has no derivative; the distance has a kink there, with a slope set to 0.
        return select(square > 0, jnp.sqrt(select(square > 0, square, 1)), 0)

    def solve(self, system: System, guess: Array) -> tuple[Array, Array, Root]:
        """Newton's iteration; the further data of its `Root` is an `AtPoint`."""
        root = newton(lambda w: self.evaluate(system, w), guess, self.defining.newton_steps)
        return root.z, root.at.jacobian, root

    def evaluate(self, system: System, w: Array) -> Evaluation:
        """Residual and Jacobian at w = (u, λ)."""
        given, metric = self._from(system)
        k = given.shape[0]
        size = (w.shape[0] - 1 + k) // 2
        u, multipliers = w[:size], w[size:]

        def first(u: Array) -> tuple[Array, tuple]:
            slopes, (value, closing) = jax.jacfwd(residual, has_aux=True)(u)
            return slopes, (slopes, value, closing)

        def residual(u: Array) -> tuple[Array, tuple]:
            value, closing = self.defining.residual(system, u)
            return value, (value, closing)

        bends, (slopes, value, closing) = kernel_if_it_fits(_by_turns(first))(u)
        placed = self.defining.placed(system, u)
        equations, unknowns = scales(placed, u, slopes, closing, self.defining.family)
        at = Evaluation(value, slopes, equations, unknowns, closing.result, closing)
        flat = jnp.zeros((size, size), w.dtype).at[-k:, -k:].set(metric)
        curved = flat + jnp.einsum("i,ijk->jk", multipliers, bends)
        stationary = multipliers @ slopes + _padded(metric @ (u[-k:] - given), size)
        # Multipliers are scaled by their factors, and all of it by the distance of points whose
        # parameters differ by their own size.
        reach = jnp.max(jnp.diag(metric) * unknowns[-k:] ** 2)
        reach = jnp.maximum(reach, jnp.max(abs(multipliers) * equations))
        matrix = _saddle(curved, slopes)
        scale = jnp.append(unknowns / jnp.sqrt(reach), jnp.sqrt(reach) / equations)
        convex = _is_minimum(matrix, scale, value.shape[0])
        # Far from the set the curvature may suggest a maximum; a step is then the projection.
        matrix = select(convex, matrix, _saddle(flat, slopes))
        return Evaluation(
            residual=jnp.append(stationary, value),
            jacobian=matrix,
            equation_scale=jnp.append(reach / unknowns, equations),
            unknown_scale=jnp.append(unknowns, reach / equations),
            result=closing.result,
            aux=AtPoint(at, convex),
        )

    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """Derivatives by forward mode over forward mode."""
        k = len(self.defining.free)
        size = (z.shape[0] - 1 + k) // 2
        u, multipliers = z[:size], z[size:]

        def equations(theta: Array) -> tuple[Array, None]:
            system = system_of(theta)
            given, metric = self._from(system)

            def residual(u: Array) -> tuple[Array, Array]:
                value = self.defining.residual(system, u)[0]
                return value, value

            slopes, value = jax.jacfwd(residual, has_aux=True)(u)
            pull = _padded(metric @ (u[-k:] - given), size)
            return jnp.append(multipliers @ slopes + pull, value), None

        return kernel_if_it_fits(_by_turns(equations))(theta)[0]

    def _from(self, system: System) -> tuple[Array, Array]:
        """p₀ and G."""
        values = [jnp.asarray(get_parameter(system, name)) for name in self.defining.free]
        given = jnp.stack(values)
        if self.metric is not None:
            return given, self.metric
        return given, jnp.diag(1 / select(given == 0, 1, given) ** 2)


def _by_turns(function: Callable[[Array], tuple[Array, Any]]) -> Callable:
    """`jax.jacfwd` of a function with auxiliary data, one direction after the other. A second
    derivative in all directions at once takes half as long again to compile."""

    def call(x: Array) -> tuple[Array, Any]:
        def along(v: Array) -> tuple:
            _, slope, more = jax.jvp(function, (x,), (v,), has_aux=True)
            return slope, more

        slopes, more = jax.lax.map(along, jnp.eye(x.shape[0], dtype=x.dtype))
        return jnp.moveaxis(slopes, 0, -1), jax.tree.map(lambda v: v[0], more)

    return call


def _padded(by_p: Array, size: int) -> Array:
    return jnp.concatenate([jnp.zeros(size - by_p.shape[0], by_p.dtype), by_p])


def _saddle(curved: Array, slopes: Array) -> Array:
    """[[W, Jᵀ], [J, 0]]."""
    rows = slopes.shape[0]
    return jnp.block([[curved, slopes.T], [slopes, jnp.zeros((rows, rows), slopes.dtype)]])


def _is_minimum(matrix: Array, scale: Array, count: int) -> Array:
    """Whether W is positive on the null space of J: the matrix then has as many negative
    eigenvalues as J has rows."""
    scaled = scale[:, None] * matrix * scale
    sound = jnp.all(jnp.isfinite(scaled))
    values = jnp.linalg.eigvalsh(select(sound, scaled, jnp.eye(scaled.shape[0])))
    return sound & (jnp.sum(values < 0) == count)
