"""A curve of solutions, as pseudo-arclength continuation sees it.

A guess and an `ArclengthConstraint` enter; the point of the curve that fulfils it leaves, with what
is known there. What differs from curve to curve (orbits as a parameter varies, tangencies as two
do) is said by a class of its own, a `Curve`.
"""

import abc
import dataclasses
from collections.abc import Iterable
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.model.outcomes import RESULTS, is_successful
from jaxfil.orbits.newton import Evaluation, Root


class ArclengthConstraint(eqx.Module):
    """normal · (u − base)/scale = offset, or many of them."""

    base: Float[Array, "*many N"]
    scale: Float[Array, "*many N"]
    normal: Float[Array, "*many N"]
    offset: Float[Array, "*many"]

    def appended(self, at: Evaluation, u: Array) -> Evaluation:
        """What is known at u, with this equation as the last one."""
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
    """An `ArclengthConstraint` of NumPy arrays, or many of them."""
    return ArclengthConstraint(*jax.device_put((base, scale, normal, np.asarray(offset))))


@dataclasses.dataclass(frozen=True)
class CurvePoint:
    """A point of a curve: its unknowns u, their scales, the tangent of the curve in scaled unknowns
    (of length one), and the evaluations that Newton's method took."""

    u: np.ndarray
    scale: np.ndarray
    tangent: np.ndarray
    num_steps: int


def tangent_of(root: Root, scale: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The tangent at a root, in unknowns of this scale, to the side of `along`: what the equations
    without the last one, the constraint, leave free."""
    # The last right singular vector is the null vector, and has length one; its sign is arbitrary.
    rows = np.asarray(root.at.jacobian)[:-1] * scale
    tangent = np.linalg.svd(rows)[2][-1]
    return tangent if tangent @ along >= 0 else -tangent


def at_root(root: Root, constraint: ArclengthConstraint, along: np.ndarray) -> dict[str, Any]:
    """What a root is as a `CurvePoint`, by the names of its fields; the tangent to the side of
    `along`."""
    scale = np.asarray(constraint.scale)
    return {
        "u": np.asarray(root.z),
        "scale": scale,
        "tangent": tangent_of(root, scale, along),
        "num_steps": int(root.num_steps),
    }


# What an unknown is measured by on a curve is this part at least of what it is at the start, and a
# parameter by this part: steps relative to a number that goes to zero would never get there.
_LEAST, _LEAST_OF_PARAMETER = 0.01, 0.1


def least_scales(at_start: np.ndarray, place: int, ends: list[float]) -> np.ndarray:
    """The least scales of unknowns, by their scales at the start of a curve. That of the parameter,
    which may start at zero too, is by the least of what it starts from and is to end at."""
    least = _LEAST * np.where(at_start == 0, 1.0, at_start)
    values = [abs(v) for v in (at_start[place], *ends) if v != 0]
    least[place] = _LEAST_OF_PARAMETER * min(values, default=1.0)
    return least


_Point = TypeVar("_Point", bound=CurvePoint)


@dataclasses.dataclass(frozen=True)
class Special(Generic[_Point]):
    """A special point: what happens there, and what is different before and after it. It lies
    between the points number index − 1 and index of its curve."""

    kind: str
    point: _Point
    before: Any
    after: Any
    index: int = 0


@dataclasses.dataclass(frozen=True)
class StepSizes:
    """How steps adapt, in scaled unknowns: the first and the least one, and by how much a step
    grows where the tangent has turned by no more than the cosine `straight` and Newton's method
    took at most `easy` evaluations. A step below `corner` may turn as it likes."""

    first: float
    least: float
    growth: float
    straight: float
    easy: int
    corner: float


class Curve(abc.ABC, Generic[_Point]):
    """A curve of solutions of N − 1 equations for N unknowns u, and what happens on it."""

    steps: ClassVar[StepSizes]
    """Its steps."""
    solution: ClassVar[str]
    """What a point of it is, in a word."""
    place: ClassVar[int]
    """Which of the unknowns is the parameter that it is followed in."""

    @property
    @abc.abstractmethod
    def parameter(self) -> str:
        """The name of that parameter."""

    @abc.abstractmethod
    def solve(self, guess: np.ndarray, constraint: ArclengthConstraint) -> Root:
        """Newton's root of the equations and the constraint, near a guess."""

    @abc.abstractmethod
    def point(self, root: Root, constraint: ArclengthConstraint, along: np.ndarray) -> _Point:
        """A root as a point, its tangent to the side of `along`."""

    @abc.abstractmethod
    def metric(self, point: _Point) -> np.ndarray:
        """The scales in which a step from a point is measured."""

    @abc.abstractmethod
    def special_points(self, a: _Point, b: _Point) -> Iterable[Special[_Point]]:
        """The special points between two neighbours, in order."""

    def beyond_end(self, here: _Point) -> tuple[_Point, Special[_Point]] | None:
        """The point from which the curve goes on where no step leads on, and what happens there."""
        return None

    def special_end(self, here: _Point) -> Iterable[Special[_Point]]:
        """What happens at a point beyond which there is none."""
        return ()

    def elsewhere(
        self, here: _Point, start: _Point
    ) -> "tuple[Curve[_Point], _Point, _Point] | None":
        """The same curve in other unknowns, in which it may go on where no step leads on, with the
        point here and the start."""
        return None

    def last_between(self, here: _Point, ahead: _Point) -> tuple[_Point, str] | None:
        """The last point of the curve between two neighbours, and why it is that, although
        solutions of the equations go on."""
        return None

    def beyond_last(self, last: _Point) -> "tuple[Curve[_Point], _Point, Special[_Point]] | None":
        """The curve of other equations that goes on from the last point of these, that point on it,
        and what happens there."""
        return None

    def beside(self, point: _Point, other: _Point) -> np.ndarray:
        """The unknowns of a point in the form in which they are most like another one's."""
        return point.u

    def refusal(self, ahead: _Point) -> str | None:
        """Why a solution of the equations is none of the curve's."""
        return None

    def about(self, point: _Point) -> str:
        """What is worth knowing of a point beyond which there is none, in words."""
        return ""

    def told(self, point: _Point) -> str:
        """Where a point is, in words."""
        return f"{self.value(point):.10g}"

    def value(self, point: _Point) -> float:
        """The parameter at a point."""
        return float(point.u[self.place])

    def correct(
        self, guess: np.ndarray, constraint: ArclengthConstraint, along: np.ndarray
    ) -> _Point | None:
        """The point near a guess that fulfils a constraint; None if there is none."""
        return self.begin(guess, constraint, along)[0]

    def begin(
        self, guess: np.ndarray, constraint: ArclengthConstraint, along: np.ndarray
    ) -> tuple[_Point | None, RESULTS]:
        """`correct`, and the outcome of Newton's method. Nobody can give it more evaluations: from
        a point of the curve it needs a few, so that to use up all of them is to be stalled."""
        root = self.solve(guess, constraint)
        if is_successful(root.result):
            return self.point(root, constraint, along), root.result
        used_up = root.result == RESULTS.newton_max_steps_reached
        return None, RESULTS.where(used_up, RESULTS.newton_stalled, root.result)

    def at_value(self, a: _Point, b: _Point, value: float) -> _Point | None:
        """The point between two neighbours where the parameter has a value."""
        # Across the axis the parameter is what the constraint says, to the last bit.
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
