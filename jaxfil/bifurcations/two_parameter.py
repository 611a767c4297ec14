"""`continue_bifurcation`: a bifurcation in the plane of two parameters.

A located bifurcation and the names of two parameters enter; the curve on which it goes on leaves,
with the points of codimension two at which its kind changes.
"""

import dataclasses
import itertools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.bifurcations.defining_system import DefiningSystem, defining_system
from jaxfil.bifurcations.locate import BIFURCATION_KINDS, Bifurcation
from jaxfil.bifurcations.tangency import conditions, kind_of
from jaxfil.model import check
from jaxfil.model.card import precision
from jaxfil.model.deprecation import renamed_argument
from jaxfil.model.drawing import draw
from jaxfil.model.labels import Labels, labels_of
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast, get_parameter
from jaxfil.model.system import System
from jaxfil.orbits.corrector import ArclengthConstraint
from jaxfil.orbits.newton import Evaluation, Root, newton

_NEWTON_STEPS = 12
_FIRST, _LEAST = 0.01, 1e-6


class CodimensionTwo(eqx.Module):
    """Where the kind changes along a curve."""

    values: Float[np.ndarray, "2"]
    before: str = eqx.field(static=True)
    after: str = eqx.field(static=True)


class BifurcationCurve(eqx.Module):
    """A bifurcation in two parameters: `values` (k, 2), the touch at `ts` (k,) in `xs` (k, n), and
    the kind at each point."""

    parameters: tuple[str, str] = eqx.field(static=True)
    values: Float[np.ndarray, "k 2"]
    ts: Float[np.ndarray, " k"]
    xs: Float[np.ndarray, "k n"]
    kinds: tuple[str, ...] = eqx.field(static=True)
    points: list[CodimensionTwo]
    ended: tuple[str, str] = eqx.field(static=True)
    labels: Labels = eqx.field(static=True, default=Labels())
    """What pictures call the parameters."""

    def plot(self, ax: Any = None) -> Any:
        """Draw the curve in the plane of its two parameters; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        a, b = self.parameters
        low, high = self.values.min(axis=0), self.values.max(axis=0)
        lines = [
            f"BifurcationCurve{precision(self.xs)}, {len(self.values)} points: "
            f"{', '.join(dict.fromkeys(self.kinds))}",
            f"  {a} from {low[0]:.6g} to {high[0]:.6g}, {b} from {low[1]:.6g} to {high[1]:.6g}",
            f"  ends: {self.ended[0]}; {self.ended[1]}",
        ]
        for point in self.points:
            where = f"{a} = {point.values[0]:.10g}, {b} = {point.values[1]:.10g}"
            lines.append(f"  {point.before} to {point.after} at {where}")
        return "\n".join(lines)


@renamed_argument("names", "parameters")
def continue_bifurcation(
    system: System,
    parameters: tuple[str, str],
    bifurcation: Bifurcation,
    *,
    stop: tuple[float, float],
    max_step: float = 0.03,
    max_points: int = 1000,
) -> BifurcationCurve:
    """The curve of a bifurcation in two parameters, by pseudo-arclength, in both directions.

    **Arguments**

    - `parameters`: two parameters; the bifurcation was found in either of them.
    - `stop`: the range (low, high) of the first one at which to stop.
    - `max_step`: largest step, relative to the size of the unknowns.
    - `max_points`: the most points in either direction.

    **Returns** a `BifurcationCurve`. It ends early where the touch ceases to be one of the orbit.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system = jf.systems.SDOscillator(omega=0.84)
    >>> orbit = jf.periodic_orbit(system, jnp.array([1.9, 0.0]))
    >>> graze = jf.find_bifurcation(system, "omega", orbit, "grazing")
    >>> curve = jf.continue_bifurcation(system, ("omega", "f0"), graze, stop=(0.84, 0.9))
    >>> omega, f0 = curve.values[-1]
    >>> bool(abs(f0**2 - (1 - omega**2) ** 2 - (2 * 0.0141 * omega) ** 2) < 1e-12)
    True
    """
    check.system("system", system)
    if len(parameters) != 2 or parameters[0] == parameters[1]:
        raise ValueError(f"`parameters` must be two different parameters, got {parameters!r}.")
    for name in parameters:
        get_parameter(system, name)
    if not isinstance(bifurcation, Bifurcation) or bifurcation.value.ndim:
        raise ValueError(f"`bifurcation` must be a single Bifurcation, got {bifurcation!r}.")
    system = cast(system, bifurcation.x.dtype)
    at = bifurcation.orbit
    values = [float(get_parameter(at.system, name)) for name in parameters]
    low, high = (float(v) for v in stop)
    if not low <= values[0] <= high:
        raise ValueError(f"`stop` must be (low, high) around {values[0]}, got {stop!r}.")
    free = parameters[0], parameters[1]
    equations = defining_system(
        at.system, at, bifurcation.tangency, bifurcation.family, free, _NEWTON_STEPS
    )
    problem = _Problem(at.system, equations)
    # The flight is given in phases: t0 stays that of the orbit's own plan.
    phase = at.period if system.period is None else bifurcation.tangency.phase
    u = np.concatenate([bifurcation.tangency.x, [float(phase)], values])
    walks = [_walk(problem, u, sign, low, high, max_step, max_points) for sign in (-1.0, 1.0)]
    (back, ended_back), (ahead, ended) = walks
    points = back[:0:-1] + ahead
    kinds = tuple(_KIND_NAMES[p.code] for p in points)
    changes = [_change(problem, a, b) for a, b in itertools.pairwise(points) if a.code != b.code]
    return BifurcationCurve(
        parameters=(parameters[0], parameters[1]),
        values=np.array([p.u[-2:] for p in points]),
        ts=np.array([p.t for p in points]),
        xs=np.array([p.x for p in points]),
        kinds=kinds,
        points=changes,
        ended=(ended_back, ended),
        labels=labels_of(system, bifurcation.x.shape[-1]).of((parameters[0], parameters[1])),
    )


_KIND_NAMES = (*BIFURCATION_KINDS, "undecided")


@dataclasses.dataclass(frozen=True)
class _Point:
    u: np.ndarray
    scale: np.ndarray
    tangent: np.ndarray
    t: float
    x: np.ndarray
    code: int
    holds: bool
    monitors: np.ndarray


class _Problem(eqx.Module):
    system: System
    equations: DefiningSystem


@eqx.filter_jit
def _correct(problem: _Problem, u: Array, plane: ArclengthConstraint) -> tuple:
    """Newton's root in a plane, and what is known of the touch there."""

    def evaluate(u: Array) -> Evaluation:
        at = problem.equations.evaluate(problem.system, u)
        gap = plane.normal @ ((u - plane.base) / plane.scale) - plane.offset
        return Evaluation(
            jnp.append(at.residual, gap),
            jnp.concatenate([at.jacobian, (plane.normal / plane.scale)[None]]),
            jnp.append(at.equation_scale, 1.0),
            at.unknown_scale,
            at.result,
            at.aux,
        )

    root: Root = newton(evaluate, u, _NEWTON_STEPS)
    system, _, tangency = problem.equations.placed(problem.system, root.z)
    closing = root.at.aux
    found = conditions(system, closing.t, closing.x, tangency)
    flags = jnp.stack(kind_of(problem.equations.family, found, float(jnp.finfo(u.dtype).eps)))
    code = jnp.where(jnp.any(flags), jnp.argmax(flags), -1)
    monitors = jnp.stack([found.bend, found.other_rate, found.slide_bend])
    return root, closing.t, closing.x, closing.size, code, closing.holds, monitors


def _at(
    problem: _Problem, guess: np.ndarray, plane: ArclengthConstraint, along: np.ndarray
) -> _Point | None:
    root, t, x, size, code, real, monitors = _correct(problem, jnp.asarray(guess), plane)
    if not bool(root.result == RESULTS.successful):
        return None
    u, q = np.asarray(root.z), abs(np.asarray(root.z)[x.shape[0] :])
    scale = np.append(np.where(size == 0, 1, size), np.where(q == 0, 1, q))
    tangent = np.linalg.svd(np.asarray(root.at.jacobian)[:-1] * scale)[2][-1]
    tangent = tangent if tangent @ along >= 0 else -tangent
    return _Point(
        u, scale, tangent, float(t), np.asarray(x), int(code), bool(real), np.asarray(monitors)
    )


def _plane(
    base: np.ndarray, scale: np.ndarray, normal: np.ndarray, offset: float
) -> ArclengthConstraint:
    return ArclengthConstraint(*(jnp.asarray(v) for v in (base, scale, normal, offset)))


def _walk(
    problem: _Problem,
    u: np.ndarray,
    sign: float,
    low: float,
    high: float,
    max_step: float,
    max_points: int,
) -> tuple[list[_Point], str]:
    """Points in one direction, and why they end."""
    first_parameter = np.zeros_like(u)
    first_parameter[-2] = 1.0
    scale = np.where(u == 0, 1.0, abs(u))
    here = _at(problem, u, _plane(u, scale, first_parameter, 0.0), sign * first_parameter)
    if here is None:
        raise ValueError("`bifurcation` must be one of `system`: Newton's method left it.")
    points, ds = [here], min(_FIRST, max_step)
    while len(points) < max_points:
        here = points[-1]
        plane = _plane(here.u, here.scale, here.tangent, ds)
        ahead = _at(problem, here.u + ds * here.tangent * here.scale, plane, here.tangent)
        cosine = 0.0 if ahead is None else _cosine(here, ahead)
        if ahead is None or cosine < 0.9:
            ds *= 0.5
            if ds < _LEAST:
                return points, f"no touch was found beyond {_told(here)}"
            continue
        if not ahead.holds:
            return points, f"the orbit meets the surface elsewhere beyond {_told(here)}"
        end = next(
            (
                v
                for v in (low, high)
                if (here.u[-2] - v) * (ahead.u[-2] - v) <= 0 and here.u[-2] != v
            ),
            None,
        )
        if end is not None:
            part = (end - here.u[-2]) / (ahead.u[-2] - here.u[-2])
            base = here.u + part * (ahead.u - here.u)
            base[-2] = end
            last = _at(problem, base, _plane(base, here.scale, first_parameter, 0.0), here.tangent)
            return [*points, last or ahead], f"{problem.equations.free[0]} = {end:.10g} was reached"
        points.append(ahead)
        ds = min(max_step, 1.5 * ds) if cosine > 0.99 else ds
    return points, f"{max_points} points were made"


def _told(point: _Point) -> str:
    return f"({point.u[-2]:.8g}, {point.u[-1]:.8g})"


def _cosine(a: _Point, b: _Point) -> float:
    tangent = b.tangent * b.scale / a.scale
    return float(a.tangent @ tangent / np.linalg.norm(tangent))


def _change(problem: _Problem, a: _Point, b: _Point) -> CodimensionTwo:
    """Where the kind changes between two neighbours, by bisection."""
    before, after = a, b
    for _ in range(45):
        base = 0.5 * (before.u + after.u)
        normal = (after.u - before.u) / before.scale
        length = np.linalg.norm(normal)
        if length < 1e-12:
            break
        middle = _at(problem, base, _plane(base, before.scale, normal / length, 0.0), a.tangent)
        if middle is None:
            break
        before, after = (middle, after) if middle.code == a.code else (before, middle)
    names = _KIND_NAMES[a.code], _KIND_NAMES[b.code]
    return CodimensionTwo(0.5 * (before.u[-2:] + after.u[-2:]), *names)
