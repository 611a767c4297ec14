"""`continue_bifurcation`: a bifurcation as two parameters vary, with points of codimension two."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxfil.bifurcations.critical_curve import CriticalPoint, begin_critical
from jaxfil.bifurcations.critical_vectors import VECTORS
from jaxfil.bifurcations.defining_system import defining_system
from jaxfil.bifurcations.locate import Bifurcation
from jaxfil.bifurcations.tangency import FAMILY_NAMES
from jaxfil.bifurcations.tangency_curve import TangencyCurve, TangencyPoint
from jaxfil.model import check
from jaxfil.model.labels import Labels, labels_of
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import get_parameter, two_parameters
from jaxfil.model.system import System
from jaxfil.orbits.branch import SpecialPoint
from jaxfil.orbits.curve import constraint_across, least_scales
from jaxfil.orbits.plane_curve import PlaneCurve
from jaxfil.orbits.pseudo_arclength import follow, limits_of, range_around

# A guess from a neighbour converges in a few steps or not at all.
_NEWTON_STEPS = 12


CODIMENSION_TWO_KINDS = (
    "cusp",
    "two-fold",
    "double-tangency",
    "fold",
    "period-doubling",
    "neimark-sacker",
    "generalised-doubling",
    "tangency",
    "1:1",
    "1:2",
    "1:3",
    "1:4",
)
"""The kinds of points of codimension two that `continue_bifurcation` locates.

On curves of tangencies:

- `"cusp"`: the tangency is cubic, Ḧ_s = 0 too (on a slide, the second derivative of Ḣ_s along it).
- `"two-fold"`: the fields of both sides are tangent.
- `"double-tangency"`: the orbit is tangent to a surface, this one or another, a second time, as in
  a double grazing; contacts appear or disappear elsewhere on it.

On all curves:

- `"fold"`, `"period-doubling"`, `"neimark-sacker"`: another multiplier of the orbit, in addition to
  the critical ones of the curve, is 1, −1, or a complex pair is on the unit circle.

On curves of smooth bifurcations:

- `"cusp"`: the quadratic coefficient of a fold vanishes, and two curves of folds end.
- `"generalised-doubling"`: the cubic coefficient of a period doubling vanishes; the doubled orbit
  changes from stable to unstable, and a curve of its folds begins.
- `"tangency"`: the orbit is tangent to a surface, as where a fold coincides with a graze; contacts
  appear or disappear, or the curve ends.
- `"1:1"`, `"1:2"`: two multipliers are 1, or −1. The curve of a pair on the unit circle ends there.
- `"1:3"`, `"1:4"`: a pair of multipliers is e^{±2πi/3} or ±i.
"""


class CodimensionTwo(eqx.Module):
    """A point of codimension two on a curve: the bifurcation degenerates, the orbit is tangent to a
    surface elsewhere, or another multiplier reaches the unit circle."""

    kind: str = eqx.field(static=True)
    """One of `CODIMENSION_TWO_KINDS`."""
    values: Float[np.ndarray, "2"]
    """The two parameters at this point."""
    before: str = eqx.field(static=True)
    """The kind before it, in the order of the curve."""
    after: str = eqx.field(static=True)
    """The kind after it."""


class BifurcationCurve(PlaneCurve):
    """A curve of k bifurcations of periodic orbits in two parameters. `xs` are the states at `ts`;
    `kinds` are of `BIFURCATION_KINDS`, "undecided", or that of the `SpecialPoint` at the start."""

    ts: Float[np.ndarray, " k"]
    """The time of the tangency; for a smooth bifurcation, the start of the orbit."""
    points: list[CodimensionTwo]
    """Points of codimension two, in the order of the curve."""

    def __repr__(self) -> str:
        (a, b), lines = self.parameters, [super().__repr__()]
        for point in self.points:
            where = f"{a} = {point.values[0]:.10g}, {b} = {point.values[1]:.10g}"
            change = "" if point.before == point.after else f": {point.before} to {point.after}"
            lines.append(f"  {point.kind} at {where}{change}")
        return "\n".join(lines)


def continue_bifurcation(
    system: System,
    parameters: tuple[str, str],
    bifurcation: Bifurcation | SpecialPoint,
    *,
    stop: float | tuple[float, float],
    max_step: float = 0.03,
    max_points: int = 1000,
    throw: bool = True,
) -> BifurcationCurve:
    """Follow a bifurcation in two parameters.

        tangency           the defining system of `find_bifurcation`
        fold               x(t0 + T; x0) = x0,  J v = 0
        period doubling    x(t0 + T; x0) = x0,  M v = −v
        Neimark–Sacker     x(t0 + T; x0) = x0,  M v = w,  M w = 2κ w − v
        branch point       x(t0 + T; x0) = x0 − β b,  Jᵀ w = 0,  G_pᵀ w = 0

    by pseudo-arclength continuation, with both parameters p among the unknowns. M is the monodromy
    matrix, exact through every contact, J and G_p the derivatives of the closure by state (and
    period) and by a parameter. β is zero at a branch point, and stays zero due to a symmetry or an
    invariant plane; without one the branches no longer cross, and the curve ends where it starts.
    Points of codimension two, each of one of `CODIMENSION_TWO_KINDS`, are located on the curve.

    **Arguments**

    - `system`: the `System`.
    - `parameters`: the names of two scalar parameters, in one of which the bifurcation was located.
    - `bifurcation`: the start, from `find_bifurcation`, or a special point of a branch from
      `continue_orbit`: a fold, period doubling, Neimark–Sacker or branch point. It defines the
      values of all parameters.
    - `stop`: the value of the first parameter to end at; a pair (low, high) follows the curve both
      ways.
    - `max_step`: the largest step, relative to the size of the unknowns.
    - `max_points`: the largest number of points in either direction.
    - `throw`: whether to raise an error unless the outcome is `successful`; otherwise a curve that
      does not begin contains only the given bifurcation.

    **Returns** a `BifurcationCurve`. One that ends before `stop`, where the orbit has a contact
    elsewhere, multipliers coincide or Newton's method fails, is a success; `BifurcationCurve.ended`
    gives the reason. It has no derivatives.

    **Outcomes**: `successful`; `newton_stalled` or `newton_singular` where Newton's method diverges
    from the bifurcation; the outcome of the bifurcation itself if it failed, such as
    `no_tangency_found` or `orbit_lost`.

    **Source**: curves and their points of codimension two: P. Kowalczyk et al., Two-parameter
    discontinuity-induced bifurcations of limit cycles, Int. J. Bifurcation and Chaos 16 (2006); of
    smooth bifurcations: Yu. A. Kuznetsov, Elements of Applied Bifurcation Theory (2004), chapters 9
    and 10.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> system = jf.systems.SDOscillator(omega=0.84)
    >>> orbit = jf.periodic_orbit(system, jnp.array([1.9, 0.0]))
    >>> graze = jf.find_bifurcation(system, "omega", orbit, "grazing")
    >>> curve = jf.continue_bifurcation(system, ("omega", "f0"), graze, stop=(0.84, 0.9))
    >>> omega, f0 = curve.values[-1]
    >>> bool(abs(f0**2 - (1 - omega**2) ** 2 - (2 * 0.0141 * omega) ** 2) < 1e-12)
    True
    """
    check.system("system", system)
    free = two_parameters(system, parameters)
    check.flags(throw=throw)
    _check_start(bifurcation)
    ends, steps = limits_of(stop, max_step, max_points)
    names = labels_of(bifurcation.orbit.system, bifurcation.orbit.x0.shape[-1]).of(free)
    smooth = isinstance(bifurcation, SpecialPoint)
    begin: Callable[..., tuple[Any, Any, RESULTS]] = begin_critical if smooth else _on_curve
    curve, start, result = begin(bifurcation, free)
    if start is None:
        found = _not_begun(bifurcation, free, result, names)
    else:
        found = _curve(curve, start, ends, steps, names)
    if throw:
        # Not traced, so that it raises at once and the numbers stay NumPy arrays.
        raise_if_failed(found.values, found.result)
    return found


def _on_curve(
    bifurcation: Bifurcation, free: tuple[str, str]
) -> tuple[TangencyCurve, TangencyPoint | None, RESULTS]:
    """The curve; the bifurcation as a point of it, if Newton's method converges; its outcome."""
    at, tangency = bifurcation.orbit, bifurcation.tangency
    family = FAMILY_NAMES.index(bifurcation.family)
    equations = defining_system(at.system, at, tangency, family, free, _NEWTON_STEPS)
    curve = TangencyCurve(equations, system=at.system)
    # The flight is in phases; t0 is taken from the orbit's own options.
    phase = at.period if at.system.period is None else tangency.phase
    values = [float(get_parameter(at.system, name)) for name in free]
    u = np.concatenate([np.ravel(tangency.starts), [float(phase)], values])
    axis = curve.axis(u)
    constraint = constraint_across(u, np.where(u == 0, 1.0, abs(u)), axis, 0.0)
    return curve, *curve.begin(u, constraint, axis)


def _curve(
    curve: Any,
    start: TangencyPoint | CriticalPoint,
    ends: list[float],
    steps: tuple[float, int],
    labels: Labels,
) -> BifurcationCurve:
    """The curve followed from a point."""
    least = least_scales(curve.metric(start), curve.place, ends)
    curve = dataclasses.replace(curve, least=least)
    path = follow(curve, start, range_around(ends, curve.value(start)), *steps)
    first, second = curve.equations.free
    return BifurcationCurve(
        parameters=(first, second),
        values=np.array([p.u[-2:] for p in path.points]),
        ts=np.array([p.t for p in path.points]),
        xs=np.array([p.x for p in path.points]),
        kinds=tuple(p.kind for p in path.points),
        points=[CodimensionTwo(s.kind, s.point.u[-2:], s.before, s.after) for s in path.special],
        ended=path.ended,
        result=RESULTS.successful,
        labels=labels,
    )


def _not_begun(
    bifurcation: Bifurcation | SpecialPoint, free: tuple[str, str], result: RESULTS, labels: Labels
) -> BifurcationCurve:
    """A curve with the given bifurcation alone; its own failure takes precedence."""
    orbit = bifurcation.orbit
    values = np.array([float(get_parameter(orbit.system, name)) for name in free])
    why = f"no curve was found at ({values[0]:.8g}, {values[1]:.8g})"
    if isinstance(bifurcation, SpecialPoint):
        own, t, x = orbit.result, orbit.options.t0, orbit.x0
    else:
        own, t, x = bifurcation.result, bifurcation.t, bifurcation.x
    located = (own == RESULTS.successful) | (own == RESULTS.other_kind)
    return BifurcationCurve(
        parameters=free,
        values=values[None],
        ts=np.asarray(t)[None],
        xs=np.asarray(x)[None],
        kinds=(str(bifurcation.kind),),
        points=[],
        ended=(why, why),
        result=RESULTS.where(located, result, own),
        labels=labels,
    )


def _check_start(bifurcation: object) -> None:
    """Check the start of a curve."""
    if isinstance(bifurcation, Bifurcation) and not bifurcation.value.ndim:
        return
    if isinstance(bifurcation, SpecialPoint) and bifurcation.kind in VECTORS:
        return
    raise ValueError(
        f"`bifurcation` must be a single Bifurcation, or a SpecialPoint of kind "
        f"{', '.join(VECTORS)}, got {_told(bifurcation)}."
    )


def _told(bifurcation: object) -> str:
    if isinstance(bifurcation, SpecialPoint):
        return f"one of kind {bifurcation.kind}"
    return check.told(bifurcation)
