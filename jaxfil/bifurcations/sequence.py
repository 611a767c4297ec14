"""`find_bifurcations`: all bifurcations of an orbit between two values of a parameter."""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import numpy as np

from jaxfil.bifurcations.candidates import tangency_candidates
from jaxfil.bifurcations.locate import BIFURCATION_KINDS, Bifurcation, find_bifurcation
from jaxfil.model import check
from jaxfil.model.card import outcome, precision
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS, code
from jaxfil.model.parameter import cast, replace_parameter
from jaxfil.model.system import System
from jaxfil.model.types import Axes
from jaxfil.orbits.branch import Branch, SpecialPoint
from jaxfil.orbits.continue_orbit import continue_orbit
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.known import part_of


class BifurcationSequence(eqx.Module):
    """A branch of periodic orbits and its bifurcations, in the order of the branch. It can be
    iterated over."""

    branch: Branch
    """The branch."""
    bifurcations: list[Bifurcation | SpecialPoint]
    """A `Bifurcation` where the orbit is tangent to a surface; a `SpecialPoint` for folds, period
    doublings and Neimark–Sacker points, where rest begins or ceases, and for changes of contacts
    without a name."""
    indices: list[int]
    """For each of them the number of the orbit of the branch that follows it, as in
    `SpecialPoint.index`; of the orbit itself at an end of the branch."""

    @property
    def result(self) -> RESULTS:
        """The outcome at the start of the branch, as in `Branch.result`."""
        return self.branch.result

    def __iter__(self) -> Iterator[Bifurcation | SpecialPoint]:
        return iter(self.bifurcations)

    def __len__(self) -> int:
        return len(self.bifurcations)

    def plot(self, ax: Axes | None = None, component: int = 0, extremes: bool = False) -> Axes:
        """Draw the branch like `Branch.plot`, with every bifurcation marked by its kind, numbered
        and named; returns the matplotlib axes."""
        return draw(self, ax=ax, component=component, extremes=extremes)

    def __repr__(self) -> str:
        name = self.branch.parameter
        system, told = self.branch.orbits.system, precision(self.branch.orbits.x0)
        rows = [
            f"BifurcationSequence of {type(system).__name__} in {name}, {len(self)} found{told}"
        ]
        for b in self.bifurcations:
            t = f", t = {float(b.t):.6g}" if isinstance(b, Bifurcation) else ""
            state = b.x if isinstance(b, Bifurcation) else b.orbit.x0
            x = ", ".join(f"{float(v):.6g}" for v in state)
            rows.append(f"  {b.kind:<18} {name} = {float(b.value):<18.13g} x = ({x}){t}")
        rows.append(f"  {outcome(self.result)}")
        return "\n".join([*rows, f"  ends: {'; '.join(self.branch.ended)}"])


def find_bifurcations(
    system: System,
    parameter: str,
    orbit: Orbit,
    *,
    stop: float | tuple[float, float],
    max_step: float = 0.02,
    max_points: int = 2000,
    throw: bool = True,
) -> BifurcationSequence:
    """Find all bifurcations of a periodic orbit as a parameter goes to `stop`.

    The branch is followed by `continue_orbit`; each change of the contacts on it, and an end beyond
    which there is no orbit, is then located again as a tangency, as `find_bifurcation` does, and
    named by its conditions.

    **Arguments**

    - `system`: the `System`.
    - `parameter`: the name of a scalar parameter.
    - `orbit`: the orbit at which to start, from `periodic_orbit`.
    - `stop`: the value of the parameter to end at, or a pair (low, high).
    - `max_step`, `max_points`: the largest step, relative to the size of the unknowns, and the
      largest number of points in either direction, as in `continue_orbit`.
    - `throw`: whether to raise an error unless the outcome is `successful`.

    **Returns** a `BifurcationSequence`. A branch that ends before `stop` is a success.

    **Outcomes**: `successful`; `newton_stalled` or `newton_singular` where Newton's method diverges
    from the orbit; the outcome of the orbit itself if it failed, such as `nonfinite`.

    **Source**: as for `continue_orbit` and `find_bifurcation`.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=11.5)
    >>> orbit = jf.periodic_orbit(belt, jnp.array([0.1, 0.0]))
    >>> for b in jf.find_bifurcations(belt, "omega", orbit, stop=10.5):
    ...     print(b.kind, round(float(b.value), 9))
    grazing-sliding 10.904975822
    """
    check.system("system", system)
    # Numbers of one type, because another type would recompile existing programs.
    system = cast(system, orbit.x0.dtype) if isinstance(orbit, Orbit) else system
    branch = continue_orbit(
        system,
        parameter,
        orbit,
        stop=stop,
        max_step=max_step,
        max_points=max_points,
        throw=throw,
    )
    first, last = (_at_end(system, branch, side) for side in (0, -1))
    inner = [_named(system, branch, point) for point in branch.points]
    end = len(branch.values) - 1
    indices = [0] * len(first) + [point.index for point in branch.points] + [end] * len(last)
    return BifurcationSequence(branch, [*first, *inner, *last], indices)


def _named(system: System, branch: Branch, point: SpecialPoint) -> Bifurcation | SpecialPoint:
    """The bifurcation at a change of the contacts; the point itself if it is of no known kind."""
    if point.kind not in ("contacts", "rest"):
        return point
    return _tangency_at(system, branch, point.value, point.orbit) or point


def _at_end(system: System, branch: Branch, side: int) -> list[Bifurcation]:
    """The bifurcation in which the branch ends on one side, if it is a tangency beyond which there
    is no orbit, and not among its points."""
    value = float(branch.values[side])
    known = any(_is_same(branch, value, point.value) for point in branch.points)
    if known or not branch.lost[side]:
        return []
    found = _tangency_at(system, branch, value, part_of(branch.orbits, side))
    return [] if found is None else [found]


def _is_same(branch: Branch, value: float, other: float) -> bool:
    # A value may be zero. The range of the branch then has the size of the parameter.
    return abs(value - other) <= 1e-6 * max(abs(value), float(np.ptp(branch.values)))


def _tangency_at(system: System, branch: Branch, value: float, orbit: Orbit) -> Bifurcation | None:
    """The tangency at an orbit of the branch and this value of the parameter, if there is one."""
    parameter = branch.parameter
    orbit = dataclasses.replace(orbit, system=replace_parameter(system, parameter, value))
    # The kind is unknown, so all are tried, the nearest candidate first.
    nearest = []
    for kind in BIFURCATION_KINDS:
        nearest += [(reach, kind) for reach, _ in tangency_candidates(orbit, kind)[:1]]
    for _, kind in sorted(nearest):
        found = find_bifurcation(system, parameter, orbit, kind, throw=False)
        # A bifurcation further off is another one, which has its own place on the branch.
        located = code(found.result) in (code(RESULTS.successful), code(RESULTS.other_kind))
        if located and _is_same(branch, value, float(found.value)) and int(found.code) >= 0:
            return found
    return None
