"""Curves of bifurcations in the plane of two parameters: their equations, picture and card."""

import dataclasses
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxfil.model.card import outcome, precision
from jaxfil.model.drawing import draw
from jaxfil.model.labels import Labels
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

    parameters: tuple[str, str] = eqx.field(static=True)
    """The names of the parameters."""
    values: Float[np.ndarray, "k 2"]
    """The parameters at each point."""
    xs: Float[np.ndarray, "k n"]
    """The state at each point."""
    kinds: tuple[str, ...] = eqx.field(static=True)
    """The kind at each point."""
    ended: tuple[str, str] = eqx.field(static=True)
    """The reason for the end of the curve, at either side."""
    result: RESULTS
    """The outcome at the start: `successful`, even if the curve ends before `stop` (see `ended`);
    otherwise the reason, and the given bifurcation is the only point."""
    labels: Labels = eqx.field(static=True)
    """Names of the parameters in pictures."""

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
