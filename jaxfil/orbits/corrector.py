"""Points of a branch of orbits, and their correction under a constraint.

Unknowns are u = (starts of the arcs, the period if it is unknown, the parameter).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.run.solution import Events, switches
from jaxfil.model.outcomes import RESULTS
from jaxfil.orbits.closing import OrbitProblem, phase_condition, solve_closing
from jaxfil.orbits.curve import ArclengthConstraint, CurvePoint, at_root
from jaxfil.orbits.newton import Root
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.shooting import Shot
from jaxfil.xla.known import compiled_if_traced


@dataclasses.dataclass(frozen=True)
class OrbitPoint(CurvePoint):
    """A point of a branch: an orbit, with its `Shot` as NumPy arrays. If a branch of half the
    period may be reached, `half_gap` is x(t0 + T/2) − x(t0), each component scaled; otherwise it is
    empty. `t0` is the phase of the shot, if it differs from the problem's. `rows` is the derivative
    of its equations, by scaled unknowns."""

    shot: Shot
    residual: float
    rows: np.ndarray
    half_gap: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    t0: float | None = None

    @property
    def is_doubled(self) -> bool:
        """Whether it is known to be an orbit of half the period, run through twice."""
        if not self.half_gap.size:
            return False
        return bool(abs(self.half_gap).max() < np.sqrt(np.finfo(self.u.dtype).eps))

    @property
    def sequence(self) -> tuple:
        """The contacts in order, in the form of `contacts_of`."""
        return contacts_of(self.shot.events)


def contacts_of(events: Events | None) -> tuple:
    """The contacts of an orbit in order, as surfaces and modes after. An orbit has no first
    contact, so the least of all rotations is taken, and a contact may pass t0."""
    if events is None:
        return ()
    members, modes = np.asarray(events.members), np.asarray(events.modes)
    rows = [
        (tuple(np.flatnonzero(members[i]).tolist()), tuple(modes[i].tolist()))
        for i in switches(events)
    ]
    return min((tuple(rows[i:] + rows[:i]) for i in range(len(rows))), default=())


@compiled_if_traced
def solve_across(
    problem: OrbitProblem, u: Array, constraint: ArclengthConstraint, newton_steps: Array
) -> Root:
    """Newton's root of the closure equations and a constraint, with the `Shot` there."""
    phase = phase_condition(problem, constraint.base)
    return solve_closing(problem, phase, u, newton_steps, constraint.appended)


def point_of(root: Root, constraint: ArclengthConstraint, along: np.ndarray) -> OrbitPoint:
    """The point of a root, with its tangent to the side of `along`."""
    root = jax.tree.map(np.asarray, root)
    return OrbitPoint(
        **at_root(root, constraint, along),
        shot=root.at.aux,
        residual=float(root.size),
        rows=rows_of(root, np.asarray(constraint.scale)),
    )


def rows_of(root: Root, scale: np.ndarray) -> np.ndarray:
    """The derivative of the equations at a root, except the constraint, by scaled unknowns."""
    return np.asarray(root.at.jacobian)[:-1] * scale


def orbit_of(problem: OrbitProblem, point: OrbitPoint) -> Orbit:
    """The `Orbit` of a point."""
    # Put there unchanged, because `jnp.asarray` would compile a program for each shape.
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
