"""`TangencyCurve`: the tangencies of a system as two parameters vary, as a curve to be followed.

A system and the defining system of a tangency with two free parameters enter; points leave, with
the kind of bifurcation that each is. The defining system has no square root, so that the curve has
no corners; it ends where the orbit meets a surface elsewhere.
"""

import dataclasses
from collections.abc import Callable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfil.bifurcations.defining_system import DefiningSystem
from jaxfil.bifurcations.tangency import (
    ARRIVAL,
    FAMILIES,
    SLIDE,
    Closing,
    Conditions,
    conditions,
    kind_of,
)
from jaxfil.model.system import System
from jaxfil.orbits.curve import (
    ArclengthConstraint,
    Curve,
    CurvePoint,
    Special,
    StepSizes,
    at_root,
)
from jaxfil.orbits.locating import change_on_curve, zero_on_curve
from jaxfil.orbits.newton import Root
from jaxfil.orbits.special_points import neimark_sacker, period_doubling
from jaxfil.xla.known import array_of


class _Known(eqx.Module):
    """What is known at a root: when and where the orbit is tangent, the largest |x| of each
    component, the number of the kind, the conditions, whether the flight meets no surface
    elsewhere, the contacts of the orbit outside of it, and its monodromy matrix, the tangency
    followed as if the surface were not there."""

    t: Float[Array, ""]
    x: Float[Array, " n"]
    size: Float[Array, " n"]
    code: Int[Array, ""]
    conditions: Conditions
    holds: Bool[Array, ""]
    contacts: Int[Array, ""]
    monodromy: Float[Array, "n n"]


@dataclasses.dataclass(frozen=True)
class TangencyPoint(CurvePoint):
    """A tangency: its two parameters are the last unknowns."""

    known: _Known

    @property
    def kind(self) -> str:
        """The name of its kind, "undecided" where the conditions are those of none."""
        # −1 is the number of none.
        return (*FAMILIES, "undecided")[int(self.known.code)]

    @property
    def t(self) -> np.ndarray:
        """When the orbit is tangent."""
        return np.asarray(self.known.t)

    @property
    def x(self) -> np.ndarray:
        """The state then."""
        return np.asarray(self.known.x)

    @property
    def contacts(self) -> int:
        """How many contacts the orbit has besides."""
        return int(self.known.contacts)


def _solve(
    system: System, equations: DefiningSystem, u: Array, constraint: ArclengthConstraint
) -> Root:
    root = equations.root(system, u, constraint.appended)
    at = equations.there(system, root.z)
    closing = root.at.aux
    found = conditions(at.system, closing.t, closing.x, equations.tangency)
    return _with_known(equations, root, found)


@eqx.filter_jit
def _with_known(equations: DefiningSystem, root: Root, found: Conditions) -> Root:
    """A root, with what else is known there."""
    closing: Closing = root.at.aux
    n = closing.x.shape[0]
    # The closing's derivative is that of the flow map less one.
    monodromy = root.at.jacobian[:n, :n] + jnp.eye(n, dtype=root.z.dtype)
    known = _Known(
        t=closing.t,
        x=closing.x,
        size=closing.size,
        code=kind_of(equations.family, found),
        conditions=found,
        holds=closing.holds,
        contacts=closing.contacts,
        monodromy=monodromy,
    )
    return dataclasses.replace(root, at=dataclasses.replace(root.at, aux=known))


@dataclasses.dataclass(frozen=True)
class TangencyCurve(Curve[TangencyPoint]):
    """The curve of a defining system with two free parameters, followed in the first of them."""

    system: System
    equations: DefiningSystem
    least: np.ndarray | float = 0.0
    """No scale is below it."""

    # Smooth: longer steps than those of orbits, and no end that a short one would have to find.
    steps = StepSizes(first=0.01, least=1e-6, growth=1.5, straight=0.99, easy=12, corner=0.0)
    solution = "tangency"
    place = -2

    @property
    def parameter(self) -> str:
        """The name of the first parameter."""
        return self.equations.free[0]

    def solve(self, guess: np.ndarray, constraint: ArclengthConstraint) -> Root:
        """By the defining system."""
        return _solve(self.system, self.equations, array_of(guess), constraint)

    def point(
        self, root: Root, constraint: ArclengthConstraint, along: np.ndarray
    ) -> TangencyPoint:
        """With what is known of the tangency."""
        known = jax.tree.map(np.asarray, root.at.aux)
        return TangencyPoint(**at_root(root, constraint, along), known=known)

    def metric(self, point: TangencyPoint) -> np.ndarray:
        """A state by its largest value on the orbit, a phase by one period, all else by its
        size."""
        size = point.known.size
        q = abs(point.u[size.shape[0] :])
        if self.system.period is not None:
            q[0] = 1.0
        return np.maximum(np.append(np.where(size == 0, 1, size), q), self.least)

    def special_points(
        self, a: TangencyPoint, b: TangencyPoint
    ) -> Iterator[Special[TangencyPoint]]:
        """Points of codimension two, piece by piece: where the kind changes, where the orbit has a
        second tangency, and where a multiplier of it reaches the unit circle."""
        if a.kind != b.kind:
            name, test = _degeneracy(int(self.equations.family), a, b)
            point = zero_on_curve(self, a, b, test) if test(a) * test(b) < 0 else None
            # What does not change its sign has changed its character by rounding.
            point = point or change_on_curve(self, a, b, lambda p: p.kind == a.kind)[1]
            yield from self._of_one_kind(a, point)
            yield Special(name, point, a.kind, b.kind)
            a = point
        yield from self._of_one_kind(a, b)

    def _of_one_kind(self, a: TangencyPoint, b: TangencyPoint) -> Iterator[Special[TangencyPoint]]:
        """Those between two points of the same kind."""
        # An arrival at the tangency itself is one contact or two, by rounding.
        if a.contacts != b.contacts and int(self.equations.family) != ARRIVAL:
            before, after = change_on_curve(self, a, b, lambda p: p.contacts == a.contacts)
            # The multipliers of an orbit jump there.
            yield from self._critical(a, before)
            point = before if a.contacts < b.contacts else after
            yield Special("double-tangency", point, a.kind, b.kind)
            a = after
        yield from self._critical(a, b)

    def _critical(self, a: TangencyPoint, b: TangencyPoint) -> Iterator[Special[TangencyPoint]]:
        """Where a multiplier reaches the unit circle between two points of the same kind."""
        for kind, test in self._tests().items():
            if test(a) * test(b) < 0:
                point = zero_on_curve(self, a, b, test)
                if point is not None:
                    yield Special(kind, point, a.kind, b.kind)

    def _tests(self) -> dict[str, Callable[[TangencyPoint], float]]:
        """Test functions of the orbit."""
        tests = {
            "period-doubling": lambda p: period_doubling(p.known.monodromy),
            "neimark-sacker": lambda p: neimark_sacker(p.known.monodromy),
        }
        # An autonomous orbit has a multiplier 1 wherever it is.
        if self.system.period is not None:
            tests["fold"] = lambda p: period_doubling(-p.known.monodromy)
        return tests

    def refusal(self, ahead: TangencyPoint) -> str | None:
        """A tangency of an orbit that is cut by a surface on the way there is none."""
        return None if bool(ahead.known.holds) else "the orbit meets the surface elsewhere"

    def told(self, point: TangencyPoint) -> str:
        """Both parameters."""
        return f"({point.u[-2]:.8g}, {point.u[-1]:.8g})"


def _degeneracy(
    family: int, a: TangencyPoint, b: TangencyPoint
) -> tuple[str, Callable[[TangencyPoint], float]]:
    """What the point between two tangencies of different kinds is, and what vanishes there: the
    bend in a cusp, where the tangency is cubic, the rate of the other side in a two-fold."""
    name = "slide_bend" if family == SLIDE else "bend"

    def bend(point: TangencyPoint) -> float:
        return float(getattr(point.known.conditions, name))

    if bend(a) * bend(b) <= 0:
        return "cusp", bend
    return "two-fold", lambda point: float(point.known.conditions.other_rate)
