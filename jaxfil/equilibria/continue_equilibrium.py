"""`continue_equilibrium`: a branch of equilibria by pseudo-arclength continuation.

The branch contains regular equilibria, pseudo-equilibria and equilibria at rest, with folds, Hopf
points and boundary equilibria.
"""

import dataclasses

import jax
import numpy as np

from jaxfil.equilibria.balance import Balance, is_affine
from jaxfil.equilibria.balance_curve import BalanceCurve, EquilibriumPoint, Varied
from jaxfil.equilibria.equilibrium import Equilibrium
from jaxfil.equilibria.equilibrium_branch import EquilibriumBifurcation, EquilibriumBranch
from jaxfil.equilibria.search import autonomous
from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import cast, get_parameter, replace_parameter, scalar_parameter
from jaxfil.model.system import System
from jaxfil.orbits.curve import constraint_across, least_scales
from jaxfil.orbits.pseudo_arclength import FollowedCurve, follow, limits_of, range_around
from jaxfil.xla.known import array_of, stacked

# The least scale of an unknown, relative to its initial value, is this multiple of an orbit's,
# because equilibria pass through zero more often than largest values on orbits do.
_LEAST = 10.0
# Values below this fraction of the others are zero.
_SMALL = 1e-3


def continue_equilibrium(
    system: System,
    parameter: str,
    equilibrium: Equilibrium,
    *,
    stop: float | tuple[float, float],
    max_step: float = 0.05,
    max_points: int = 2000,
    throw: bool = True,
) -> EquilibriumBranch:
    r"""Follow the branch of equilibria through `equilibrium` as a parameter varies.

    Pseudo-arclength continuation. Where a margin of the equilibrium becomes zero, at a boundary
    equilibrium, the branch continues with equilibria of the other mode that are equilibria of the
    system. With $A = F_x$ there, $C = \nabla H_j$ and $G = \tfrac12 (F_+ - F_-)$ it continues in
    the same direction of the parameter (persistence) if $C A^{-1} G > 0$, and back (a nonsmooth
    fold) if it is negative. Where the field is continuous, $F_+ = F_-$ on the surface, it continues
    on the other side, in the same direction if $\det A_+ \det A_- > 0$. Margins are compared
    between neighbouring points of the branch, so a piece in another mode that begins and ends
    within one step is passed over; a smaller `max_step` finds it.

    **Arguments**

    - `system`: the `System`; its value of the parameter is ignored.
    - `parameter`: the name of a scalar parameter.
    - `equilibrium`: the start, from `jf.equilibrium`; not a virtual one.
    - `stop`: the value of the parameter to end at; a pair (low, high) follows the branch both ways.
      A branch that turns back ends where it leaves this range.
    - `max_step`: the largest step, relative to the size of the unknowns; for an unknown that goes
      to zero, relative to a fraction of its initial value.
    - `max_points`: the largest number of points in either direction.
    - `throw`: whether to raise an error unless the outcome is `successful`; otherwise a branch that
      does not begin contains only the given equilibrium.

    **Returns** an `EquilibriumBranch`. One that ends before `stop` is a success;
    `EquilibriumBranch.ended` gives the reason. A closed branch is followed once.

    **Outcomes**: `successful`; `newton_stalled` or `newton_singular` where Newton's method diverges
    from the equilibrium, which then does not belong to the system; the outcome of the equilibrium
    itself if it failed, such as `nonfinite`.

    **Source**: boundary equilibria: M. di Bernardo, C. Budd, A. Champneys and P. Kowalczyk,
    Piecewise-smooth Dynamical Systems, Springer (2008), § 5.1–5.2.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> class Line(jf.System):
    ...     mu: jax.Array
    ...     def vector_field(self, t, x, side):
    ...         return jnp.where(side > 0, self.mu - x, -jnp.ones_like(x))
    ...     def switching(self, t, x):
    ...         return x[0]
    >>> line = Line(jnp.array(1.0))
    >>> branch = jf.continue_equilibrium(line, "mu", jf.equilibrium(line, jnp.ones(1)), stop=-1.0)
    >>> print(branch.points[0].kind, round(abs(branch.points[0].value), 6))
    nonsmooth-fold 0.0
    """
    check.system("system", system)
    autonomous("system", system)
    scalar_parameter(system, parameter)
    check.flags(throw=throw)
    ends, steps = limits_of(stop, max_step, max_points)
    if not isinstance(equilibrium, Equilibrium) or equilibrium.x.ndim != 1:
        raise ValueError(
            f"`equilibrium` must be a single Equilibrium, got {check.told(equilibrium)}."
        )
    curve, start, result = _on_branch(system, parameter, equilibrium)
    if start is None:
        branch = _not_begun(curve, equilibrium, result)
    else:
        if np.any(start.known.margins < -start.known.noise):
            raise ValueError("`equilibrium` must be one of the system, got a virtual one.")
        within = range_around(ends, curve.value(start))
        curve = dataclasses.replace(curve, least=_least(curve, start, ends))
        branch = _branch(curve, follow(curve, start, within, *steps))
    if throw:
        # Not traced, so that it raises at once and the numbers stay NumPy arrays.
        raise_if_failed(branch.values, branch.result)
    return branch


def _on_branch(
    system: System, parameter: str, at: Equilibrium
) -> tuple[BalanceCurve, EquilibriumPoint | None, RESULTS]:
    """The branch of an equilibrium; a point of it, if Newton's method converges; its outcome."""
    dtype = at.x.dtype
    # The equilibrium defines the start of the branch; the system's own value is ignored.
    known = get_parameter(at.system, parameter)
    system = replace_parameter(cast(system, dtype), parameter, known)
    mode = np.asarray(at.mode)
    balance = Balance(system, array_of(mode, dtype), is_affine(system, at.x, mode.size))
    curve = BalanceCurve(Varied(balance, parameter))
    u = np.concatenate([np.asarray(at.x), np.asarray(at.multipliers), [float(known)]])
    u = u.astype(dtype)
    constraint = constraint_across(u, _sizes(u, mode.size), curve.axis(u), 0.0)
    return curve, *curve.begin(u, constraint, curve.axis(u))


def _sizes(u: np.ndarray, m: int) -> np.ndarray:
    """Initial scales of unknowns. A component that is zero to rounding has the scale of the largest
    one; multipliers have one at least."""
    n, size = u.size - 1 - m, abs(u)
    largest = size[:n].max() or 1.0
    size[:n] = np.where(size[:n] < _SMALL * largest, largest, size[:n])
    size[n:-1] = np.maximum(size[n:-1], 1.0)
    size[-1] = size[-1] or 1.0
    return size


def _least(curve: BalanceCurve, start: EquilibriumPoint, ends: list[float]) -> np.ndarray:
    """The least scales of unknowns on the branch."""
    size = _sizes(start.u, start.mode.size)
    least = _LEAST * least_scales(size, curve.place, ends)
    least[-1] /= _LEAST
    return least


def _branch(curve: BalanceCurve, path: FollowedCurve[EquilibriumPoint]) -> EquilibriumBranch:
    """The `EquilibriumBranch` of a path."""
    return EquilibriumBranch(
        parameter=curve.parameter,
        values=np.array([curve.value(point) for point in path.points]),
        equilibria=stacked([_equilibrium(curve, point) for point in path.points]),
        eigenvalues=np.array([point.known.eigenvalues for point in path.points]),
        points=[
            EquilibriumBifurcation(
                kind=s.kind,
                value=curve.value(s.point),
                equilibrium=_equilibrium(curve, s.point),
                index=s.index,
                before=_told(s.before),
                after=_told(s.after),
            )
            for s in path.special
        ],
        ended=path.ended,
        result=RESULTS.successful,
    )


def _told(mode: np.ndarray) -> tuple[int, ...]:
    return tuple(np.round(mode).astype(int).tolist())


def _equilibrium(curve: BalanceCurve, point: EquilibriumPoint) -> Equilibrium:
    """The equilibrium of a point."""
    balance, m = curve.varied.balance, point.mode.size
    n = point.u.size - 1 - m
    parts = point.u[:n], point.u[n:-1], np.round(point.mode).astype(np.int32)
    x, multipliers, mode = jax.device_put(parts)
    return Equilibrium(
        x=x,
        mode=mode,
        multipliers=multipliers,
        residual=array_of(np.asarray(point.residual)),
        num_steps=array_of(np.asarray(point.num_steps)),
        result=RESULTS.successful,
        system=replace_parameter(balance.system, curve.parameter, point.u[-1]),
        _affine=balance.affine,
    )


def _not_begun(curve: BalanceCurve, given: Equilibrium, result: RESULTS) -> EquilibriumBranch:
    """A branch with the given equilibrium alone; its own failure takes precedence."""
    value = float(get_parameter(given.system, curve.parameter))
    why = f"no branch was found at {value:.10g}"
    return EquilibriumBranch(
        parameter=curve.parameter,
        values=np.array([value]),
        equilibria=stacked([given]),
        eigenvalues=np.full((1, given.x.size), np.nan, complex),
        points=[],
        ended=(why, why),
        result=RESULTS.where(given.result == RESULTS.successful, result, given.result),
    )
