"""`continue_orbit`: a branch of periodic orbits by pseudo-arclength continuation.

Special points on the branch are folds, period doublings, Neimark–Sacker points, branch points, and
every change of the sequence of contacts.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import cast, get_parameter, replace_parameter, scalar_parameter
from jaxfil.model.system import System
from jaxfil.orbits.branch import Branch, SpecialPoint
from jaxfil.orbits.corrector import (
    OrbitPoint,
    OrbitProblem,
    contacts_of,
    orbit_of,
    solve_across,
)
from jaxfil.orbits.curve import ArclengthConstraint, constraint_across, least_scales
from jaxfil.orbits.half_period import half_gap, may_be_doubled
from jaxfil.orbits.newton import Evaluation
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.orbit_curve import OrbitCurve
from jaxfil.orbits.phase_shift import problem_at
from jaxfil.orbits.pseudo_arclength import (
    FollowedCurve,
    follow,
    limits_of,
    range_ahead,
    range_around,
)
from jaxfil.xla.known import array_of, stacked

# The least scale of a guessed state.
_SMALL = 1e-3
# Trial steps off a branch, along the tangent of another one.
_OFF = (1e-2, 3e-3, 1e-3)
# Differences of the equations' derivative use this power of eps, in scaled unknowns.
_STEP = 1 / 3


def continue_orbit(
    system: System,
    parameter: str,
    orbit: Orbit | SpecialPoint,
    *,
    stop: float | tuple[float, float],
    max_step: float = 0.02,
    max_points: int = 2000,
    throw: bool = True,
) -> Branch:
    """Follow the branch of periodic orbits through `orbit` as a parameter varies.

    Pseudo-arclength continuation predicts along the tangent and corrects by Newton's method across
    it, so that it passes folds. Steps adapt to the curve. Special points are located to about 1e-10
    of the parameter. At a kink of the field, of a reset or of the map of a tick that no surface
    declares the multipliers may jump; that is no special point, though `Branch.stable` may change.

    **Arguments**

    - `system`: the `System`; its value of the parameter is ignored.
    - `parameter`: the name of a scalar parameter.
    - `orbit`: the start, from `periodic_orbit`, or a special point of another branch: from a period
      doubling the branch of doubled period is followed, from a branch point the branch that crosses
      there, to one side.
    - `stop`: the value of the parameter to end at; a pair (low, high) follows the branch both ways.
      A branch that turns back ends where it leaves this range. From a special point it goes one
      way, where a single value bounds one side.
    - `max_step`: the largest step, relative to the size of the unknowns; for an unknown that goes
      to zero, relative to a fraction of its initial value.
    - `max_points`: the largest number of points in either direction.
    - `throw`: whether to raise an error unless the outcome is `successful`; otherwise a branch that
      does not begin contains only the given orbit.

    Where a contact or a tick passes the phase t0 of the orbit, x(t0) jumps although the orbit does
    not. The branch is then shot from a phase far from them, and its orbits are converted back to
    t0. A special point there has its orbit at that other phase (`options.t0`).

    **Returns** a `Branch`. One that ends before `stop` is a success; `Branch.ended` gives the
    reason. A closed branch is followed once, and a branch of doubled period to where it joins the
    branch of half the period.

    **Outcomes**: `successful`; `newton_stalled` or `newton_singular` where Newton's method diverges
    from the orbit, which then does not belong to the system, or finds no orbit of doubled period;
    the outcome of the orbit itself if it failed, such as `nonfinite`.

    **Source**: textbook: H. Keller, Numerical solution of bifurcation and nonlinear eigenvalue
    problems, in: Applications of Bifurcation Theory (1977); H. Dankowicz, F. Schilder, Recipes for
    Continuation (2013).

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=12.0)
    >>> orbit = jf.periodic_orbit(belt, jnp.array([0.1, 0.0]))
    >>> branch = jf.continue_orbit(belt, "omega", orbit, stop=10.0)
    >>> print(branch.points[0].kind, round(branch.points[0].value, 6))
    contacts 10.904976
    """
    check.system("system", system)
    scalar_parameter(system, parameter)
    check.flags(throw=throw)
    ends, steps = limits_of(stop, max_step, max_points)
    if isinstance(orbit, SpecialPoint):
        # From its parent the branch goes one way.
        given, within = orbit.orbit, range_ahead
        curve, start, result = _off_branch(system, parameter, orbit, ends)
    elif isinstance(orbit, Orbit) and orbit.x0.ndim == 1:
        given, within = orbit, range_around
        curve, start, result = _on_branch(system, parameter, orbit, ends)
    else:
        raise ValueError(
            f"`orbit` must be a single Orbit or a SpecialPoint, got {check.told(orbit)}."
        )
    if start is None:
        branch = _not_begun(curve, given, result)
    else:
        along = within(ends, curve.value(start))
        curve, start = _known(curve, start, ends)
        branch = _branch(curve, follow(curve, start, along, *steps))
    if throw:
        # Not traced, so that it raises at once and the numbers stay NumPy arrays.
        raise_if_failed(branch.values, branch.result)
    return branch


def _on_branch(
    system: System, parameter: str, orbit: Orbit, ends: list[float]
) -> tuple[OrbitCurve, OrbitPoint | None, RESULTS]:
    """The branch of an orbit; the orbit as a point of it, if Newton's method converges; its
    outcome."""
    curve, u, constraint = _given(system, parameter, orbit, ends)
    return curve, *curve.begin(u, constraint, curve.axis(u))


def _given(
    system: System, parameter: str, orbit: Orbit, ends: list[float]
) -> tuple[OrbitCurve, np.ndarray, ArclengthConstraint]:
    """The branch of an orbit, the orbit as a guess of a point of it, and the constraint of a fixed
    parameter."""
    # A float leaf that is not an array would be static, and compile a program for each value.
    system = cast(system, orbit.x0.dtype)
    periods = 1
    if system.period is not None:
        with np.errstate(all="ignore"):
            ratio = float(np.divide(orbit.period, np.asarray(orbit.system.period)))
        # A period of NaN has no multiple; Newton's method then reports the failure.
        periods = round(ratio) if np.isfinite(ratio) else 1
    # The orbit defines the start of the branch; the system's own value is ignored.
    known = get_parameter(orbit.system, parameter)
    system = replace_parameter(system, parameter, known)
    curve = OrbitCurve(OrbitProblem(system, orbit.options, parameter, periods))
    q = [float(orbit.period), float(known)] if curve.problem.autonomous else [float(known)]
    starts = np.asarray(orbit.starts)
    u = np.append(starts.ravel(), q)
    # Before the first shot the size of a component on the orbit is unknown.
    size = np.maximum(np.max(abs(starts), axis=0), _SMALL)
    scale = np.append(np.tile(size, orbit.options.arcs), [abs(v) or 1.0 for v in q])
    scale = np.maximum(scale, least_scales(scale, curve.place, ends))
    return curve, u, constraint_across(u, scale, curve.axis(u), 0.0)


def _known(
    curve: OrbitCurve, start: OrbitPoint, ends: list[float]
) -> tuple[OrbitCurve, OrbitPoint]:
    """A curve and its start, with the least scales, and the condition that no orbit runs twice
    through another one, if the first does not."""
    least = least_scales(curve.metric(start), curve.place, ends)
    curve = dataclasses.replace(curve, least=least)
    if may_be_doubled(curve.problem):
        start = dataclasses.replace(start, half_gap=half_gap(curve.problem, start.u, start.shot))
        curve = dataclasses.replace(curve, prime=not start.is_doubled)
    return curve, start


def _off_branch(
    system: System, parameter: str, doubling: SpecialPoint, ends: list[float]
) -> tuple[OrbitCurve, OrbitPoint | None, RESULTS]:
    """The branch of doubled period at a period doubling, or the one that crosses at a branch point;
    a neighbouring point of it, if it exists; the outcome of Newton's method."""
    if doubling.kind == "branch-point":
        return _across(system, parameter, doubling, ends)
    if doubling.kind != "period-doubling":
        raise ValueError(
            f"`orbit` must be a period doubling or a branch point, got a {doubling.kind}."
        )
    single, at, result = _on_branch(system, parameter, doubling.orbit, ends)
    problem = single.problem
    if problem.options.arcs > 1:
        raise ValueError("`orbit` must be shot in one segment.")
    options = dataclasses.replace(problem.options, steps=2 * problem.options.steps)
    most = options.max_events
    if most is not None and 2 * int(doubling.orbit.num_events) > most:
        options = dataclasses.replace(options, max_events=2 * most)
    periods = problem.periods if problem.autonomous else 2 * problem.periods
    curve = OrbitCurve(OrbitProblem(problem.system, options, parameter, periods))
    if at is None:
        return curve, None, result
    return curve, *_beside(curve, *_doubled(single, at, np.asarray(doubling.orbit.monodromy)))


def _beside(
    curve: OrbitCurve,
    base: np.ndarray,
    scale: np.ndarray,
    along: np.ndarray,
    parent: np.ndarray | float = 0.0,
) -> tuple[OrbitPoint | None, RESULTS]:
    """A point of the branch at a small distance along its tangent, if it exists; the outcome of
    Newton's method. `parent` is the tangent of the branch that is left."""
    result = RESULTS.newton_stalled
    for ds in _OFF:
        constraint = constraint_across(base, scale, along, ds)
        point, result = curve.begin(base + ds * along * scale, constraint, along)
        if point is None:
            continue
        if abs(point.tangent @ along) > abs(np.sum(point.tangent * parent)):
            return point, result
        result = RESULTS.newton_stalled  # Newton's method has returned to the parent
    return None, result


def _across(
    system: System, parameter: str, point: SpecialPoint, ends: list[float]
) -> tuple[OrbitCurve, OrbitPoint | None, RESULTS]:
    """The branch that crosses at a branch point, reached along its tangent."""
    curve, u, constraint = _given(system, parameter, point.orbit, ends)

    def evaluation(u: np.ndarray) -> Evaluation:
        # One evaluation, because Newton's method does not converge where branches cross.
        return solve_across(curve.problem, array_of(u), constraint, array_of(1, jnp.int32)).at

    at = evaluation(u)
    scale, unit = np.asarray(at.unknown_scale), np.asarray(at.equation_scale)[:-1, None]

    def rows(z: np.ndarray) -> np.ndarray:
        return np.asarray(evaluation(u + z * scale).jacobian)[:-1] * scale / unit

    if not np.isfinite(rows(0 * u)).all():
        return curve, None, RESULTS.nonfinite
    parent = point.direction / scale
    parent = parent / np.linalg.norm(parent)
    return curve, *_beside(curve, u, scale, _other_tangent(rows, parent), parent)


def _other_tangent(rows: Callable[[np.ndarray], np.ndarray], parent: np.ndarray) -> np.ndarray:
    """The tangent of a curve that crosses another one, whose own tangent is known roughly. Both are
    the null vectors v of the rows F' for which wᵀ F'' v v = 0, with w the left null vector."""
    left, _, right = np.linalg.svd(rows(0 * parent))
    w, null = left[:, -1], right[-2:]
    h = np.finfo(w.dtype).eps ** _STEP
    turned = [w @ (rows(h * v) - rows(-h * v)) @ null.T / (2 * h) for v in null]
    # Of both signs where curves cross.
    (low, high), axes = np.linalg.eigh(np.array(turned))
    parts = np.sqrt(max(high, 0.0)), np.sqrt(max(-low, 0.0))
    both = [(axes * parts) @ signs @ null for signs in ([1.0, 1.0], [1.0, -1.0])]
    tangents = [v / np.linalg.norm(v) for v in both]
    return min(tangents, key=lambda v: abs(v @ parent))


def _doubled(
    single: OrbitCurve, at: OrbitPoint, monodromy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The orbit at a period doubling run through twice, as unknowns, their scale, and the direction
    in which it separates from the branch."""
    base, scale = at.u.copy(), single.metric(at)
    scale[-1] = at.scale[-1]  # not zero where the parameter is
    values, vectors = np.linalg.eig(monodromy)
    # Both sections of the new orbit lie along the eigenvector of −1, with the same parameter and
    # time up to the square of their distance.
    away = np.real(vectors[:, np.argmin(abs(values + 1))])
    if single.problem.autonomous:
        base[-2] *= 2
        scale[-2] *= 2
        # The phase is fixed across the flow, the direction of the multiplier one.
        flow = np.real(vectors[:, np.argmin(abs(values - 1))])
        away = away - (away @ flow) / (flow @ flow) * flow
    along = np.append(away, np.zeros(at.u.size - away.size)) / scale
    return base, scale, along / np.linalg.norm(along)


def _branch(curve: OrbitCurve, path: FollowedCurve[OrbitPoint]) -> Branch:
    """The `Branch` of a path."""
    problem = curve.problem
    orbits = [_orbit(curve, _at_the_phase(curve, point)) for point in path.points]
    return Branch(
        parameter=problem.parameter,
        values=np.array([curve.value(point) for point in path.points]),
        orbits=stacked(orbits),
        points=[
            SpecialPoint(
                s.kind,
                curve.value(s.point),
                _orbit(curve, s.point),
                s.index,
                s.before,
                s.after,
                s.point.tangent * s.point.scale,
            )
            for s in path.special
        ],
        sequences=tuple(point.sequence for point in path.points),
        ended=path.ended,
        periods=problem.periods,
        result=RESULTS.successful,
    )


def _orbit(curve: OrbitCurve, point: OrbitPoint) -> Orbit:
    """The orbit of a point, at the phase at which it was shot."""
    problem = curve.problem
    return orbit_of(problem if point.t0 is None else problem_at(problem, point.t0), point)


def _at_the_phase(curve: OrbitCurve, point: OrbitPoint) -> OrbitPoint:
    """A point converted to the phase of the branch, if it was shot from another one, and no contact
    is at that phase."""
    if point.t0 is None:
        return point
    return curve.seen_again(problem_at(curve.problem, point.t0), point) or point


def _not_begun(curve: OrbitCurve, orbit: Orbit, result: RESULTS) -> Branch:
    """A branch with the given orbit alone; its own failure takes precedence."""
    value = float(get_parameter(orbit.system, curve.parameter))
    why = f"no branch was found at {value:.10g}"
    return Branch(
        parameter=curve.parameter,
        values=np.array([value]),
        orbits=stacked([orbit]),
        points=[],
        sequences=(contacts_of(orbit.events),),
        ended=(why, why),
        periods=curve.problem.periods,
        result=RESULTS.where(orbit.result == RESULTS.successful, result, orbit.result),
    )
