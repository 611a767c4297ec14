"""Orbits of a system as one parameter varies: what brings a guess onto their branch.

A system, the name of its parameter and a guess u = (starts of the arcs, the period if it is
unknown, the parameter) enter, with a constraint that the point is to fulfil; Newton's root leaves,
and the point of the branch that it is.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.solution import Events, switches
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import replace_parameter
from jaxfil.model.system import System
from jaxfil.orbits.closing import evaluate_closing, phase_condition, setting_of
from jaxfil.orbits.curve import ArclengthConstraint, CurvePoint, tangent_of
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.shooting import ShootingOptions, Shot


class OrbitProblem(eqx.Module):
    """The orbits of a system as `parameter` varies."""

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
        return setting_of(replace_parameter(self.system, self.parameter, q[-1]), self.periods, q)

    def split(self, u: Array) -> tuple[Array, Array]:
        """The starts of the arcs, shape (M, n), and q."""
        k = 1 + int(self.autonomous)
        return u[:-k].reshape(self.options.arcs, -1), u[-k:]


@dataclasses.dataclass(frozen=True)
class OrbitPoint(CurvePoint):
    """A point of a branch: an orbit, with its `Shot` as NumPy arrays."""

    shot: Shot
    residual: float

    @property
    def sequence(self) -> tuple:
        """The contacts in order, as `contacts_of` tells them."""
        return contacts_of(self.shot.events)


def contacts_of(events: Events | None) -> tuple:
    """The contacts of an orbit in order: surfaces and modes after. An orbit has no first contact:
    of all rotations the least is taken, so that a contact may pass t0."""
    if events is None:
        return ()
    members, modes = np.asarray(events.members), np.asarray(events.modes)
    rows = [
        (tuple(np.flatnonzero(members[i]).tolist()), tuple(modes[i].tolist()))
        for i in switches(events)
    ]
    return min((tuple(rows[i:] + rows[:i]) for i in range(len(rows))), default=())


@eqx.filter_jit
def solve_across(
    problem: OrbitProblem, u: Array, constraint: ArclengthConstraint, newton_steps: Array
) -> Root:
    """Newton's root of the closing equations and a constraint, with the `Shot` there."""
    phase = None
    if problem.autonomous:
        starts, q = problem.split(constraint.base)
        phase = phase_condition(problem.setting, problem.options, starts[0], q)

    def evaluate(u: Array) -> Evaluation:
        orbit = evaluate_closing(problem.setting, problem.options, phase, *problem.split(u))
        unknowns = orbit.unknown_scale.at[-1].set(constraint.scale[-1])  # not 0 where it is zero
        return constraint.appended(dataclasses.replace(orbit, unknown_scale=unknowns), u)

    return newton(evaluate, u, newton_steps)


def point_of(root: Root, constraint: ArclengthConstraint, along: np.ndarray) -> OrbitPoint:
    """A root as the point it is, its tangent to the side of `along`."""
    root, scale = jax.tree.map(np.asarray, root), np.asarray(constraint.scale)
    return OrbitPoint(
        u=np.asarray(root.z),
        scale=scale,
        tangent=tangent_of(root, scale, along),
        num_steps=int(root.num_steps),
        shot=root.at.aux,
        residual=float(root.at.size),
    )


def orbit_of(problem: OrbitProblem, point: OrbitPoint) -> Orbit:
    """A point as the `Orbit` it is."""
    # Put there as they are: `jnp.asarray` would compile a program for each shape.
    u, shot, residual, num_steps = jax.device_put(
        (point.u, point.shot, np.asarray(point.residual), np.asarray(point.num_steps))
    )
    return _orbit_of(problem, u, shot, residual, num_steps)


@eqx.filter_jit
def _orbit_of(
    problem: OrbitProblem, u: Array, shot: Shot, residual: Array, num_steps: Array
) -> Orbit:
    """`orbit_of`, as one program."""
    starts, q = problem.split(u)
    system, period = problem.setting(q)
    return Orbit(
        x0=starts[0],
        period=period,
        monodromy=jnp.asarray(shot.monodromy),
        residual=residual,
        events=shot.events,
        num_events=shot.num_events,
        first_mode=shot.first_mode,
        result=RESULTS.successful,
        system=system,
        starts=starts,
        num_steps=num_steps,
        options=problem.options,
    )
