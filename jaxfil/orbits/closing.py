"""The equations of a periodic orbit: every arc ends where the next one starts.

A system and a guess of (starts of the arcs, period if it is unknown) enter; how far the equations
are from holding leaves, with all derivatives, as Newton's method wants it.
"""

import functools as ft

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.orbits.implicit import Equations, SystemOf
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.orbits.shooting import Setting, ShootingOptions, Shot, shoot, velocity

# An autonomous period below this part of the guess is not looked for.
_SHORTEST = 1 / 16


class PhaseCondition(eqx.Module):
    """normal · (x(t0) − anchor) = 0, which picks one of the states of an autonomous orbit. The
    normal, of length one, is the field at the anchor."""

    anchor: Float[Array, " n"]
    normal: Float[Array, " n"]
    period: Float[Array, ""]  # the guess


def phase_condition(
    setting: Setting, options: ShootingOptions, anchor: Float[Array, " n"], q: Array
) -> PhaseCondition:
    """The condition at a state of an autonomous system; q opens with the period."""
    normal = velocity(setting, options, anchor, q)
    size = jnp.sqrt(normal @ normal)
    # At rest there is no direction; a row of zeros then makes the Jacobian singular, and says so.
    return PhaseCondition(anchor, normal / jnp.where(size == 0, 1, size), q[0])


def setting_of(system: System, periods: int, q: Array) -> tuple[System, Array]:
    """The system and the period for q = (period,) of an autonomous system, () of a forced one."""
    if system.period is None:
        return system, q[0]
    return system, jnp.asarray(system.period) * periods


def evaluate_closing(
    setting: Setting,
    options: ShootingOptions,
    phase: PhaseCondition | None,
    starts: Float[Array, "M n"],
    q: Float[Array, " k"],
) -> Evaluation:
    """The closing of all arcs and, of an autonomous orbit, its phase: by all starts and all of q,
    whose scales are their sizes. What else is known is the `Shot`."""
    shot = shoot(setting, options, starts, q)
    residual, jacobian = _closing(shot, starts)
    # A component is measured by its largest value on the orbit, as an unknown and as a mismatch.
    equations = jnp.tile(shot.size, options.arcs)
    unknowns = jnp.append(equations, abs(q))
    result = shot.result
    if phase is not None:
        # Every state closes after no time at all: a period far below the guess is no answer, and a
        # step towards it is too long.
        vanished = (result == RESULTS.successful) & (q[0] < _SHORTEST * phase.period)
        result = RESULTS.where(vanished, RESULTS.newton_stalled, result)
        row = jnp.zeros(jacobian.shape[1], q.dtype).at[: phase.normal.shape[0]].set(phase.normal)
        residual = jnp.append(residual, phase.normal @ (starts[0] - phase.anchor))
        jacobian = jnp.concatenate([jacobian, row[None]])
        equations = jnp.append(equations, abs(phase.normal) @ shot.size)
    return Evaluation(residual, jacobian, equations, unknowns, result, shot)


def _closing(shot: Shot, starts: Array) -> tuple[Array, Array]:
    """The mismatch of every arc's end with the next one's start, shape (M n,), and its derivative
    with respect to all starts and the global unknowns, shape (M n, M n + k)."""
    # Block by block: the arc's own derivative on the diagonal, −1 for the next start, round about.
    m, n = starts.shape
    residual = shot.ends - jnp.roll(starts, -1, axis=0)
    eye = jnp.eye(m, dtype=starts.dtype)
    own = jnp.einsum("ij,iab->iajb", eye, shot.by_start)
    next_ = jnp.einsum("ij,ab->iajb", jnp.roll(eye, 1, axis=1), jnp.eye(n, dtype=starts.dtype))
    by_starts = (own - next_).reshape(m * n, m * n)
    by_global = shot.by_global.reshape(m * n, -1)
    return residual.ravel(), jnp.concatenate([by_starts, by_global], axis=1)


class ClosedOrbit(Equations):
    """The equations of an orbit of a given system. Unknowns are the starts of all arcs and, of an
    autonomous system, the period."""

    options: ShootingOptions
    newton_steps: Array
    periods: int = eqx.field(static=True)

    def solve(
        self, system_of: SystemOf, theta: Array, guess: Array, slopes: bool
    ) -> tuple[Array, Array, None, Root]:
        """Newton's iteration; what else is known is its `Root`, with the `Shot`."""
        system = system_of(theta)
        setting = ft.partial(setting_of, system, self.periods)
        starts, q = self.split(system, guess)
        phase = None
        if system.period is None:
            phase = phase_condition(setting, self.options, starts[0], q)

        def evaluate(z: Array) -> Evaluation:
            return evaluate_closing(setting, self.options, phase, *self.split(system, z))

        root = newton(evaluate, guess, self.newton_steps)
        return root.z, root.at.jacobian, None, root

    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """By one shot in which the parameters are global unknowns too."""
        starts, period = self.split(system_of(theta), z)
        k = period.shape[0]

        def setting(q: Array) -> tuple[System, Array]:
            return setting_of(system_of(q[k:]), self.periods, q[:k])

        shot = shoot(setting, self.options, starts, jnp.concatenate([period, theta]))
        by_theta = shot.by_global[:, :, k:].reshape(starts.size, -1)
        # The condition on the phase is that of the guess, and does not move.
        return jnp.concatenate([by_theta, jnp.zeros((k, theta.shape[0]), theta.dtype)])

    def split(self, system: System, z: Array) -> tuple[Array, Array]:
        """The starts of the arcs, shape (M, n), and (period,) or ()."""
        count = z.shape[0] - int(system.period is None)
        return z[:count].reshape(self.options.arcs, -1), z[count:]
