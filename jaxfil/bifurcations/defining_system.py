"""The defining system of a tangency: an orbit that closes, and two conditions where it is tangent.

Unknowns are the states at the starts of the arcs, the phase of the tangency or the period, and the
free parameters. With one
free parameter there are as many equations as unknowns; with two they define a curve; with no free
parameter there is one equation too many. The equations do not contain the square root of the period
map at grazing.
"""

import dataclasses
import functools as ft
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from jaxfil.bifurcations.closure import Closing, close
from jaxfil.bifurcations.tangency import SLIDE, Tangency, defining
from jaxfil.integrate.system.dependencies import constants_of
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import replace_parameters
from jaxfil.model.system import System
from jaxfil.orbits.affine import Affine, affine
from jaxfil.orbits.constant import rounding, unchanged
from jaxfil.orbits.implicit import Equations, SystemOf
from jaxfil.orbits.newton import Evaluation, Root, Stages, as_it_is, root_of
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.shooting import ShootingOptions
from jaxfil.xla.kernel import kernel_if_it_fits, tree_in_kernel
from jaxfil.xla.known import array_of, is_known
from jaxfil.xla.select import select
from jaxfil.xla.thresholds import CONVERGED, RESIDUAL


class Placed(eqx.Module):
    """The meaning of unknowns: the system, the period, the states at the starts of the arcs and the
    phase of the tangency."""

    system: System
    period: Array
    starts: Float[Array, "M n"]
    phase: Array


class Residual(eqx.Module):
    """The equations of a tangency."""

    tangency: Tangency
    options: ShootingOptions
    family: Int[Array, ""]
    still: Bool[Array, " n"] | None

    def tangency_at(self, at: Placed) -> Tangency:
        """The tangency at `at`. Its flight moves with it and always contains it."""
        known = self.tangency
        moved = at.phase - known.phase
        starts = at.starts
        if self.still is not None:
            # A step of Newton's method moves these by rounding.
            starts = starts - select(self.still, stop_gradient(starts - known.starts), 0)
        return dataclasses.replace(
            known,
            starts=starts,
            # A state at a phase that a tick passes would jump.
            node=known.node if at.system.clocks else known.node + moved,
            phase=at.phase,
            start=known.start + moved,
            stop=known.stop + moved,
        )

    def __call__(self, at: Placed) -> tuple[Float[Array, " M"], Closing]:
        """Closure and the two conditions."""
        tangency = self.tangency_at(at)
        closing = close(at.system, at.period, self.options, self.family, tangency)
        pair = defining(at.system, self.family, closing.t, closing.x, tangency)
        gap = closing.gap
        if self.still is not None:
            # Any value closes the last arc, whose equation is that the first start stays.
            away = select(self.still, at.starts[0] - self.tangency.starts[0], 0)
            gap = gap.at[-away.size :].add(away)
            closing = dataclasses.replace(closing, result=_lost_if_changed(closing, self.still))
        return jnp.append(gap, pair), stop_gradient(closing)


def _lost_if_changed(closing: Closing, still: Bool[Array, " n"]) -> RESULTS:
    """The outcome of a closure; `orbit_lost` where a component that no event determines at the
    guess has changed by more than rounding."""
    gaps, size = closing.gap.reshape(-1, still.size), select(closing.size == 0, 1, closing.size)
    far = abs(gaps) > rounding(size)
    lost = (closing.result == RESULTS.successful) & jnp.any(still & far)
    return RESULTS.where(lost, RESULTS.orbit_lost, closing.result)


class DefiningSystem(Equations):
    """Unknowns z are the states at the starts of the arcs, the phase of the tangency (for an
    autonomous system the period), and the free parameters."""

    tangency: Tangency
    options: ShootingOptions
    periods: int | Array
    newton_steps: int | Array
    family: Int[Array, ""]
    still: Bool[Array, " n"] | None
    """Components of the state that close for every value, and have the value at the tangency."""
    free: tuple[str, ...] = eqx.field(static=True)

    def placed(self, system: System, z: Array) -> Placed:
        """The meaning of z."""
        n, shape = self.tangency.starts.size, self.tangency.starts.shape
        system = replace_parameters(system, self.free, z[n + 1 :])
        if system.period is None:
            return Placed(system, z[n], z[:n].reshape(shape), self.tangency.phase)
        period = jnp.asarray(system.period, z.dtype) * jnp.asarray(self.periods, z.dtype)
        return Placed(system, period, z[:n].reshape(shape), z[n])

    def unknowns(self, orbit: Orbit, values: Sequence[Array]) -> Float[Array, " N"]:
        """The unknowns z at the tangency of an orbit with these values of the free parameters."""
        last = orbit.period if orbit.system.period is None else self.tangency.phase
        return jnp.concatenate([jnp.ravel(self.tangency.starts), jnp.stack([last, *values])])

    def monodromy(self, slopes: Float[Array, "M N"]) -> Float[Array, "n n"]:
        """The monodromy matrix from the start of the first arc, given the derivative of the
        equations."""
        arcs, n = self.tangency.starts.shape
        total = jnp.eye(n, dtype=slopes.dtype)
        for i in range(arcs):
            block = slopes[i * n : (i + 1) * n, i * n : (i + 1) * n]
            if arcs == 1:
                # The end of an only arc is compared with its own start.
                block = block + jnp.eye(n, dtype=slopes.dtype)
                if self.still is not None:
                    block = block - jnp.diag(self.still.astype(slopes.dtype))
            total = block @ total
        return total

    @eqx.filter_jit
    def there(self, system: System, z: Array) -> Placed:
        """`placed`, as one program."""
        return self.placed(system, z)

    @property
    def residual_at(self) -> Residual:
        """The equations as a function of a `Placed`."""
        return Residual(self.tangency, self.options, self.family, self.still)

    def residual(self, system: System, z: Array) -> tuple[Float[Array, " M"], Closing]:
        """Closure and the two conditions."""
        return self.residual_at(self.placed(system, z))

    def root(
        self,
        system: System,
        guess: Array,
        more: Callable[[Evaluation, Array], Evaluation] = as_it_is,
    ) -> Root:
        """Newton's root of the equations, or of `more` applied to an evaluation."""

        def concrete(z: Array) -> tuple:
            near = self._near(system, z)
            return near.value, _slopes_along(self.residual_at, near)

        def traced(z: Array) -> tuple:
            return self.placed(system, z), _slopes(lambda z: self.residual(system, z), z)

        stages = Stages(concrete, traced, _Evaluated(self.family))
        return root_of(stages, guess, self.newton_steps, more, known=is_known((self, system)))

    @property
    def width(self) -> int:
        """Number of directions of a program for all unknowns, with at most two free parameters."""
        return self.tangency.starts.size + 3

    @eqx.filter_jit
    def _near(self, system: System, z: Array) -> Affine[Placed]:
        return tree_in_kernel(lambda: affine(ft.partial(self.placed, system), z, self.width))

    def solve(self, system: System, guess: Array) -> tuple[Array, Array, Root]:
        """Newton's iteration with one free parameter."""
        root = self.root(system, guess)
        return root.z, root.at.jacobian, root

    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """Derivatives in forward mode; for concrete numbers by the program of `evaluate`, a few
        parameters at a time."""
        if not is_known((self, system_of, theta, z)):
            residual = lambda theta: self.residual(system_of(theta), z)[0]  # noqa: E731
            return kernel_if_it_fits(jax.jacfwd(residual))(theta)
        firsts = jax.device_put(list(np.arange(0, theta.shape[0], self.width)))
        near = [_near_parameters(self, system_of, theta, z, first) for first in firsts]
        turns = [_slopes_along(self.residual_at, part)[0] for part in near]
        return jax.device_put(np.concatenate(turns, axis=1)[:, : theta.shape[0]])

    def by_unknowns(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """Derivatives in forward mode."""
        residual = lambda z: self.residual(system_of(theta), z)[0]  # noqa: E731
        return kernel_if_it_fits(jax.jacfwd(residual))(z)


class _Evaluated(eqx.Module):
    """Residual and Jacobian for given slopes; the further data is the `Closing`."""

    family: Int[Array, ""]

    def __call__(self, z: Array, done: tuple[Placed, tuple]) -> Evaluation:
        at, (by_z, (value, closing)) = done
        by_z = by_z[:, : z.shape[0]]
        both = scales(at, z, by_z, closing, self.family)
        return Evaluation(value, by_z, *both, closing.result, closing)


def scales(
    at: Placed, z: Array, by_z: Array, closing: Closing, family: Int[Array, ""]
) -> tuple[Float[Array, " M"], Float[Array, " N"]]:
    """Scales of the equations and of the unknowns, given the derivative of the former by the
    latter."""
    size = select(closing.size == 0, 1, closing.size)
    # The scale of H is its range across the orbit, the scale of its rates follows from a period.
    normals = jax.jacfwd(at.system.switching, argnums=1)(closing.t, closing.x)
    height = jnp.max(jnp.sum(abs(jnp.atleast_2d(normals)) * size, axis=1))
    height = select(height == 0, 1, height)
    pace = 2 * jnp.pi / at.period
    pair = jnp.stack([height * pace, height * pace**2])
    pair = select(family == SLIDE, pair, pair / pace)
    sizes = jnp.tile(size, at.starts.shape[0])
    equations, n = jnp.append(sizes, pair), at.starts.size
    # A phase, and a parameter, may be zero, and rounding is then relative to something else, a
    # period, or the change of the parameter that changes an equation by its scale. A parameter that
    # changes no equation has no scale; Newton's method has to see that, so it is 1 at most.
    reach = jnp.min(equations[:, None] / abs(by_z[:, n + 1 :]), axis=0)
    least = jnp.minimum(1, RESIDUAL / CONVERGED * reach)
    q = jnp.maximum(abs(z[n + 1 :]), select(jnp.isfinite(least), least, 1))
    return equations, jnp.concatenate([sizes, at.period[None], q])


@eqx.filter_jit
def _near_parameters(
    equations: DefiningSystem, system_of: SystemOf, theta: Array, z: Array, first: Array
) -> Affine[Placed]:
    placed = lambda theta: equations.placed(system_of(theta), z)  # noqa: E731
    return tree_in_kernel(lambda: affine(placed, theta, equations.width, first))


def _slopes(
    residual: Callable[[Array], tuple[Array, Closing]], u: Array
) -> tuple[Array, tuple[Array, Closing]]:
    """The derivative of a residual, the residual, and further data."""

    def both(u: Array) -> tuple[Array, tuple[Array, Closing]]:
        value, closing = residual(u)
        return value, (value, closing)

    return kernel_if_it_fits(jax.jacfwd(both, has_aux=True))(u)


@eqx.filter_jit
def _slopes_along(residual: Residual, near: Affine[Placed]) -> tuple[Array, tuple[Array, Closing]]:
    """`_slopes` along the slopes of `near`, one program for all varying unknowns."""
    return _slopes(lambda s: residual(near(s)), jnp.zeros(near.width, near.value.starts.dtype))


def defining_system(
    system: System,
    orbit: Orbit,
    tangency: Tangency,
    family: int | Int[Array, ""],
    free: tuple[str, ...],
    newton_steps: int | Array,
) -> DefiningSystem:
    """The defining system of a tangency of an orbit of a forced or an autonomous system."""
    # The multiple of the forcing period is an argument of the program, not a constant.
    periods = 1
    if system.period is not None:
        periods = jnp.round(stop_gradient(orbit.period / jnp.asarray(orbit.system.period)))
    family = array_of(family, jnp.int32)
    still, constant = None, constants_of(orbit.system, orbit.x0)
    if constant.any():
        still = stop_gradient(unchanged(jnp.asarray(constant), orbit.monodromy))
    return DefiningSystem(
        stop_gradient(tangency), orbit.options, periods, newton_steps, family, still, free
    )
