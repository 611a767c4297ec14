"""Curves of solutions for pseudo-arclength continuation.

Each kind of curve (orbits as a parameter varies, tangencies as two do) is a subclass of `Curve`.
"""

import abc
import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.model.outcomes import RESULTS, is_successful
from jaxfil.orbits.newton import Evaluation, Root

# Two neighbours on a smooth part of a curve have tangents at least at this cosine to each other.
SHARP = 0.9


class ArclengthConstraint(eqx.Module):
    """normal · (u − base)/scale = offset, or a batch of such constraints."""

    base: Float[Array, "*many N"]
    scale: Float[Array, "*many N"]
    normal: Float[Array, "*many N"]
    offset: Float[Array, "*many"]

    def appended(self, at: Evaluation, u: Array) -> Evaluation:
        """The evaluation at u, with this equation as the last one."""
        gap = jnp.sum(self.normal * (u - self.base) / self.scale) - self.offset
        return dataclasses.replace(
            at,
            residual=jnp.append(at.residual, gap),
            jacobian=jnp.concatenate([at.jacobian, (self.normal / self.scale)[None]]),
            equation_scale=jnp.append(at.equation_scale, 1.0),
            # Not 0 where a parameter passes through zero.
            unknown_scale=jnp.maximum(at.unknown_scale, self.scale),
        )


def constraint_across(
    base: np.ndarray, scale: np.ndarray, normal: np.ndarray, offset: float | np.ndarray
) -> ArclengthConstraint:
    """An `ArclengthConstraint` of NumPy arrays, or a batch."""
    return ArclengthConstraint(*jax.device_put((base, scale, normal, np.asarray(offset))))


@dataclasses.dataclass(frozen=True)
class CurvePoint:
    """A point of a curve: its unknowns u, their scales, the tangent of the curve in scaled unknowns
    (of length one), and the number of evaluations by Newton's method."""

    u: np.ndarray
    scale: np.ndarray
    tangent: np.ndarray
    num_steps: int


def tangent_of(root: Root, scale: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The tangent at a root, in scaled unknowns, to the side of `along`. It is the null vector of
    the equations without the last one, the constraint."""
    # The last right singular vector is the null vector, and has length one; its sign is arbitrary.
    rows = np.asarray(root.at.jacobian)[:-1] * scale
    tangent = np.linalg.svd(rows)[2][-1]
    return tangent if tangent @ along >= 0 else -tangent


def at_root(root: Root, constraint: ArclengthConstraint, along: np.ndarray) -> dict[str, Any]:
    """The fields of a `CurvePoint` at a root, by name; the tangent to the side of `along`."""
    scale = np.asarray(constraint.scale)
    return {
        "u": np.asarray(root.z),
        "scale": scale,
        "tangent": tangent_of(root, scale, along),
        "num_steps": int(root.num_steps),
    }


# The least scale of an unknown on a curve, relative to its initial value, and of a parameter: steps
# relative to a number that goes to zero would never reach zero.
_LEAST, _LEAST_OF_PARAMETER = 0.01, 0.1
# A parameter starts at zero if it starts below this fraction of its ends.
_SMALL = 1e-3


def least_scales(at_start: np.ndarray, place: int, ends: list[float]) -> np.ndarray:
    """The least scales of unknowns, from their scales at the start of a curve. The scale of the
    parameter, which may also start at zero, follows from the smaller of its start and end."""
    least = _LEAST * np.where(at_start == 0, 1.0, at_start)
    values = [abs(v) for v in ends if v != 0]
    if at_start[place] > _SMALL * max(values, default=0.0):
        values.append(at_start[place])
    least[place] = _LEAST_OF_PARAMETER * min(values, default=1.0)
    return least


def crossings(
    values: np.ndarray, value: float, folds: list[tuple[int, float]]
) -> Iterator[tuple[int, int, int, float]]:
    """Where a branch of points with these values takes a value: the number of the point at it or
    before it; the numbers of its neighbours, with the folds behind all points; and how far it is
    from the first of them to the second one, as a part of their distance. Each fold is the number
    of the point after it, and its value; the branch turns back there."""
    places, turns = [i for i, _ in folds], [v for _, v in folds]
    numbers = np.insert(np.arange(len(values)), places, [i - 1 for i in places])
    which = np.insert(np.arange(len(values)), places, len(values) + np.arange(len(folds)))
    ahead = np.insert(values, places, turns) - value
    folded = which >= len(values)
    after = np.append(ahead[1:], np.nan)
    for i in np.flatnonzero((ahead * after < 0) | ((ahead == 0) & ~folded)).tolist():
        part = 0.0 if ahead[i] == 0 else ahead[i] / (ahead[i] - after[i])
        j = min(i + 1, len(which) - 1)
        # Beside a fold the value is the square of the distance from it.
        if folded[i]:
            part = part**0.5
        elif folded[j]:
            part = 1 - (1 - part) ** 0.5
        yield int(numbers[i]), int(which[i]), int(which[j]), float(part)


_Point = TypeVar("_Point", bound=CurvePoint)


@dataclasses.dataclass(frozen=True)
class Special(Generic[_Point]):
    """A special point: its kind, and the properties that differ before and after it. It lies
    between the points number index − 1 and index of its curve."""

    kind: str
    point: _Point
    before: Any
    after: Any
    index: int = 0


@dataclasses.dataclass(frozen=True)
class StepSizes:
    """Step size control, in scaled unknowns: the first and the least step, and the growth of a step
    where the cosine of the tangent's turn is at least `straight` and Newton's method took at most
    `easy` evaluations. A step below `corner` may turn by any angle."""

    first: float
    least: float
    growth: float
    straight: float
    easy: int
    corner: float


class Curve(abc.ABC, Generic[_Point]):
    """A curve of solutions of N − 1 equations for N unknowns u, with its special points."""

    steps: ClassVar[StepSizes]
    """Step size control of the curve."""
    solution: ClassVar[str]
    """The word for a point of it."""
    place: ClassVar[int]
    """The index of the unknown that is the continuation parameter."""

    @property
    @abc.abstractmethod
    def parameter(self) -> str:
        """The name of that parameter."""

    @abc.abstractmethod
    def solve(self, guess: np.ndarray, constraint: ArclengthConstraint) -> Root:
        """Newton's root of the equations and the constraint, near a guess."""

    @abc.abstractmethod
    def point(self, root: Root, constraint: ArclengthConstraint, along: np.ndarray) -> _Point:
        """The point of a root, with its tangent to the side of `along`."""

    @abc.abstractmethod
    def metric(self, point: _Point) -> np.ndarray:
        """The scales in which a step from a point is measured."""

    @abc.abstractmethod
    def special_points(self, a: _Point, b: _Point) -> Iterable[Special[_Point]]:
        """The special points between two neighbours, in order."""

    def beyond_end(self, here: _Point) -> tuple[_Point, Special[_Point]] | None:
        """The point from which the curve continues if no step succeeds, and its special point."""
        return None

    def same(self, a: _Point, b: _Point) -> bool:
        """Whether two neighbours are on the same smooth part of the curve."""
        return True

    def jumps(self, a: _Point, b: _Point) -> bool:
        """Whether a step from a to b has left the curve for another one, or another part of it."""
        return False

    def special_end(self, here: _Point) -> Iterable[Special[_Point]]:
        """Special points at the end of the curve."""
        return ()

    def overlooked(
        self, points: Sequence[_Point], special: Sequence[Special[_Point]]
    ) -> Iterable[Special[_Point]]:
        """Special points that only all points of the curve together show."""
        return ()

    def elsewhere(
        self, here: _Point, start: _Point
    ) -> "tuple[Curve[_Point], _Point, _Point] | None":
        """The same curve in other unknowns, in which it may continue where no step succeeds, with
        the current point and the start."""
        return None

    def last_between(self, here: _Point, ahead: _Point) -> tuple[_Point, str] | None:
        """The last point of the curve between two neighbours, and the reason, although solutions of
        the equations continue."""
        return None

    def beyond_last(self, last: _Point) -> "tuple[Curve[_Point], _Point, Special[_Point]] | None":
        """The curve of other equations that continues from the last point of these, that point on
        it, and its special point."""
        return None

    def beside(self, point: _Point, other: _Point) -> np.ndarray:
        """The unknowns of a point in the form most similar to another one's."""
        return point.u

    def refusal(self, ahead: _Point) -> str | None:
        """The reason why a solution of the equations does not belong to the curve, or None."""
        return None

    def about(self, point: _Point) -> str:
        """A remark on the last point of a curve."""
        return ""

    def told(self, point: _Point) -> str:
        """The position of a point, in words."""
        return f"{self.value(point):.10g}"

    def value(self, point: _Point) -> float:
        """The parameter at a point."""
        return float(point.u[self.place])

    def correct(
        self, guess: np.ndarray, constraint: ArclengthConstraint, along: np.ndarray
    ) -> _Point | None:
        """The point near a guess that satisfies a constraint, or None."""
        return self.begin(guess, constraint, along)[0]

    def begin(
        self, guess: np.ndarray, constraint: ArclengthConstraint, along: np.ndarray
    ) -> tuple[_Point | None, RESULTS]:
        """`correct`, and the outcome of Newton's method. The user cannot raise the number of
        evaluations, and a point of the curve needs few, so reaching it counts as stalled."""
        root = self.solve(guess, constraint)
        if is_successful(root.result):
            return self.point(root, constraint, along), root.result
        used_up = root.result == RESULTS.newton_max_steps_reached
        return None, RESULTS.where(used_up, RESULTS.newton_stalled, root.result)

    def along(self, here: _Point, ds: float) -> _Point | None:
        """The point at a distance along the tangent."""
        tangent = here.tangent if ds >= 0 else -here.tangent
        constraint = constraint_across(here.u, here.scale, tangent, abs(ds))
        return self.correct(here.u + ds * here.tangent * here.scale, constraint, here.tangent)

    def at_value(self, a: _Point, b: _Point, value: float) -> _Point | None:
        """The point between two neighbours where the parameter has a value."""
        # Across the axis the constraint fixes the parameter to the last bit.
        part = (value - self.value(a)) / (self.value(b) - self.value(a))
        base = a.u + part * (b.u - a.u)
        base[self.place] = value
        constraint = constraint_across(base, a.scale, self.axis(base), 0.0)
        return self.correct(base, constraint, b.tangent)

    def axis(self, u: np.ndarray) -> np.ndarray:
        """The direction in which the parameter alone changes."""
        normal = np.zeros_like(u)
        normal[self.place] = 1.0
        return normal
