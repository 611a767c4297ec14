"""`BalanceCurve`: the curve of equilibria of a system as a parameter varies.

Where a margin becomes zero an equilibrium reaches the boundary of its mode. From there the curve
continues with equilibria of the mode on the other side that are equilibria of the system, in the
same direction (persistence) or back (a nonsmooth fold). That mode is rest at a wall, the other side
of a surface across which the field is continuous, and otherwise sliding.
"""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxfil.equilibria.balance import Balance, linearise
from jaxfil.equilibria.equilibrium import eigenvalues_of
from jaxfil.equilibria.search import evaluation, throws_back
from jaxfil.model.parameter import replace_parameter
from jaxfil.orbits.curve import (
    ArclengthConstraint,
    Curve,
    CurvePoint,
    Special,
    StepSizes,
    at_root,
    constraint_across,
)
from jaxfil.orbits.locating import count_on_curve, zero_on_curve
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.xla.known import array_of

# A guess taken from a neighbour converges in a few steps or not at all.
_NEWTON_STEPS = 12
# A real part below this fraction of the largest eigenvalue is zero.
_ON_AXIS = 1e-7


class _Known(eqx.Module):
    """Data of an equilibrium on a curve."""

    margins: Float[Array, " m"]
    noise: Float[Array, " m"]
    eigenvalues: Complex[Array, " n"]
    moving: Complex[Array, " n"]
    """The same, with −∞ for components that only events change."""


@dataclasses.dataclass(frozen=True)
class EquilibriumPoint(CurvePoint):
    """An equilibrium on a curve, with the parameter as its last unknown. `met` is the surface whose
    margin is zero at the end of a mode."""

    mode: np.ndarray
    residual: float
    known: _Known
    met: int | None = None


class Varied(eqx.Module):
    """A balance with one free parameter; unknowns are (x, multipliers, parameter)."""

    balance: Balance
    parameter: str = eqx.field(static=True)

    def at(self, u: Array) -> tuple[Balance, Array]:
        """The balance at a value of the parameter, and its unknowns."""
        system = replace_parameter(self.balance.system, self.parameter, u[-1])
        return Balance(system, self.balance.mode, self.balance.affine), u[:-1]

    def residual(self, u: Array) -> Array:
        """The equations, one fewer than unknowns."""
        balance, z = self.at(u)
        return balance.residual(z)

    def margins(self, u: Array) -> Array:
        """The margins."""
        balance, z = self.at(u)
        return balance.margins(z)


@eqx.filter_jit
def _solve(varied: Varied, u: Array, constraint: ArclengthConstraint, newton_steps: Array) -> Root:
    """Newton's root of the equations and a constraint."""

    def evaluate(u: Array) -> Evaluation:
        balance, z = varied.at(u)
        own = evaluation(balance, z, constraint.scale[:-1])
        unknowns = jnp.append(own.unknown_scale, jnp.maximum(abs(u[-1]), constraint.scale[-1]))
        by_parameter = jax.jacfwd(lambda p: varied.residual(u.at[-1].set(p)))(u[-1])
        jacobian = jnp.concatenate([own.jacobian, by_parameter[:, None]], axis=1)
        given = dataclasses.replace(own, jacobian=jacobian, unknown_scale=unknowns)
        return constraint.appended(given, u)

    root = newton(evaluate, u, newton_steps)
    balance, z = varied.at(root.z)
    flow = linearise(balance, z)
    eigenvalues = eigenvalues_of(flow), eigenvalues_of(flow.moving())
    known = _Known(balance.margins(z), balance.noise(z), *eigenvalues)
    return dataclasses.replace(root, at=dataclasses.replace(root.at, aux=known))


@eqx.filter_jit
def _margin_rates(varied: Varied, u: Array, along: Array) -> Array:
    return jax.jvp(varied.margins, (u,), (along,))[1]


@eqx.filter_jit
def _walls(varied: Varied, u: Array) -> Array:
    balance, z = varied.at(u)
    return throws_back(balance, balance.split(z)[0])


@eqx.filter_jit
def _in_mode(varied: Varied, after: Array, u: Array, scale: Array) -> tuple[Varied, Array, Array]:
    """The balance in the mode `after`, the unknowns of a boundary equilibrium in it, and whether
    they satisfy its equations to rounding, given the scales of the unknowns."""
    balance, z = varied.at(u)
    z = balance.unknowns_in(after, z)
    beside = Varied(dataclasses.replace(varied.balance, mode=after), varied.parameter)
    there = Balance(balance.system, after, balance.affine)
    residual, jacobian = there.residual(z), jax.jacfwd(there.residual)(z)
    rounding = jnp.finfo(z.dtype).eps ** 0.5 * (abs(jacobian) @ scale[:-1])
    return beside, jnp.append(z, u[-1]), jnp.all(abs(residual) <= rounding)


@dataclasses.dataclass(frozen=True)
class BalanceCurve(Curve[EquilibriumPoint]):
    """The curve of a balance and a parameter; `least` bounds scales from below."""

    varied: Varied
    least: np.ndarray | float = 0.0

    # Smooth within a mode, with located ends.
    steps = StepSizes(first=0.01, least=1e-7, growth=1.6, straight=0.995, easy=6, corner=0.0)
    solution = "equilibrium"
    place = -1

    @property
    def parameter(self) -> str:
        """The name of the parameter."""
        return self.varied.parameter

    @property
    def mode(self) -> np.ndarray:
        """The mode, (m,)."""
        return np.asarray(self.varied.balance.mode)

    @property
    def multipliers(self) -> slice:
        """The place of the weights and reactions among the unknowns."""
        return slice(-1 - self.mode.size, -1)

    def solve(self, guess: np.ndarray, constraint: ArclengthConstraint) -> Root:
        """Solve the equations of the mode."""
        return _solve(self.varied, array_of(guess), constraint, array_of(_NEWTON_STEPS, jnp.int32))

    def point(
        self, root: Root, constraint: ArclengthConstraint, along: np.ndarray
    ) -> EquilibriumPoint:
        """A point with its margins and eigenvalues."""
        return EquilibriumPoint(
            **at_root(root, constraint, along),
            mode=self.mode,
            residual=float(root.size),
            known=jax.tree.map(np.asarray, root.at.aux),
        )

    def metric(self, point: EquilibriumPoint) -> np.ndarray:
        """Scales: sizes of components and of the parameter; at least one for weights and
        reactions."""
        size = abs(point.u)
        size[self.multipliers] = np.maximum(size[self.multipliers], 1.0)
        return np.maximum(size, self.least)

    def special_points(
        self, a: EquilibriumPoint, b: EquilibriumPoint
    ) -> Iterator[Special[EquilibriumPoint]]:
        """Folds and Hopf points."""
        if _fold(a) * _fold(b) < 0:
            point = zero_on_curve(self, a, b, _fold)
            if point is not None:
                yield Special("fold", point, self.mode, self.mode)
        if _hopf(a) * _hopf(b) < 0:
            point = zero_on_curve(self, a, b, _hopf)
            # Two real eigenvalues of opposite sign with the sum zero are not a Hopf point.
            is_hopf = point is not None and _is_pair(point)
        else:  # two pairs at once, as of a symmetric system
            noise = float(_ON_AXIS * np.max(abs(_finite(a)), initial=0.0))
            point = count_on_curve(self, a, b, lambda p: np.real(_finite(p)), noise)
            is_hopf = point is not None and _is_on_axis(point)
        if point is not None and is_hopf:
            yield Special("hopf", point, self.mode, self.mode)

    def last_between(
        self, here: EquilibriumPoint, ahead: EquilibriumPoint
    ) -> tuple[EquilibriumPoint, str] | None:
        """The boundary equilibrium between two neighbours, the first if there are several."""
        before, after = here.known, ahead.known
        left = (before.margins > before.noise) & (after.margins < 0)
        # The start of a curve may be a boundary equilibrium itself.
        starts = (abs(before.margins) <= before.noise) & (after.margins < -after.noise)
        found = [
            (0.0, j, dataclasses.replace(here, met=j)) for j in np.flatnonzero(starts).tolist()
        ]
        for j in np.flatnonzero(left).tolist():
            point = zero_on_curve(self, here, ahead, lambda p, j=j: float(p.known.margins[j]))
            if point is not None:
                away = float(np.linalg.norm((point.u - here.u) / here.scale))
                found.append((away, j, dataclasses.replace(point, met=j)))
        if not found:
            return None
        _, j, point = min(found, key=lambda v: v[:2])
        return point, f"the boundary at surface {j} was met at {self.told(point)}"

    def beyond_last(
        self, last: EquilibriumPoint
    ) -> tuple[Curve[EquilibriumPoint], EquilibriumPoint, Special[EquilibriumPoint]] | None:
        """The equilibria of the mode that shares the boundary, on the part where they are
        equilibria of the system."""
        if last.met is None:
            return None
        beside, u = self._beyond(last, last.met)
        if beside is None:
            return None
        scale = beside.metric(dataclasses.replace(last, u=u))
        axis = self.axis(u)
        point = beside.correct(u, constraint_across(u, scale, axis, 0.0), axis)
        if point is None:
            return None
        along = array_of(point.tangent * point.scale)
        rate = float(_margin_rates(beside.varied, array_of(point.u), along)[last.met])
        point = dataclasses.replace(point, tangent=np.sign(rate) * point.tangent)
        same = point.tangent[-1] * last.tangent[-1] > 0
        kind = "persistence" if same else "nonsmooth-fold"
        return beside, point, Special(kind, last, self.mode, beside.mode)

    def _beyond(self, last: EquilibriumPoint, j: int) -> "tuple[BalanceCurve | None, np.ndarray]":
        """The curve of the mode on the other side of the boundary at surface j, and a boundary
        equilibrium in its unknowns."""
        balance, side, u = self.varied.balance, self.mode[j], last.u
        if side == 0:
            return self._in(np.sign(u[self.multipliers][j]), last, j)[:2]
        if abs(side) == 2:
            return self._in(np.sign(side), last, j)[:2]
        if balance.system.resets and bool(_walls(self.varied, array_of(u))[j]):
            # The balance does not contain what a reaction does within the field.
            felt = balance.system.feels_reactions
            return (None, u) if felt else self._in(2 * side, last, j)[:2]
        # A field that balances on both sides is continuous.
        beside, there, balances = self._in(-side, last, j)
        if balances:
            return beside, there
        return self._in(0.0, last, j)[:2] if balance.system.slides else (None, u)

    def _in(
        self, mode_of_one: float, last: EquilibriumPoint, j: int
    ) -> "tuple[BalanceCurve, np.ndarray, bool]":
        """The curve of another mode of surface j, its unknowns at a boundary equilibrium, and
        whether it is an equilibrium in that mode too."""
        after = self.mode.copy()
        after[j] = mode_of_one
        u, scale = array_of(last.u), array_of(last.scale)
        varied, there, balances = _in_mode(self.varied, array_of(after, u.dtype), u, scale)
        return dataclasses.replace(self, varied=varied), np.array(there), bool(balances)


def _fold(point: EquilibriumPoint) -> float:
    # At a fold the curve runs at right angles to the parameter's axis.
    return float(point.tangent[-1])


def _finite(point: EquilibriumPoint) -> np.ndarray:
    values = np.asarray(point.known.moving)
    return values[np.isfinite(np.real(values))]


def _sums_of_two(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sums of all two eigenvalues, relative to their sizes, and the first one of each."""
    i, j = np.triu_indices(values.size, 1)
    size = np.maximum(abs(values[i]) + abs(values[j]), np.finfo(float).tiny)
    return (values[i] + values[j]) / size, values[i]


def _hopf(point: EquilibriumPoint) -> float:
    """The product of all sums of two eigenvalues, which changes its sign where a pair is on the
    imaginary axis."""
    sums, _ = _sums_of_two(_finite(point))
    return float(np.real(np.prod(sums))) if sums.size else np.nan


def _is_pair(point: EquilibriumPoint) -> bool:
    """Whether the two eigenvalues with the smallest relative sum are a complex pair."""
    sums, first = _sums_of_two(_finite(point))
    one = complex(first[np.argmin(abs(sums))])
    return abs(one.imag) > abs(one.real)


def _is_on_axis(point: EquilibriumPoint) -> bool:
    """Whether the eigenvalue nearest to the imaginary axis is not real."""
    values = _finite(point)
    one = complex(values[np.argmin(abs(np.real(values)))])
    return abs(one.imag) > _ON_AXIS**0.5 * np.max(abs(values))
