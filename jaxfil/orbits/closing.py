"""The equations of a periodic orbit: every arc ends where the next one starts.

Unknowns are the starts of the arcs, the period if it is unknown, and a parameter if one is free.
The residual has all derivatives for Newton's method.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.model.outcomes import RESULTS, is_successful
from jaxfil.model.parameter import replace_parameter
from jaxfil.model.system import System
from jaxfil.orbits.affine import Affine, affine
from jaxfil.orbits.implicit import Equations, SystemOf
from jaxfil.orbits.newton import FLOOR, Evaluation, Root, Stages, as_it_is, root_of
from jaxfil.orbits.prime_period import times_round
from jaxfil.orbits.shooting import ShootingOptions, Shot, shoot, starts_from, velocity
from jaxfil.xla.known import array_of, in_numpy, is_known
from jaxfil.xla.select import select

# The least autonomous period, relative to the guess.
_SHORTEST = 1 / 16


class OrbitProblem(eqx.Module):
    """The orbits of a system, as `parameter` varies, if it is named. Unknowns u are the starts of
    all arcs and q, which is the period of an autonomous system, and the parameter."""

    system: System
    options: ShootingOptions
    parameter: str = eqx.field(static=True)
    periods: int = eqx.field(static=True)

    @property
    def autonomous(self) -> bool:
        """Whether the period is one of the unknowns."""
        return self.system.period is None

    def setting(self, q: Array) -> tuple[System, Array]:
        """The system and the period for q = (period,) parameter."""
        system = self.system
        if self.parameter:
            system = replace_parameter(system, self.parameter, q[-1])
        if self.autonomous:
            return system, q[0]
        return system, jnp.asarray(system.period, q.dtype) * self.periods

    def split(self, u: Array) -> tuple[Array, Array]:
        """The starts of the arcs, shape (M, n), and q."""
        count = u.shape[0] - int(self.autonomous) - int(bool(self.parameter))
        return u[:count].reshape(self.options.arcs, -1), u[count:]


class PhaseCondition(eqx.Module):
    """normal · (x(t0) − anchor) = 0, which selects one of the states of an autonomous orbit. The
    normal, of length one, is the field at the anchor."""

    anchor: Float[Array, " n"]
    normal: Float[Array, " n"]
    period: Float[Array, ""]  # the guess


@eqx.filter_jit
def phase_condition(problem: OrbitProblem, u: Array) -> PhaseCondition | None:
    """The condition at a state of an autonomous system; None for a forced one."""
    if not problem.autonomous:
        return None
    starts, q = problem.split(u)
    anchor = starts[0]
    normal = velocity(problem.setting, problem.options, anchor, q)
    size = jnp.sqrt(normal @ normal)
    # At rest there is no direction; a row of zeros then makes the Jacobian singular.
    return PhaseCondition(anchor, normal / select(size == 0, 1, size), q[0])


def solve_closing(
    problem: OrbitProblem,
    phase: PhaseCondition | None,
    guess: Array,
    newton_steps: Array,
    more: Callable[[Evaluation, Array], Evaluation] = as_it_is,
) -> Root:
    """Newton's root of the closure of all arcs and, for an autonomous orbit, its phase, by all
    unknowns, whose scales are their sizes. The further data is the `Shot`. `more`, applied to an
    evaluation, may append equations."""

    def concrete(u: Array) -> Shot:
        setting, still, starts = _near(problem, u)
        return shoot_near(setting, problem.options, starts, still)

    def traced(u: Array) -> Shot:
        return shoot(problem.setting, problem.options, *problem.split(u))

    stages = Stages(concrete, traced, _Closing(phase))
    return root_of(stages, guess, newton_steps, more, known=is_known((problem, phase)))


# One program for all varying unknowns (see `affine`).
shoot_near = eqx.filter_jit(shoot)


@eqx.filter_jit
def _near(problem: OrbitProblem, u: Array) -> tuple[Affine[tuple[System, Array]], Array, Array]:
    """The setting near u, its unknowns, which are zero there, and the starts."""
    starts, q = problem.split(u)
    near = affine(problem.setting, q, 1 + int(problem.autonomous))
    return near, jnp.zeros(near.width, q.dtype), starts


class _Closing(eqx.Module):
    """The equations, given the shot."""

    phase: PhaseCondition | None

    def __call__(self, u: Array, shot: Shot) -> Evaluation:
        m, n = shot.ends.shape
        starts, q, phase = u[: m * n].reshape(m, n), u[m * n :], self.phase
        shot = dataclasses.replace(shot, by_global=shot.by_global[:, :, : q.shape[0]])
        residual, jacobian = _closing(shot, starts)
        # A component has the same scale as an unknown and as a mismatch.
        equations = jnp.tile(shot.size, m)
        unknowns = jnp.append(equations, abs(q))
        result = shot.result
        if phase is not None:
            # Every state closes for a period of zero. A period far below the guess is not an orbit,
            # and a step towards it is too long.
            vanished = (result == RESULTS.successful) & (q[0] < _SHORTEST * phase.period)
            result = RESULTS.where(vanished, RESULTS.newton_stalled, result)
            row = jnp.append(phase.normal, jnp.zeros(jacobian.shape[1] - n, q.dtype))
            residual = jnp.append(residual, jnp.sum(phase.normal * (starts[0] - phase.anchor)))
            jacobian = jnp.concatenate([jacobian, row[None]])
            equations = jnp.append(equations, jnp.sum(abs(phase.normal) * shot.size))
        return Evaluation(residual, jacobian, equations, unknowns, result, shot)


def _closing(shot: Shot, starts: Array) -> tuple[Array, Array]:
    """The mismatch of every arc's end with the next one's start, shape (M n,), and its derivative
    with respect to all starts and the global unknowns, shape (M n, M n + k)."""
    # Block by block: the arc's own derivative on the diagonal, −1 for the next start, cyclically.
    m, n = starts.shape
    gap = shot.ends - jnp.roll(starts, -1, axis=0)
    own, unit = np.eye(m, dtype=starts.dtype), jnp.asarray(np.eye(n, dtype=starts.dtype))
    own, next_ = (jnp.asarray(v[:, None, :, None]) for v in (own, np.roll(own, 1, axis=1)))
    by_starts = own * shot.by_start[:, :, None] - next_ * unit[:, None]
    by_starts, by_global = (v.reshape(m * n, -1) for v in (by_starts, shot.by_global))
    jacobian = jnp.concatenate([by_starts, by_global], axis=1)
    gap, jacobian = shot.constant.held(gap, jacobian, shot.size)
    return gap.ravel(), jacobian


@eqx.filter_jit
def _along(problem: OrbitProblem, x0: Array, q: Array) -> Array:
    """The unknowns of the trajectory from x0, whose last arc need not close."""
    return jnp.append(starts_from(problem.setting, problem.options, x0, q).ravel(), q)


class ClosedOrbit(Equations):
    """The equations of an orbit of a given system. Unknowns are the starts of all arcs and the
    period of an autonomous system."""

    options: ShootingOptions
    newton_steps: Array
    periods: int = eqx.field(static=True)

    def problem(self, system: System) -> OrbitProblem:
        """The orbit problem of a system."""
        return OrbitProblem(system, self.options, "", self.periods)

    def solve(self, system: System, guess: Array) -> tuple[Array, Array, Root]:
        """Newton's iteration; the further data is its `Root`, with the `Shot`. Of an autonomous
        system, the orbit once round, if the numbers are known."""
        problem = self.problem(system)
        phase = phase_condition(problem, guess)
        root = solve_closing(problem, phase, guess, self.newton_steps)
        if phase is not None and is_known((problem, root)) and is_successful(root.result):
            root = self._once_round(problem, phase, root)
        return root.z, root.at.jacobian, root

    def _once_round(self, problem: OrbitProblem, phase: PhaseCondition, root: Root) -> Root:
        """The orbit with its prime period. Its phase condition is that of the guess, with respect
        to which the solution has derivatives."""
        starts, q = problem.split(root.z)
        for times in times_round(problem.system, self.options, starts[0], q[0], root.at.aux.events):
            shorter = dataclasses.replace(phase, period=phase.period / times)
            guess = _along(problem, starts[0], q / times)
            once = solve_closing(problem, shorter, guess, self.newton_steps)
            if is_successful(once.result) and self._is_round(problem, phase, root, once, times):
                return once
        return root

    def _is_round(
        self, problem: OrbitProblem, phase: PhaseCondition, root: Root, once: Root, times: int
    ) -> bool:
        """Whether an orbit is another one, run through several times. Beside a period doubling both
        exist, nearer to each other than the error of the steps may be."""
        starts, q = in_numpy(problem.split(once.z))
        repeated = np.append(starts[np.arange(len(starts)) * times % len(starts)], q * times)
        # With the same steps these differ by rounding.
        again = solve_closing(problem, phase, array_of(repeated), self.newton_steps)
        here, there, scale = in_numpy((again.z, root.z, root.at.unknown_scale))
        far, near = (np.max(abs(here - z) / scale) for z in (there, repeated))
        rounding = np.finfo(scale.dtype).eps ** FLOOR
        return is_successful(again.result) and bool(far <= max(near, rounding))

    @eqx.filter_jit
    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """The derivative by one shot in which the parameters are global unknowns too."""
        starts, period = self.problem(system_of(theta)).split(z)
        k = period.shape[0]

        def setting(q: Array) -> tuple[System, Array]:
            return self.problem(system_of(q[k:])).setting(q[:k])

        shot = shoot(setting, self.options, starts, jnp.concatenate([period, theta]))
        by_theta = shot.by_global[:, :, k:].reshape(starts.size, -1)
        # The phase condition belongs to the guess, and is constant.
        return jnp.concatenate([by_theta, jnp.zeros((k, theta.shape[0]), theta.dtype)])

    @eqx.filter_jit
    def by_unknowns(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """The derivative by one shot, without the phase condition, which is constant."""
        problem = self.problem(system_of(theta))
        starts, period = problem.split(z)
        _, jacobian = _closing(shoot(problem.setting, self.options, starts, period), starts)
        rows = jnp.zeros((period.shape[0], z.shape[0]), z.dtype)
        return jnp.concatenate([jacobian, rows])
