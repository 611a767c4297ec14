"""`TangencyCurve`: the tangencies of a system as two parameters vary, as a curve to be followed.

A system and the defining system of a tangency with two free parameters enter; points leave, with
the kind of bifurcation that each is. The defining system has no square root, so that the curve has
no corners; it ends where the orbit meets a surface elsewhere.
"""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfil.bifurcations.defining_system import DefiningSystem
from jaxfil.bifurcations.tangency import conditions, kind_of
from jaxfil.model.system import System
from jaxfil.orbits.curve import (
    ArclengthConstraint,
    Curve,
    CurvePoint,
    Special,
    StepSizes,
    tangent_of,
)
from jaxfil.orbits.locating import change_on_curve
from jaxfil.orbits.newton import Evaluation, Root, newton


class _Known(eqx.Module):
    """What is known at a root: when and where the orbit is tangent, the largest |x| of each
    component, the number of the kind, and whether the orbit meets no surface elsewhere."""

    t: Float[Array, ""]
    x: Float[Array, " n"]
    size: Float[Array, " n"]
    code: Int[Array, ""]
    holds: Bool[Array, ""]


@dataclasses.dataclass(frozen=True)
class TangencyPoint(CurvePoint):
    """A tangency: its two parameters are the last unknowns."""

    known: _Known

    @property
    def code(self) -> int:
        """The number of its kind, −1 where the conditions are those of none."""
        return int(self.known.code)


@eqx.filter_jit
def _solve(
    system: System, equations: DefiningSystem, u: Array, constraint: ArclengthConstraint
) -> Root:
    def evaluate(u: Array) -> Evaluation:
        return constraint.appended(equations.evaluate(system, u), u)

    root = newton(evaluate, u, equations.newton_steps)
    there, _, tangency = equations.placed(system, root.z)
    closing = root.at.aux
    found = conditions(there, closing.t, closing.x, tangency)
    code = kind_of(equations.family, found)
    known = _Known(closing.t, closing.x, closing.size, code, closing.holds)
    return dataclasses.replace(root, at=dataclasses.replace(root.at, aux=known))


@dataclasses.dataclass(frozen=True)
class TangencyCurve(Curve[TangencyPoint]):
    """The curve of a defining system with two free parameters, followed in the first of them."""

    system: System
    equations: DefiningSystem

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
        return _solve(self.system, self.equations, jnp.asarray(guess), constraint)

    def point(
        self, root: Root, constraint: ArclengthConstraint, along: np.ndarray
    ) -> TangencyPoint:
        """With what is known of the tangency."""
        scale = np.asarray(constraint.scale)
        return TangencyPoint(
            u=np.asarray(root.z),
            scale=scale,
            tangent=tangent_of(root, scale, along),
            num_steps=int(root.num_steps),
            known=jax.tree.map(np.asarray, root.at.aux),
        )

    def metric(self, point: TangencyPoint) -> np.ndarray:
        """A state by its largest value on the orbit, all else by its size."""
        size, q = point.known.size, abs(point.u[point.known.size.shape[0] :])
        return np.append(np.where(size == 0, 1, size), np.where(q == 0, 1, q))

    def special_points(
        self, a: TangencyPoint, b: TangencyPoint
    ) -> Iterator[Special[TangencyPoint]]:
        """Where the kind changes: a point of codimension two."""
        if a.code != b.code:
            _, after = change_on_curve(self, a, b, lambda p: p.code == a.code)
            yield Special("kind", after, a.code, b.code)

    def refusal(self, ahead: TangencyPoint) -> str | None:
        """A tangency of an orbit that is cut by a surface on the way there is none."""
        return None if bool(ahead.known.holds) else "the orbit meets the surface elsewhere"

    def told(self, point: TangencyPoint) -> str:
        """Both parameters."""
        return f"({point.u[-2]:.8g}, {point.u[-1]:.8g})"
