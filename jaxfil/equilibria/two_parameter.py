"""`continue_equilibrium_bifurcation`: a bifurcation of equilibria as two parameters vary."""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.equilibria.bifurcation_equations import BifurcationEquations, equations_of
from jaxfil.equilibria.equilibrium_branch import EquilibriumBifurcation
from jaxfil.equilibria.search import autonomous, relative
from jaxfil.model import check
from jaxfil.model.labels import labels_of
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import two_parameters
from jaxfil.model.system import System
from jaxfil.orbits.curve import (
    ArclengthConstraint,
    CurvePoint,
    Special,
    StepSizes,
    at_root,
    constraint_across,
    least_scales,
)
from jaxfil.orbits.locating import zero_on_curve
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.orbits.plane_curve import EquationsCurve, PlaneCurve
from jaxfil.orbits.pseudo_arclength import FollowedCurve, follow, limits_of, range_around
from jaxfil.xla.known import array_of

_NEWTON_STEPS = 12
# Values below this fraction of the largest unknown are zero.
_SMALL = 1e-3


class EquilibriumCurve(PlaneCurve):
    """A curve of k bifurcations of equilibria in two parameters. `xs` are the equilibria, `kinds`
    are of `EQUILIBRIUM_BIFURCATION_KINDS`."""


@dataclasses.dataclass(frozen=True)
class _Point(CurvePoint):
    """A bifurcation, with the two parameters as its last unknowns."""

    kind: str
    admissible: bool


@eqx.filter_jit
def _solve(equations: BifurcationEquations, u: Array, constraint: ArclengthConstraint) -> Root:
    def evaluate(u: Array) -> Evaluation:
        residual, jacobian = equations.residual(u), jax.jacfwd(equations.residual)(u)
        unknowns = jnp.maximum(abs(u), constraint.scale)
        return constraint.appended(relative(residual, jacobian, unknowns), u)

    root = newton(evaluate, u, _NEWTON_STEPS)
    balance, z = equations.at(root.z)
    margins, noise = balance.margins(z), balance.noise(z)
    if equations.family == "boundary":
        # Its own margin vanishes.
        margins = margins.at[equations.surface].set(0.0)
    known = equations.persists(root.z), jnp.all(margins >= -noise)
    return dataclasses.replace(root, at=dataclasses.replace(root.at, aux=known))


@dataclasses.dataclass(frozen=True)
class _BifurcationCurve(EquationsCurve[_Point]):
    """The curve of the equations of a bifurcation."""

    equations: BifurcationEquations

    steps = StepSizes(first=0.01, least=1e-6, growth=1.5, straight=0.99, easy=8, corner=0.0)

    def solve(self, guess: np.ndarray, constraint: ArclengthConstraint) -> Root:
        """Solve the equations of the bifurcation."""
        return _solve(self.equations, array_of(guess), constraint)

    def point(self, root: Root, constraint: ArclengthConstraint, along: np.ndarray) -> _Point:
        """A point with its kind."""
        family = self.equations.family
        persists, admissible = root.at.aux
        boundary = "persistence" if float(persists) > 0 else "nonsmooth-fold"
        return _Point(
            **at_root(root, constraint, along),
            kind=boundary if family == "boundary" else family,
            admissible=bool(admissible),
        )

    def metric(self, point: _Point) -> np.ndarray:
        """All unknowns by their sizes."""
        return np.maximum(abs(point.u), self.least)

    def special_points(self, a: _Point, b: _Point) -> Iterator[Special[_Point]]:
        """No special points."""
        return iter(())

    def last_between(self, here: _Point, ahead: _Point) -> tuple[_Point, str] | None:
        """The Bogdanov–Takens point at which the pair of eigenvalues of a Hopf point is zero.
        Beyond it the equations hold with −ω at the same equilibria."""
        # ω is the last unknown before the parameters.
        frequency = lambda point: float(point.u[-3])  # noqa: E731
        if self.equations.family != "hopf" or frequency(here) * frequency(ahead) >= 0:
            return None
        point = zero_on_curve(self, here, ahead, frequency) or here
        return point, f"the eigenvalues meet at zero, at {self.told(point)}"

    def refusal(self, ahead: _Point) -> str | None:
        """A virtual equilibrium does not belong to the system."""
        return None if ahead.admissible else "the equilibrium is virtual"


def continue_equilibrium_bifurcation(
    system: System,
    parameters: tuple[str, str],
    bifurcation: EquilibriumBifurcation,
    *,
    stop: float | tuple[float, float],
    max_step: float = 0.05,
    max_points: int = 1000,
    throw: bool = True,
) -> EquilibriumCurve:
    """Follow a fold, a Hopf point or a boundary equilibrium in two parameters.

    Pseudo-arclength continuation of the defining equations, F = 0 with a null vector of the
    Jacobian, with a pair of eigenvalues ±iω, or with a margin of zero. On a curve of boundary
    equilibria each point is classified as persistence or nonsmooth fold.

    **Arguments**

    - `system`: the `System`. The bifurcation defines the values of all parameters.
    - `parameters`: the names of two scalar parameters.
    - `bifurcation`: the start, as in `EquilibriumBranch.points`.
    - `stop`: the value of the first parameter to end at; a pair (low, high) follows the curve both
      ways.
    - `max_step`: the largest step, relative to the size of the unknowns.
    - `max_points`: the largest number of points in either direction.
    - `throw`: whether to raise an error unless the outcome is `successful`; otherwise a curve that
      does not begin contains only the given bifurcation.

    **Returns** an `EquilibriumCurve`. One that ends before `stop`, for example at a virtual
    equilibrium, or of Hopf points at a double eigenvalue of zero (Bogdanov–Takens), is a success;
    `EquilibriumCurve.ended` gives the reason.

    **Outcomes**: `successful`; `newton_stalled` or `newton_singular` where Newton's method diverges
    from the bifurcation.

    **Source**: textbook for folds and Hopf points: W. Govaerts, Numerical Methods for Bifurcations
    of Dynamical Equilibria, SIAM (2000); boundary equilibria: M. di Bernardo, C. Budd, A. Champneys
    and P. Kowalczyk, Piecewise-smooth Dynamical Systems, Springer (2008), § 5.2.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> class Fold(jf.System):
    ...     a: jax.Array
    ...     b: jax.Array
    ...     def vector_field(self, t, x, side):
    ...         return self.a + self.b * x - x**2
    >>> fold, x = Fold(jnp.array(1.0), jnp.array(2.0)), jnp.array([3.0])
    >>> branch = jf.continue_equilibrium(fold, "a", jf.equilibrium(fold, x), stop=-3.0)
    >>> args = ("b", "a"), branch.points[0]
    >>> curve = jf.continue_equilibrium_bifurcation(fold, *args, stop=4.0)
    >>> print(curve.values[-1].round(9))  # 4a + b² = 0
    [ 4. -4.]
    """
    check.system("system", system)
    autonomous("system", system)
    free = two_parameters(system, parameters)
    check.flags(throw=throw)
    check.instance("bifurcation", bifurcation, EquilibriumBifurcation)
    ends, steps = limits_of(stop, max_step, max_points)
    equations, u = equations_of(bifurcation, free)
    curve = _BifurcationCurve(equations)
    # The scales of the unknowns at the start; 0 for one that is zero beside the others, which is
    # measured by 1.
    size = np.where(abs(u) < _SMALL * abs(u).max(), 0.0, abs(u))
    constraint = constraint_across(u, np.where(size == 0, 1.0, size), curve.axis(u), 0.0)
    start, result = curve.begin(u, constraint, curve.axis(u))
    if start is None:
        why = f"no curve was found at ({u[-2]:.8g}, {u[-1]:.8g})"
        # Of this point only u and the kind are read; it has no tangent.
        nowhere = np.zeros_like(u)
        point = _Point(
            u=u,
            scale=size,
            tangent=nowhere,
            num_steps=0,
            kind=bifurcation.kind,
            admissible=True,
        )
        found = _curve(curve, FollowedCurve([point], [], (why, why)), result)
    else:
        within = range_around(ends, curve.value(start))
        least = 10 * least_scales(size, curve.place, ends)
        curve = dataclasses.replace(curve, least=least)
        found = _curve(curve, follow(curve, start, within, *steps), result)
    if throw:
        # Not traced, so that it raises at once and the numbers stay NumPy arrays.
        raise_if_failed(found.values, found.result)
    return found


def _curve(
    curve: _BifurcationCurve, path: FollowedCurve[_Point], result: RESULTS
) -> EquilibriumCurve:
    """The `EquilibriumCurve` of a path."""
    equations = curve.equations
    n = equations.across.size - equations.after.size
    return EquilibriumCurve(
        parameters=equations.free,
        values=np.array([point.u[-2:] for point in path.points]),
        xs=np.array([point.u[:n] for point in path.points]),
        kinds=tuple(point.kind for point in path.points),
        ended=path.ended,
        result=result,
        labels=labels_of(equations.balance.system, n).of(equations.free),
    )
