"""`OrbitCurve`: a branch of periodic orbits as a curve for continuation.

Where the period map has a square root (an orbit that grazes a discontinuity) the branch has a
corner and continues in another direction, perhaps back. No step passes it. Points of the branch at
a small distance are therefore searched in many directions, and the branch continues from the
nearest one that is not on its earlier part.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfil.model.outcomes import RESULTS
from jaxfil.orbits.corrector import OrbitPoint, OrbitProblem, orbit_of, point_of, solve_across
from jaxfil.orbits.curve import (
    ArclengthConstraint,
    Curve,
    Special,
    StepSizes,
    constraint_across,
)
from jaxfil.orbits.half_period import half_gap
from jaxfil.orbits.locating import change_on_curve, jumps_on_curve
from jaxfil.orbits.newton import Root
from jaxfil.orbits.phase import phased_like
from jaxfil.orbits.phase_shift import period_of, problem_at, quiet_phase, seen_from
from jaxfil.orbits.special_points import (
    crossing,
    kind_of_change,
    overlooked,
    special_orbits,
)
from jaxfil.xla.known import array_of

# A guess from a neighbour converges in a few steps or not at all; across a square root of the
# period map it needs many, because steps are halved repeatedly.
_NEWTON_STEPS, _MANY_STEPS = 12, 40
# Number of directions of the search around a corner, and its distances: the larger one where the
# continuation turns sharply, as beside the square root of a graze.
_DIRECTIONS, _RADII = 48, (1e-3, 1e-2)
# A point further away than this is on another branch; one at this cosine to the tangent is on the
# earlier part of the branch.
_REACH, _BACK = 2e-2, -0.95
# A multiplier above this is reported at the end of a branch.
_LARGE = 1e3
# Distance along the earlier branch that is used where the phase is changed, in scaled unknowns.
_AWAY = 1e-4
# Where an orbit joins one of half the period, its change over half a period is zero to this
# fraction of the variation of this change over the step.
_JOINED = 1e-2


@dataclasses.dataclass(frozen=True)
class OrbitCurve(Curve[OrbitPoint]):
    """The branch of an `OrbitProblem`. The last unknown is the parameter. If `prime`, orbits that
    run twice through another one do not belong to it. `least` bounds scales from below."""

    problem: OrbitProblem
    prime: bool = False
    least: np.ndarray | float = 0.0
    t0: float | None = None
    """The phase of the problem, if points are finally converted from another one."""

    # The branch ends at a corner or a square root, whose position is known to the least step.
    steps = StepSizes(first=0.005, least=1e-9, growth=1.6, straight=0.995, easy=5, corner=1e-5)
    solution = "orbit"
    place = -1

    @property
    def parameter(self) -> str:
        """The name of the parameter."""
        return self.problem.parameter

    def solve(self, guess: np.ndarray, constraint: ArclengthConstraint) -> Root:
        """Solve by shooting."""
        steps = array_of(_NEWTON_STEPS, jnp.int32)
        return solve_across(self.problem, array_of(guess), constraint, steps)

    def point(self, root: Root, constraint: ArclengthConstraint, along: np.ndarray) -> OrbitPoint:
        """A point with its shot."""
        point = dataclasses.replace(point_of(root, constraint, along), t0=self.t0)
        if not self.prime:
            return point
        return dataclasses.replace(point, half_gap=half_gap(self.problem, point.u, point.shot))

    def correct(
        self, guess: np.ndarray, constraint: ArclengthConstraint, along: np.ndarray
    ) -> OrbitPoint | None:
        """`Curve.correct`, without points of the branch of half the period, to which Newton's
        method may converge."""
        point = super().correct(guess, constraint, along)
        return None if point is None or point.is_doubled else point

    def last_between(self, here: OrbitPoint, ahead: OrbitPoint) -> tuple[OrbitPoint, str] | None:
        """The point at which the branch joins the branch of half the period."""
        if not self.prime or here.half_gap @ ahead.half_gap >= 0:
            return None
        moves = here.half_gap - ahead.half_gap
        # At the point itself the branches cross and the equations are singular; a solution exists
        # up to the limit of rounding.
        point, _ = change_on_curve(self, here, ahead, lambda p: bool(p.half_gap @ moves > 0))
        if abs(point.half_gap).max() > _JOINED * abs(moves).max():
            return None  # it has turned without being zero
        # It joins the other branch at right angles to the parameter.
        tangent = np.append(point.tangent[:-1], 0.0)
        point = dataclasses.replace(point, tangent=tangent / np.linalg.norm(tangent))
        return point, f"the branch of half the period was met at {self.told(point)}"

    def metric(self, point: OrbitPoint) -> np.ndarray:
        """Scales: `Shot.size` for a state, the size of a parameter. All arcs together count as one
        state."""
        m = self.problem.options.arcs
        size = np.tile(np.asarray(point.shot.size) * np.sqrt(m), m)
        q = abs(point.u[size.shape[0] :])
        return np.maximum(np.append(size, q), self.least)

    def beside(self, point: OrbitPoint, other: OrbitPoint) -> np.ndarray:
        """Unknowns shifted in phase. The phase of an autonomous orbit drifts along a branch, so its
        starts are taken where it is nearest to the other one."""
        if not self.problem.autonomous:
            return point.u
        return phased_like(orbit_of(self.problem, point), point.u, other.u)

    def same(self, a: OrbitPoint, b: OrbitPoint) -> bool:
        """Whether both have the same contacts."""
        return a.sequence == b.sequence

    def special_points(self, a: OrbitPoint, b: OrbitPoint) -> Iterator[Special[OrbitPoint]]:
        """Zeros of test functions and changes of the contacts."""
        return special_orbits(self, a, b, lambda point: period_of(self.problem, point))

    def overlooked(
        self, points: Sequence[OrbitPoint], special: Sequence[Special[OrbitPoint]]
    ) -> Iterator[Special[OrbitPoint]]:
        """Multipliers that cross the unit circle in many short steps."""

        def curve_at(point: OrbitPoint) -> OrbitCurve:
            problem = self.problem if point.t0 is None else problem_at(self.problem, point.t0)
            return dataclasses.replace(self, problem=problem, t0=point.t0)

        return overlooked(curve_at, points, special)

    def elsewhere(
        self, here: OrbitPoint, start: OrbitPoint
    ) -> "tuple[OrbitCurve, OrbitPoint, OrbitPoint] | None":
        """The curve shot from a phase far from contacts, if one has reached this phase."""
        part = quiet_phase(self.problem, here)
        if part is None:
            return None
        t0 = float(self.problem.options.t0) + part * period_of(self.problem, here)
        curve = dataclasses.replace(self, problem=problem_at(self.problem, t0), t0=t0)
        # The direction of continuation follows from an earlier point, converted to the new phase.
        back = self._seen(curve, here, -_AWAY * here.tangent)
        if back is None:
            return None
        guess = seen_from(self.problem, here, part)
        scale = self.metric(here)
        along = (guess - back) / scale
        along = along / np.linalg.norm(along)
        point = curve.correct(guess, constraint_across(guess, scale, along, 0.0), along)
        if point is None:
            return None
        first = curve.seen_again(self.problem, start)
        return curve, point, start if first is None else first

    def _seen(self, curve: "OrbitCurve", here: OrbitPoint, step: np.ndarray) -> np.ndarray | None:
        """The unknowns, converted to another curve, of the point of this one a step from here."""
        constraint = constraint_across(here.u, here.scale, step, float(step @ step))
        point = self.correct(here.u + step * here.scale, constraint, here.tangent)
        if point is None:
            return None
        return seen_from(self.problem, point, self._part_to(curve, point))

    def _part_to(self, other: "OrbitCurve", point: OrbitPoint) -> float:
        """The time from this phase to the phase of another curve, as a fraction of the period."""
        away = float(other.problem.options.t0) - float(self.problem.options.t0)
        return (away / period_of(self.problem, point)) % 1.0

    def seen_again(self, problem: OrbitProblem, point: OrbitPoint) -> OrbitPoint | None:
        """A point of the problem, at another phase than this curve, as a point of this curve."""
        other = dataclasses.replace(self, problem=problem)
        guess = seen_from(problem, point, other._part_to(self, point))
        constraint = constraint_across(guess, point.scale, self.axis(guess), 0.0)
        found = self.correct(guess, constraint, self.axis(guess))
        if found is None:
            return None
        sign = 1.0 if found.tangent[-1] * point.tangent[-1] >= 0 else -1.0
        return dataclasses.replace(found, tangent=sign * found.tangent)

    def beyond_end(self, here: OrbitPoint) -> tuple[OrbitPoint, Special[OrbitPoint]] | None:
        """The continuation around a corner: in random directions at a small distance, the nearest
        point with other contacts that is not on the earlier part of the branch."""
        for radius in _RADII:
            best = self._beyond(here, radius)
            if best is not None:
                kind = kind_of_change(here.sequence, best.sequence)
                return best, Special(kind, here, here.sequence, best.sequence)
        return None

    def _beyond(self, here: OrbitPoint, radius: float) -> OrbitPoint | None:
        """The same for one distance."""
        scale, best, least = self.metric(here), None, _REACH
        for point in self._around(here, scale, radius):
            away = (point.u - here.u) / scale
            distance = np.linalg.norm(away)
            # −1 is the direction of the earlier part. A point with the same contacts is on the
            # branch itself, or on a neighbouring one.
            forward = float(away @ here.tangent / distance)
            if point.sequence != here.sequence and forward > _BACK and distance < least:
                sign = 1.0 if point.tangent @ away >= 0 else -1.0
                best, least = dataclasses.replace(point, tangent=sign * point.tangent), distance
        return best

    def jumps(self, a: OrbitPoint, b: OrbitPoint) -> bool:
        """Whether the determinant changes its sign without a zero, as where a step past the end of
        a branch meets another arm of it, which is as near as a fold to an end in a graze."""
        test = crossing(a, b)
        if not self.same(a, b) or test(a) * test(b) >= 0:
            return False
        return jumps_on_curve(self, a, b, test)

    def about(self, point: OrbitPoint) -> str:
        """The largest multiplier, if it is as large as near a square root of the period map."""
        values = np.linalg.eigvals(np.asarray(point.shot.monodromy))
        largest = values[np.argmax(abs(values))]
        if not abs(largest) > _LARGE:
            return ""
        return f"largest multiplier {abs(largest):.2g}, as where an orbit grazes"

    def _around(self, here: OrbitPoint, scale: np.ndarray, radius: float) -> list[OrbitPoint]:
        """Points of the branch at a small distance in many directions, in one call."""
        # The directions are fixed, so that a branch is reproducible.
        rng = np.random.default_rng(0)
        normals = rng.normal(size=(_DIRECTIONS, here.u.size))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        base, scales = (np.broadcast_to(v, normals.shape) for v in (here.u, scale))
        constraints = constraint_across(base, scales, normals, np.full(_DIRECTIONS, radius))
        guesses = array_of(base + radius * normals * scales)
        steps = array_of(_MANY_STEPS, jnp.int32)
        solve = lambda u, constraint: solve_across(self.problem, u, constraint, steps)  # noqa: E731
        roots = eqx.filter_vmap(solve)(guesses, constraints)
        pick = lambda tree, i: jax.tree.map(lambda v: np.asarray(v)[i], tree)  # noqa: E731
        return [
            self.point(pick(roots, i), pick(constraints, i), here.tangent)
            for i in np.flatnonzero(np.asarray(roots.result == RESULTS.successful))
        ]
