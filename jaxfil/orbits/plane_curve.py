"""Curves of bifurcations in the plane of two parameters: their equations, picture and card."""

import dataclasses
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxfil.model.card import outcome, precision
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.types import Axes
from jaxfil.orbits.curve import Curve, CurvePoint

_Point = TypeVar("_Point", bound=CurvePoint)


@dataclasses.dataclass(frozen=True)
class EquationsCurve(Curve[_Point]):
    """The curve of equations with two free parameters, the last unknowns, in the first of which it
    is followed. `least` bounds scales from below."""

    equations: Any
    least: np.ndarray | float = 0.0

    solution = "bifurcation"
    place = -2

    @property
    def parameter(self) -> str:
        """The name of the first parameter."""
        return self.equations.free[0]

    def told(self, point: _Point) -> str:
        """Both parameters."""
        return f"({point.u[-2]:.8g}, {point.u[-1]:.8g})"


class PlaneCurve(eqx.Module):
    """The base class of curves of bifurcations in two parameters."""

    parameters: eqx.AbstractVar[tuple[str, str]]
    values: eqx.AbstractVar[Float[np.ndarray, "k 2"]]
    xs: eqx.AbstractVar[Float[np.ndarray, "k n"]]
    kinds: eqx.AbstractVar[tuple[str, ...]]
    ended: eqx.AbstractVar[tuple[str, str]]
    result: eqx.AbstractVar[RESULTS]

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the curve in the plane of its two parameters; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        a, b = self.parameters
        low, high = self.values.min(axis=0), self.values.max(axis=0)
        lines = [
            f"{type(self).__name__}{precision(self.xs)}, {len(self.values)} points: "
            f"{', '.join(dict.fromkeys(self.kinds))}",
            f"  {a} from {low[0]:.6g} to {high[0]:.6g}, {b} from {low[1]:.6g} to {high[1]:.6g}",
            f"  {outcome(self.result)}",
            f"  ends: {self.ended[0]}; {self.ended[1]}",
        ]
        return "\n".join(lines)
