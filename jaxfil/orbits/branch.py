"""`continue_orbit`: a branch of periodic orbits by pseudo-arclength continuation.

A system, the name of a parameter and an orbit enter; a `Branch` leaves: orbits along the curve, and
the special points on it: folds, period doublings, Neimark–Sacker points, and every value where the
sequence of contacts changes.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfil.model import check
from jaxfil.model.card import precision
from jaxfil.model.deprecation import renamed_argument
from jaxfil.model.drawing import draw
from jaxfil.model.parameter import cast, get_parameter, replace_parameter
from jaxfil.model.system import System
from jaxfil.orbits.corrector import (
    OrbitProblem,
    Point,
    constraint_across,
    correct,
    metric,
    orbit_of,
)
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.periodic_orbit import periodic_orbit
from jaxfil.orbits.pseudo_arclength import follow


class SpecialPoint(eqx.Module):
    """Where a branch changes its character: `kind` is "fold", "period-doubling", "neimark-sacker"
    or "contacts" (the sequence of contacts changes there, from `before` to `after`)."""

    kind: str = eqx.field(static=True)
    value: float
    orbit: Orbit
    index: int = eqx.field(static=True)
    before: tuple = eqx.field(static=True)
    after: tuple = eqx.field(static=True)

    def __repr__(self) -> str:
        more = f": {len(self.before)} to {len(self.after)} contacts" * (self.kind == "contacts")
        return f"{self.kind} at {self.value:.12g}{more}"


class Branch(eqx.Module):
    """Orbits along a curve: `orbits` is one `Orbit` whose arrays have a leading axis of k points;
    `values` (k,) is the parameter. `ended` says why the curve ends where it does."""

    parameter: str = eqx.field(static=True)
    values: Float[np.ndarray, " k"]
    orbits: Orbit
    points: list[SpecialPoint]
    sequences: tuple = eqx.field(static=True)
    ended: tuple[str, str] = eqx.field(static=True)
    periods: int = eqx.field(static=True)

    @property
    def stable(self) -> np.ndarray:
        """Which orbits are stable, shape (k,)."""
        return np.asarray(self.orbits.stable)

    def at(self, value: float) -> list[Orbit]:
        """The orbits of the branch at a value of the parameter, in its order."""
        found = []
        xs, ahead = np.asarray(self.orbits.x0), np.asarray(self.values) - value
        after = np.append(ahead[1:], np.nan)
        for i in np.flatnonzero((ahead * after < 0) | (ahead == 0)):
            part = 0.0 if ahead[i] == 0 else ahead[i] / (ahead[i] - after[i])
            next_ = min(i + 1, len(xs) - 1)
            one = jax.tree.map(lambda v, i=i: v[i], self.orbits)
            period = None if one.system.period is not None else one.period
            found.append(
                periodic_orbit(
                    replace_parameter(one.system, self.parameter, value),
                    jnp.asarray(xs[i] + part * (xs[next_] - xs[i])),
                    periods=self.periods,
                    period=period,
                    t0=one.options.t0,
                    steps=one.options.steps // self.periods,
                    stepper=one.options.stepper,
                    segments=one.options.arcs,
                    max_events=one.options.max_events,
                )
            )
        return found

    def extremes(self) -> tuple[np.ndarray, np.ndarray]:
        """The smallest and the largest value of each component on every orbit, each (k, n)."""
        least, most = _extremes(self.orbits)
        return np.asarray(least), np.asarray(most)

    def plot(self, ax: Any = None, component: int = 0, extremes: bool = False) -> Any:
        """Draw one component of x0, or its smallest and largest value on the orbit, against the
        parameter: unstable parts dashed, with the special points. Returns the matplotlib axes."""
        return draw(self, ax=ax, component=component, extremes=extremes)

    def __repr__(self) -> str:
        lines = [
            f"Branch of {type(self.orbits.system).__name__}{precision(self.orbits.x0)}: "
            f"{len(self.values)} orbits, "
            f"{self.parameter} from {self.values[0]:.6g} to {self.values[-1]:.6g} "
            f"(range {self.values.min():.6g} to {self.values.max():.6g})",
            f"  ends: {self.ended[0]}; {self.ended[1]}",
        ]
        return "\n".join(lines + [f"  {point}" for point in self.points])


@renamed_argument("name", "parameter")
def continue_orbit(
    system: System,
    parameter: str,
    orbit: Orbit | SpecialPoint,
    *,
    stop: float | tuple[float, float],
    max_step: float = 0.02,
    max_points: int = 2000,
) -> Branch:
    """The branch of periodic orbits through `orbit` as `parameter` varies.

    Pseudo-arclength: a step along the tangent, then Newton in the plane across it, so that folds
    are no obstacle. Steps adapt to the curve. Special points are located on the way to about 1e-10
    of the parameter.

    **Arguments**

    - `orbit`: where to start, as `periodic_orbit` gives it (or a period doubling of another
      branch, from which the branch of doubled period is followed).
    - `stop`: the value of the parameter to end at; a pair of values follows the branch both ways,
      down to the one and up to the other. A branch that turns back ends where it leaves this range.
    - `max_step`: largest step, relative to the size of the unknowns.
    - `max_points`: the most points in either direction.

    **Returns** a `Branch`.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=12.0)
    >>> orbit = jf.periodic_orbit(belt, jnp.array([0.1, 0.0]))
    >>> branch = jf.continue_orbit(belt, "omega", orbit, stop=10.0)
    >>> print(branch.points[0].kind, round(branch.points[0].value, 6))
    contacts 10.904976
    """
    check.system("system", system)
    if np.ndim(get_parameter(system, parameter)):
        raise ValueError(f"`parameter` must be a scalar parameter, but {parameter!r} is an array.")
    max_points = check.count("max_points", max_points)
    max_step = float(check.scalar("max_step", max_step, float, positive=True))
    along = None
    if isinstance(orbit, SpecialPoint):
        family, start, along = _doubled(system, parameter, orbit)
    elif isinstance(orbit, Orbit) and orbit.x0.ndim == 1:
        family = _family(system, parameter, orbit)
        start = _first(family, orbit)
    else:
        raise ValueError(f"`orbit` must be a single Orbit or a SpecialPoint, got {orbit!r}.")
    if start is None:
        raise ValueError("`orbit` must be a periodic orbit of `system`: Newton's method left it.")
    low, high, ways = _range(stop, start.value)
    walks = []
    for sign in ways:
        tangent = start.tangent * np.sign(start.tangent[-1] or 1.0) * sign
        tangent = tangent if along is None else along * sign
        first = dataclasses.replace(start, tangent=tangent)
        walks.append(follow(family, first, low, high, max_step, max_points))
    return _assemble(family, parameter, walks)


@eqx.filter_jit
def _extremes(orbits: Orbit) -> Any:
    return eqx.filter_vmap(lambda orbit: orbit.extremes())(orbits)


def _range(stop: Any, value: float) -> tuple[float, float, tuple[float, ...]]:
    """The range of the parameter and the directions in which to go."""
    try:
        ends = np.asarray(stop, float)
    except (TypeError, ValueError):
        ends = np.asarray(np.nan)
    if ends.shape not in ((), (2,)) or not np.isfinite(ends).all():
        raise ValueError(f"`stop` must be a number or a pair (low, high), got {stop!r}.")
    if ends.ndim == 0:
        end = float(ends)
        if end == value:
            raise ValueError(f"`stop` must differ from the value at the orbit, got {end}.")
        return min(end, value), max(end, value), (float(np.sign(end - value)),)
    low, high = ends.tolist()
    ways = (-1.0,) * (low < value) + (1.0,) * (value < high)
    if not low <= value <= high or not ways:
        raise ValueError(f"`stop` must be (low, high) around the value {value}, got {stop}.")
    return low, high, ways


def _family(system: System, parameter: str, orbit: Orbit) -> OrbitProblem:
    system = cast(system, orbit.x0.dtype)
    periods = 1
    if system.period is not None:
        ratio = float(orbit.period) / float(orbit.system.period)  # pyright: ignore
        periods = round(ratio)
    value = get_parameter(orbit.system, parameter)
    return OrbitProblem(
        replace_parameter(system, parameter, value), orbit.options, parameter, periods
    )


def _first(family: OrbitProblem, orbit: Orbit) -> Point | None:
    value = float(get_parameter(orbit.system, family.parameter))
    q = [float(orbit.period), value] if family.autonomous else [value]
    u = np.append(np.asarray(orbit.starts).ravel(), q)
    normal = np.zeros_like(u)
    normal[-1] = 1.0
    size = np.maximum(np.max(abs(np.asarray(orbit.starts)), axis=0), 1e-3)
    scale = np.append(np.tile(size, family.options.arcs), [abs(v) or 1.0 for v in q])
    point = correct(family, u, constraint_across(u, scale, normal, 0.0), normal)
    if point is None:
        return None
    return correct(
        family, point.u, constraint_across(point.u, metric(family, point), normal, 0.0), normal
    )


def _doubled(
    system: System, parameter: str, point: SpecialPoint
) -> tuple[OrbitProblem, Point, np.ndarray]:
    """The branch of doubled period at a period doubling: its family, a point, its direction."""
    if point.kind != "period-doubling":
        raise ValueError(f"`orbit` must be a period doubling, got a {point.kind}.")
    single = _family(system, parameter, point.orbit)
    options = dataclasses.replace(single.options, steps=2 * single.options.steps)
    if options.arcs > 1 or single.autonomous:
        raise ValueError("`orbit` must be of a forced system and shot in one segment.")
    family = OrbitProblem(single.system, options, parameter, 2 * single.periods)
    values, vectors = np.linalg.eig(np.asarray(point.orbit.monodromy))
    vector = np.real(vectors[:, np.argmin(abs(values + 1))])
    first = _first(single, point.orbit)
    assert first is not None
    scale = metric(single, first)
    along = np.append(vector, 0.0) / scale
    along /= np.linalg.norm(along)
    for ds in (1e-2, 3e-3, 1e-3):
        plane = constraint_across(first.u, scale, along, ds)
        found = correct(family, first.u + ds * along * scale, plane, along)
        if found is not None:
            return family, found, found.tangent
    raise ValueError(f"`orbit`: no orbit of doubled period was found near {point.value}.")


def _assemble(family: OrbitProblem, parameter: str, walks: list[tuple]) -> Branch:
    """Both directions in one branch, in order."""
    points, special, ended = walks[-1][0], [], [f"start at {walks[-1][0][0].value:.10g}"]
    shift = 0
    if len(walks) == 2:
        back = walks[0][0]
        shift = len(back) - 1
        points = back[:0:-1] + points
        special = [
            (kind, point, after, before, shift - i + 1)
            for kind, point, before, after, i in reversed(walks[0][1])
        ]
        ended = [walks[0][2]]
    special = special + [(*rest, i + shift) for *rest, i in walks[-1][1]]
    orbits = [orbit_of(family, point) for point in points]
    dynamic = [eqx.filter(orbit, eqx.is_array) for orbit in orbits]
    stacked = jax.tree.map(lambda *v: jnp.stack(v), *dynamic)
    return Branch(
        parameter=parameter,
        values=np.array([point.value for point in points]),
        orbits=eqx.combine(stacked, eqx.filter(orbits[0], eqx.is_array, inverse=True)),
        points=[
            SpecialPoint(kind, point.value, orbit_of(family, point), i, before, after)
            for kind, point, before, after, i in special
        ],
        sequences=tuple(point.sequence for point in points),
        ended=(ended[0], walks[-1][2]),
        periods=family.periods,
    )
