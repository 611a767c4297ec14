"""`TangencyCurve`: the curve of tangencies of a system as two parameters vary.

The defining system has no square root, so the curve has no corners; it ends where the orbit has a
contact elsewhere.
"""

import dataclasses
from collections.abc import Callable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfil.bifurcations.closure import Closing
from jaxfil.bifurcations.defining_system import DefiningSystem
from jaxfil.bifurcations.flights import Pieces, pieces_of, quiet_node
from jaxfil.bifurcations.tangency import (
    ARRIVAL,
    FAMILIES,
    SLIDE,
    Conditions,
    Tangency,
    conditions,
    kind_of,
)
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.orbits.curve import (
    ArclengthConstraint,
    CurvePoint,
    Special,
    StepSizes,
    at_root,
    constraint_across,
)
from jaxfil.orbits.locating import change_on_curve, zero_on_curve
from jaxfil.orbits.newton import Root
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.plane_curve import EquationsCurve
from jaxfil.orbits.unit_circle import period_doubling, zeros_between
from jaxfil.xla.known import array_of


class _Known(eqx.Module):
    """Data at a root: time and state of the tangency, the largest |x| of each component, the number
    of the kind, the conditions, whether the flight has no other contact, the number of contacts of
    the orbit outside of it, and its monodromy matrix, with the tangency followed as if the surface
    were not there."""

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
    """A tangency, with its two parameters as the last unknowns."""

    known: _Known

    @property
    def kind(self) -> str:
        """The name of its kind, "undecided" if the conditions fit no kind."""
        # −1 stands for no kind.
        return (*FAMILIES, "undecided")[int(self.known.code)]

    @property
    def t(self) -> np.ndarray:
        """The time of the tangency."""
        return np.asarray(self.known.t)

    @property
    def x(self) -> np.ndarray:
        """The state at the tangency."""
        return np.asarray(self.known.x)

    @property
    def contacts(self) -> int:
        """The number of other contacts of the orbit."""
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
    """A root with further data."""
    closing: Closing = root.at.aux
    known = _Known(
        t=closing.t,
        x=closing.x,
        size=closing.size,
        code=kind_of(equations.family, found),
        conditions=found,
        holds=closing.holds,
        contacts=closing.contacts,
        monodromy=equations.monodromy(root.at.jacobian),
    )
    return dataclasses.replace(root, at=dataclasses.replace(root.at, aux=known))


@dataclasses.dataclass(frozen=True)
class TangencyCurve(EquationsCurve[TangencyPoint]):
    """The curve of a defining system with two free parameters, followed in the first of them."""

    equations: DefiningSystem
    system: System = dataclasses.field(kw_only=True)

    # Smooth, with longer steps than for orbits, and without ends that need short ones.
    steps = StepSizes(first=0.01, least=1e-6, growth=1.5, straight=0.99, easy=12, corner=0.0)
    solution = "tangency"

    def solve(self, guess: np.ndarray, constraint: ArclengthConstraint) -> Root:
        """Solve the defining system."""
        return _solve(self.system, self.equations, array_of(guess), constraint)

    def point(
        self, root: Root, constraint: ArclengthConstraint, along: np.ndarray
    ) -> TangencyPoint:
        """A point with the data of the tangency."""
        known = jax.tree.map(np.asarray, root.at.aux)
        return TangencyPoint(**at_root(root, constraint, along), known=known)

    def metric(self, point: TangencyPoint) -> np.ndarray:
        """Scales: the largest value on the orbit for a state, one period for a phase, the size of
        any other unknown."""
        size = np.tile(point.known.size, self.equations.options.arcs)
        q = abs(point.u[size.size :])
        if self.system.period is not None:
            q[0] = 1.0
        return np.maximum(np.append(np.where(size == 0, 1, size), q), self.least)

    def elsewhere(
        self, here: TangencyPoint, start: TangencyPoint
    ) -> "tuple[TangencyCurve, TangencyPoint, TangencyPoint] | None":
        """The curve of a system with clocks, whose arcs keep their phases, with arcs that start far
        from the flight here."""
        if not self.system.clocks:
            return None
        known, pieces = self._pieces(here)
        node = quiet_node(pieces, *(float(v) * pieces.period for v in (known.start, known.stop)))
        known = dataclasses.replace(known, node=array_of(node / pieces.period, here.u.dtype))
        equations = dataclasses.replace(self.equations, tangency=known)
        curve = dataclasses.replace(self, equations=equations)
        point = self._seen(curve, here)
        return None if point is None else (curve, point, self._seen(curve, start) or start)

    def _seen(self, curve: "TangencyCurve", point: TangencyPoint) -> TangencyPoint | None:
        """A point as a point of a curve whose arcs start elsewhere."""
        _, pieces = self._pieces(point)
        arcs, node = self.equations.options.arcs, float(curve.equations.tangency.node)
        phases = node + np.arange(arcs) / arcs
        starts = np.ravel([pieces.state(phase * pieces.period) for phase in phases])
        u, along = (np.array(v) for v in (point.u, point.tangent))
        u[: starts.size], along[: starts.size] = starts, 0.0
        along /= np.linalg.norm(along)
        return curve.correct(u, constraint_across(u, point.scale, along, 0.0), along)

    def _pieces(self, point: TangencyPoint) -> tuple[Tangency, Pieces]:
        """The tangency at a point, and the pieces of its orbit."""
        equations = self.equations
        at = equations.there(self.system, array_of(point.u))
        tangency = equations.residual_at.tangency_at(at)
        options = dataclasses.replace(equations.options, t0=tangency.node * at.period)
        orbit = Orbit(
            x0=tangency.starts[0],
            period=at.period,
            monodromy=array_of(point.known.monodromy),
            residual=jnp.zeros_like(at.period),
            events=None,
            num_events=jnp.zeros((), jnp.int32),
            first_mode=tangency.mode.astype(jnp.int8),
            result=RESULTS.successful,
            system=at.system,
            starts=tangency.starts,
            num_steps=array_of(point.num_steps),
            options=options,
        )
        return tangency, pieces_of(orbit)

    def special_points(
        self, a: TangencyPoint, b: TangencyPoint
    ) -> Iterator[Special[TangencyPoint]]:
        """Points of codimension two: changes of the kind, a second tangency of the orbit, and a
        multiplier on the unit circle."""
        if a.kind != b.kind:
            name, test = _degeneracy(int(self.equations.family), a, b)
            point = zero_on_curve(self, a, b, test) if test(a) * test(b) < 0 else None
            # Without a change of sign the change is due to rounding.
            point = point or change_on_curve(self, a, b, lambda p: p.kind == a.kind)[1]
            yield from self._of_one_kind(a, point)
            yield Special(name, point, a.kind, b.kind)
            a = point
        yield from self._of_one_kind(a, b)

    def _of_one_kind(self, a: TangencyPoint, b: TangencyPoint) -> Iterator[Special[TangencyPoint]]:
        """Special points between two points of the same kind."""
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
        """A multiplier on the unit circle between two points of the same kind."""
        multipliers = lambda p: np.linalg.eigvals(p.known.monodromy)  # noqa: E731
        for kind, point in zeros_between(self, a, b, self._tests(), multipliers):
            yield Special(kind, point, a.kind, b.kind)

    def _tests(self) -> dict[str, Callable[[TangencyPoint], float]]:
        """Test functions of real multipliers of the orbit."""
        tests = {"period-doubling": lambda p: period_doubling(p.known.monodromy)}
        # An autonomous orbit always has a multiplier 1.
        if self.system.period is not None:
            tests["fold"] = lambda p: period_doubling(-p.known.monodromy)
        return tests

    def refusal(self, ahead: TangencyPoint) -> str | None:
        """A tangency of an orbit that is cut by a surface before it is not admissible."""
        return None if bool(ahead.known.holds) else "the orbit meets the surface elsewhere"


def _degeneracy(
    family: int, a: TangencyPoint, b: TangencyPoint
) -> tuple[str, Callable[[TangencyPoint], float]]:
    """The kind of the point between two tangencies of different kinds, and its test function: the
    bend for a cusp, where the tangency is cubic, the rate of the other side for a two-fold."""
    name = "slide_bend" if family == SLIDE else "bend"

    def bend(point: TangencyPoint) -> float:
        return float(getattr(point.known.conditions, name))

    if bend(a) * bend(b) <= 0:
        return "cusp", bend
    return "two-fold", lambda point: float(point.known.conditions.other_rate)
