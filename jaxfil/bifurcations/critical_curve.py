"""`CriticalCurve`: the curve of a smooth bifurcation of orbits in two parameters.

The curve has no corner at a cusp or where multipliers coincide. The curve of pairs on the unit
circle ends where they coincide at ±1; beyond, both are real, and their product alone is 1.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from jaxfil.bifurcations.candidates import tangency_candidates
from jaxfil.bifurcations.critical import CriticalOrbits, Known
from jaxfil.bifurcations.critical_vectors import VECTORS
from jaxfil.bifurcations.normal_form import Degeneracy, doubling_degeneracy, fold_degeneracy
from jaxfil.bifurcations.tangency import FAMILIES
from jaxfil.model.outcomes import RESULTS, is_successful
from jaxfil.model.parameter import cast, get_parameter
from jaxfil.orbits.branch import SpecialPoint
from jaxfil.orbits.closing import OrbitProblem
from jaxfil.orbits.corrector import OrbitPoint, contacts_of, orbit_of
from jaxfil.orbits.curve import (
    ArclengthConstraint,
    CurvePoint,
    Special,
    StepSizes,
    at_root,
    constraint_across,
)
from jaxfil.orbits.locating import change_on_curve, ends_between, last_along, zero_on_curve
from jaxfil.orbits.newton import Root
from jaxfil.orbits.phase_shift import period_of, problem_at, quiet_phase, seen_from
from jaxfil.orbits.plane_curve import EquationsCurve
from jaxfil.orbits.unit_circle import zeros_between

# κ of a pair of multipliers e^{±iθ}, κ = cos θ, in strong resonance.
RESONANCES = {"1:1": 1.0, "1:2": -1.0, "1:3": -0.5, "1:4": 0.0}
_MEET = ("1:1", "1:2")
# The kind of a curve and the same kind of another multiplier.
_DOUBLE = {
    ("fold", "fold"): "1:1",
    ("branch-point", "fold"): "1:1",
    ("period-doubling", "period-doubling"): "1:2",
}
# Accuracy of the end of a curve, where multipliers coincide.
_THERE = 1e-6


# It lies at most as many least steps beyond the last point.
_BEYOND = 4.0
# An orbit that misses a tangency by this fraction of the period is tangent: a time is the square
# root of the distance to which the curve's end is known.
_TANGENT = 1e-3


@dataclasses.dataclass(frozen=True)
class CriticalPoint(CurvePoint):
    """An orbit with critical multipliers, with its two parameters as the last unknowns. The
    coefficient of its normal form is NaN if not requested."""

    kind: str
    t: float
    known: Known
    degeneracy: Degeneracy

    @property
    def x(self) -> np.ndarray:
        """The state at t, where the orbit starts."""
        return self.u[: len(self.known.slopes.first)]

    @property
    def sequence(self) -> tuple:
        """The contacts in order."""
        return contacts_of(self.known.shot.events)


@dataclasses.dataclass(frozen=True)
class CriticalCurve(EquationsCurve[CriticalPoint]):
    """The curve of an orbit with critical multipliers, followed in the first of two parameters."""

    equations: CriticalOrbits

    steps = StepSizes(first=0.01, least=1e-8, growth=1.5, straight=0.99, easy=8, corner=1e-4)

    def solve(self, guess: np.ndarray, constraint: ArclengthConstraint) -> Root:
        """Solve by shooting."""
        return self.equations.root(guess, constraint)

    def point(
        self, root: Root, constraint: ArclengthConstraint, along: np.ndarray
    ) -> CriticalPoint:
        """A point with the coefficient of its normal form."""
        at: dict[str, Any] = at_root(root, constraint, along)
        known: Known = jax.tree.map(np.asarray, root.at.aux)
        s, vectors = self.equations.split(at["u"])
        kind = self.equations.kind
        degeneracy = Degeneracy(np.nan, vectors)
        if kind == "fold":
            degeneracy = fold_degeneracy(self.equations.first_slopes, s, vectors, known.slopes)
        elif kind == "period-doubling":
            degeneracy = doubling_degeneracy(self.equations.first_slopes, s, vectors, known.slopes)
        t = float(self.equations.options.t0)
        return CriticalPoint(**at, kind=kind, t=t, known=known, degeneracy=degeneracy)

    def metric(self, point: CriticalPoint) -> np.ndarray:
        """Scale of each unknown."""
        _, vectors = self.equations.split(point.scale)
        unit = point.known.slopes.unit
        return np.maximum(self.equations.joined(unit, vectors), self.least)

    def same(self, a: CriticalPoint, b: CriticalPoint) -> bool:
        """Whether both have the same contacts."""
        return a.sequence == b.sequence

    def special_points(
        self, a: CriticalPoint, b: CriticalPoint
    ) -> Iterator[Special[CriticalPoint]]:
        """Points of codimension two, at changes of contacts and between them."""
        kind = self.equations.kind
        if a.sequence != b.sequence:
            before, after = ends_between(self, a, b)
            yield from self._degenerate(a, before)
            # On the side with more contacts multipliers have a square root.
            fewer = len(before.sequence) <= len(after.sequence)
            yield Special("tangency", before if fewer else after, kind, kind)
            a = after
        yield from self._degenerate(a, b)

    def _degenerate(self, a: CriticalPoint, b: CriticalPoint) -> Iterator[Special[CriticalPoint]]:
        kind, tests = self.equations.kind, self._tests(a)
        for name, point in zeros_between(self, a, b, tests, self._others):
            yield Special(_DOUBLE.get((kind, name), name), point, kind, kind)
        if kind == "neimark-sacker":
            for name in _MEET:
                at_b = tests[name](b)
                if abs(at_b) < _THERE and not tests[name](a) * at_b < 0:
                    yield Special(name, b, kind, kind)

    def _tests(self, a: CriticalPoint) -> dict[str, Callable[[CriticalPoint], float]]:
        """Test functions of the points near a."""
        kind = self.equations.kind
        tests: dict[str, Callable[[CriticalPoint], float]] = {}
        if kind == "fold":
            tests["cusp"] = lambda p: p.degeneracy.value_beside(a.degeneracy)
        if kind == "period-doubling":
            tests["generalised-doubling"] = lambda p: p.degeneracy.value_beside(a.degeneracy)
        if kind == "neimark-sacker":
            for name, level in RESONANCES.items():
                tests[name] = lambda p, level=level: self._kappa(p) - level
        tests["fold"] = lambda p: float(np.polyval(self._polynomial(p), 1.0))
        tests["period-doubling"] = lambda p: float(np.polyval(self._polynomial(p), -1.0))
        return tests

    def _kappa(self, point: CriticalPoint) -> float:
        return float(self.equations.split(point.u)[1][-1])

    def _critical(self, point: CriticalPoint) -> np.ndarray:
        """The critical multipliers, and the trivial one of an autonomous orbit."""
        kind, trivial = self.equations.kind, [1.0] * self.equations.autonomous
        if kind == "neimark-sacker":
            return np.append(np.roots([1.0, -2 * self._kappa(point), 1.0]), trivial)
        return np.array([-1.0 if kind == "period-doubling" else 1.0, *trivial])

    def _polynomial(self, point: CriticalPoint) -> np.ndarray:
        """The characteristic polynomial of the other multipliers, smooth where one is critical."""
        whole = np.poly(point.known.slopes.monodromy)
        return np.polydiv(whole, np.poly(self._critical(point)))[0]

    def _others(self, point: CriticalPoint) -> np.ndarray:
        """The other multipliers. Roots of the polynomial would have half the digits if equal."""
        values = np.linalg.eigvals(point.known.slopes.monodromy)
        for critical in self._critical(point):
            values = np.delete(values, np.argmin(abs(values - critical)))
        return values

    def last_between(
        self, here: CriticalPoint, ahead: CriticalPoint
    ) -> tuple[CriticalPoint, str] | None:
        """The point at which the pair of multipliers coincides on the real axis."""
        if self.equations.kind != "neimark-sacker" or abs(self._kappa(ahead)) <= 1:
            return None
        level = float(np.sign(self._kappa(ahead)))
        point = zero_on_curve(self, here, ahead, lambda p: self._kappa(p) - level)
        # If orbits cross there the equations are singular at the point itself.
        point = point or change_on_curve(self, here, ahead, lambda p: abs(self._kappa(p)) <= 1)[0]
        return point, f"the multipliers meet at {level:g}, at {self.told(point)}"

    def refusal(self, ahead: CriticalPoint) -> str | None:
        """Beside a branch point that breaks up, the equations hold for no orbit, β ≠ 0."""
        if self.equations.kind != "branch-point":
            return None
        beta = float(self.equations.split(ahead.u)[1][-1])
        crosses = abs(beta) <= np.sqrt(np.finfo(ahead.u.dtype).eps)
        return None if crosses else "no branches cross"

    def special_end(self, here: CriticalPoint) -> Iterator[Special[CriticalPoint]]:
        """A point with a tangent orbit, whose multipliers may have a square root."""
        problem, orbit = self._orbit(here)
        found = tangency_candidates(orbit_of(problem, orbit), *FAMILIES)
        if found and found[0][0] < _TANGENT * period_of(problem, orbit):
            last = last_along(self, here, _BEYOND * self.steps.least)
            yield Special("tangency", last, here.kind, here.kind)

    def elsewhere(
        self, here: CriticalPoint, start: CriticalPoint
    ) -> "tuple[CriticalCurve, CriticalPoint, CriticalPoint] | None":
        """The curve shot from a phase far from contacts, if one has reached this phase."""
        problem, orbit = self._orbit(here)
        part = quiet_phase(problem, orbit)
        if part is None:
            return None
        t0 = here.t + part * period_of(problem, orbit)
        options = problem_at(problem, t0).options
        curve = dataclasses.replace(
            self, equations=dataclasses.replace(self.equations, options=options)
        )
        point = self._seen(curve, here)
        if point is None:
            return None
        return curve, point, self._seen(curve, start) or start

    def _orbit(self, point: CriticalPoint) -> tuple[OrbitProblem, OrbitPoint]:
        """A point as an orbit of the branch in the first parameter."""
        s, _ = self.equations.split(point.u)
        u, shot = s[:-1], point.known.shot
        # Its tangent is not used.
        orbit = OrbitPoint(u, u, u, point.num_steps, shot, 0.0, point.known.slopes.bordered)
        return self.equations.problem(s), orbit

    def _seen(self, curve: "CriticalCurve", point: CriticalPoint) -> CriticalPoint | None:
        """A point as a point of a curve that is shot from another phase."""
        problem, orbit = self._orbit(point)
        away = float(curve.equations.options.t0) - float(self.equations.options.t0)
        seen = seen_from(problem, orbit, (away / period_of(problem, orbit)) % 1.0)
        # The direction of the curve in the plane of the parameters is the same.
        ahead = (point.tangent * point.scale)[-2:]
        return curve.near(np.append(seen, point.u[-1]), ahead)[0]

    def near(self, s: np.ndarray, ahead: np.ndarray) -> tuple[CriticalPoint | None, RESULTS]:
        """The point whose orbit is near s, with its tangent to the side of `ahead` in the plane of
        the parameters; the outcome of Newton's method."""
        equations, shot = self.equations, self.equations.shot(s)
        if not is_successful(shot.result):
            return None, shot.result
        vectors = VECTORS[equations.kind]
        slopes = equations.slopes(s, shot, equations.normal_at(s), np.zeros(shot.size.size))
        u = equations.joined(s, vectors.start(slopes))
        scale = equations.joined(slopes.unit, vectors.scale(slopes))
        along = np.append(np.zeros(u.size - 2), ahead / scale[-2:])
        result = RESULTS.newton_stalled
        # Across one parameter; where the curve turns back in that, across the other one.
        for place in np.argsort(-abs(along[-2:])) - 2:
            axis = np.zeros_like(u)
            axis[place] = 1.0
            found, result = self.begin(u, constraint_across(u, scale, axis, 0.0), along)
            if found is not None:
                return found, result
        return None, result


def begin_critical(
    point: SpecialPoint, free: tuple[str, str]
) -> tuple[CriticalCurve, CriticalPoint | None, RESULTS]:
    """The curve of a special point of a branch; the point on it, if Newton's method converges; the
    outcome."""
    orbit = point.orbit
    system, options = orbit.system, dataclasses.replace(orbit.options, arcs=1)
    periods = 1
    if system.period is not None:
        periods = round(float(orbit.period) / float(np.asarray(system.period)))
    system = cast(system, orbit.x0.dtype)
    equations = CriticalOrbits(system, options, periods, free, point.kind)
    curve = CriticalCurve(equations)
    own = [] if system.period is not None else [float(orbit.period)]
    values = [float(get_parameter(system, name)) for name in free]
    s = np.concatenate([np.asarray(orbit.x0), own, values]).astype(orbit.x0.dtype)
    return curve, *curve.near(s, np.array([1.0, 0.0]))
