"""The defining system of a tangency: an orbit that closes, and two conditions where it is tangent.

A system and a guess of (state, phase of the tangency or period, free parameters) enter; how far the
equations are from holding leaves, with all derivatives. With one free parameter there are as many
equations as unknowns, with two they leave a curve free, with none they have one too many. Nothing
in them has the square root that grazing puts into the period map.
"""

import dataclasses
import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from jaxfil.bifurcations.tangency import SLIDE, Closing, Tangency, close, defining
from jaxfil.model.parameter import replace_parameters
from jaxfil.model.system import System
from jaxfil.orbits.implicit import Equations, SystemOf
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.shooting import ShootingOptions
from jaxfil.xla.kernel import kernel_if_it_fits


class DefiningSystem(Equations):
    """Unknowns z are the state at the start of the flight, the phase of the tangency (of an
    autonomous system the period), and the free parameters."""

    tangency: Tangency
    options: ShootingOptions
    periods: int | Array
    newton_steps: int | Array
    family: Int[Array, ""]
    free: tuple[str, ...] = eqx.field(static=True)

    def placed(self, system: System, z: Array) -> tuple[System, Array, Tangency]:
        """System, period and tangency for unknowns z."""
        n = self.tangency.x.shape[0]
        system = replace_parameters(system, self.free, z[n + 1 :])
        if system.period is None:
            return system, z[n], dataclasses.replace(self.tangency, x=z[:n])
        period = jnp.asarray(system.period) * self.periods
        return system, period, dataclasses.replace(self.tangency, x=z[:n], phase=z[n])

    def residual(self, system: System, z: Array) -> tuple[Float[Array, " M"], Closing]:
        """Closing and the two conditions."""
        system, period, tangency = self.placed(system, z)
        closing = close(system, period, self.options, self.family, tangency)
        pair = defining(system, self.family, closing.t, closing.x, tangency)
        return jnp.append(closing.gap, pair), stop_gradient(closing)

    def evaluate(self, system: System, z: Array) -> Evaluation:
        """Residual and Jacobian; what else is known is the `Closing`."""
        at = self.evaluate_with_slopes(lambda _: system, jnp.zeros((0,), z.dtype), z)
        return dataclasses.replace(at, aux=at.aux[0])

    def evaluate_with_slopes(self, system_of: SystemOf, theta: Array, z: Array) -> Evaluation:
        """Residual and Jacobian; what else is known is the `Closing`, and the derivative by θ."""
        count = z.shape[0]

        def residual(u: Array) -> tuple[Array, tuple]:
            value, closing = self.residual(system_of(u[count:]), u[:count])
            return value, (value, closing)

        # The directions share the flow: some more of them make the program no larger.
        u = jnp.concatenate([z, theta])
        slopes, (value, closing) = kernel_if_it_fits(jax.jacfwd(residual, has_aux=True))(u)
        by_z, by_theta = slopes[:, :count], slopes[:, count:]
        scales = self.scales(system_of(theta), z, closing)
        return Evaluation(value, by_z, *scales, closing.result, (closing, by_theta))

    def scales(self, system: System, z: Array, closing: Closing) -> tuple[Array, Array]:
        """Of the equations and of the unknowns."""
        n = self.tangency.x.shape[0]
        system, period, _ = self.placed(system, z)
        size = jnp.where(closing.size == 0, 1, closing.size)
        # H by how far it reaches across the orbit, its rates by that in a turn of the forcing.
        normals = jax.jacfwd(system.switching, argnums=1)(closing.t, closing.x)
        height = jnp.max(abs(jnp.atleast_2d(normals)) @ size)
        height = jnp.where(height == 0, 1, height)
        pace = 2 * jnp.pi / period
        pair = jnp.stack([height * pace, height * pace**2])
        pair = jnp.where(self.family == SLIDE, pair, pair / pace)
        q = abs(z[n:])
        return jnp.append(size, pair), jnp.append(size, jnp.where(q == 0, 1, q))

    def solve(
        self, system_of: SystemOf, theta: Array, guess: Array, slopes: bool
    ) -> tuple[Array, Array, None, Root]:
        """With one free parameter, by Newton's iteration."""
        root = newton(ft.partial(self.evaluate, system_of(theta)), guess, self.newton_steps)
        return root.z, root.at.jacobian, None, root

    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """By forward mode."""
        residual = lambda theta: self.residual(system_of(theta), z)[0]  # noqa: E731
        return kernel_if_it_fits(jax.jacfwd(residual))(theta)


def defining_system(
    system: System,
    orbit: Orbit,
    tangency: Tangency,
    family: int | Int[Array, ""],
    free: tuple[str, ...],
    newton_steps: int | Array,
) -> DefiningSystem:
    """The defining system of a tangency of an orbit of a forced or an autonomous system."""
    # A multiple of the forcing period that is an argument of the program, not a part of it.
    periods = 1
    if system.period is not None:
        periods = jnp.round(stop_gradient(orbit.period / jnp.asarray(orbit.system.period)))
    options = dataclasses.replace(orbit.options, arcs=1)
    family = jnp.asarray(family, jnp.int32)
    return DefiningSystem(stop_gradient(tangency), options, periods, newton_steps, family, free)
