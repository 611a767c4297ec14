"""One-parameter families of orbits: a point on the branch, and what brings a guess onto it.

A system, the name of its parameter and a guess u = (starts of the arcs, the period if it is
unknown, the parameter) enter, with a plane that the point is to lie in; the `Point` leaves, with
the tangent of the branch there.
"""

import dataclasses
import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.integrate.solution import switches
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import replace_parameter
from jaxfil.model.system import System
from jaxfil.orbits.closing import PhaseCondition, evaluate_closing, phase_condition
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.shooting import ShootingOptions, Shot

# A guess taken from a neighbour converges in a few steps or not at all; one taken across a square
# root of the period map needs many, as it is halved again and again.
_NEWTON_STEPS, _MANY_STEPS = 12, 40


class ArclengthConstraint(eqx.Module):
    """normal · (u − base)/scale = offset."""

    base: Float[Array, " N"]
    scale: Float[Array, " N"]
    normal: Float[Array, " N"]
    offset: Float[Array, ""]


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
        system = replace_parameter(self.system, self.parameter, q[-1])
        if self.autonomous:
            return system, q[0]
        return system, jnp.asarray(system.period) * self.periods

    def split(self, u: Array) -> tuple[Array, Array]:
        """The starts of the arcs, shape (M, n), and q."""
        k = 1 + int(self.autonomous)
        return u[:-k].reshape(self.options.arcs, -1), u[-k:]


@dataclasses.dataclass(frozen=True)
class Point:
    """An orbit of a family: its unknowns u, their scales, the tangent of the branch in scaled
    unknowns (of length one), and the `Shot`, all as NumPy arrays."""

    u: np.ndarray
    scale: np.ndarray
    tangent: np.ndarray
    shot: Shot
    residual: float
    num_steps: int

    @property
    def value(self) -> float:
        """The parameter."""
        return float(self.u[-1])

    @property
    def sequence(self) -> tuple:
        """The contacts in order: surfaces and modes after. An orbit has no first contact: of all
        rotations the least is taken, so that a contact may pass t0."""
        events = self.shot.events
        if events is None:
            return ()
        rows = [
            (tuple(np.flatnonzero(events.members[i]).tolist()), tuple(events.modes[i].tolist()))
            for i in switches(events)
        ]
        return min((tuple(rows[i:] + rows[:i]) for i in range(len(rows))), default=())


@eqx.filter_jit
def _correct(
    family: OrbitProblem, u: Array, plane: ArclengthConstraint, newton_steps: Array
) -> Root:
    phase = None
    if family.autonomous:
        starts, q = family.split(plane.base)
        phase = phase_condition(family.setting, family.options, starts[0], q)
    return newton(ft.partial(_evaluation, family, plane, phase), u, newton_steps)


def _evaluation(
    family: OrbitProblem, plane: ArclengthConstraint, phase: PhaseCondition | None, u: Array
) -> Evaluation:
    """The closing of all arcs, the phase of an autonomous orbit, and the plane."""
    orbit = evaluate_closing(family.setting, family.options, phase, *family.split(u))
    gap = plane.normal @ ((u - plane.base) / plane.scale) - plane.offset
    return Evaluation(
        jnp.append(orbit.residual, gap),
        jnp.concatenate([orbit.jacobian, (plane.normal / plane.scale)[None]]),
        jnp.append(orbit.equation_scale, 1.0),
        jnp.append(orbit.unknown_scale, plane.scale[-1]),
        orbit.result,
        orbit.aux,
    )


def correct(
    family: OrbitProblem, guess: np.ndarray, plane: ArclengthConstraint, along: np.ndarray
) -> Point | None:
    """The point of the branch in a plane, near a guess; None if there is none. Its tangent points
    to the side of `along`."""
    root = _correct(family, jnp.asarray(guess), plane, jnp.asarray(_NEWTON_STEPS, jnp.int32))
    if not bool(root.result == RESULTS.successful):
        return None
    return _point(jax.tree.map(np.asarray, root), plane, along)


def correct_many(
    family: OrbitProblem, guesses: np.ndarray, planes: ArclengthConstraint, along: np.ndarray
) -> list[Point]:
    """`correct` for many guesses and planes at once; those that converged."""
    steps = jnp.asarray(_MANY_STEPS, jnp.int32)
    roots = eqx.filter_vmap(lambda u, plane: _correct(family, u, plane, steps))(guesses, planes)
    found = np.flatnonzero(np.asarray(roots.result == RESULTS.successful))
    pick = lambda tree, i: jax.tree.map(lambda v: np.asarray(v)[i], tree)  # noqa: E731
    return [_point(pick(roots, i), pick(planes, i), along) for i in found]


def _point(root: Root, plane: ArclengthConstraint, along: np.ndarray) -> Point:
    scale = np.asarray(plane.scale)
    # The branch runs along what the equations without the plane leave free.
    rows = np.asarray(root.at.jacobian)[:-1] * scale
    tangent = np.linalg.svd(rows)[2][-1]
    tangent = tangent if tangent @ along >= 0 else -tangent
    return Point(
        np.asarray(root.z), scale, tangent, root.at.aux, float(root.at.size), int(root.num_steps)
    )


def metric(family: OrbitProblem, point: Point) -> np.ndarray:
    """The metric at a point. All arcs together count as one state."""
    m = family.options.arcs
    size = np.tile(np.asarray(point.shot.size) * np.sqrt(m), m)
    q = point.u[size.shape[0] :]
    return np.append(size, np.where(q == 0, 1.0, abs(q)))


def constraint_across(
    base: np.ndarray, scale: np.ndarray, normal: np.ndarray, offset: float
) -> ArclengthConstraint:
    """A `ArclengthConstraint` of NumPy arrays, or many of them."""
    return ArclengthConstraint(*(jnp.asarray(v) for v in (base, scale, normal, offset)))


def orbit_of(family: OrbitProblem, point: Point) -> Orbit:
    """A point as the `Orbit` it is."""
    starts, q = family.split(jnp.asarray(point.u))
    system, period = family.setting(q)
    shot: Any = jax.tree.map(jnp.asarray, point.shot)
    return Orbit(
        x0=starts[0],
        period=period,
        monodromy=shot.monodromy,
        residual=jnp.asarray(point.residual),
        events=shot.events,
        num_events=shot.num_events,
        first_mode=shot.first_mode,
        result=RESULTS.successful,
        system=system,
        starts=starts,
        num_steps=jnp.asarray(point.num_steps),
        options=family.options,
    )
