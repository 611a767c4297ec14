"""`EquilibriumBranch`: equilibria along a curve, with their bifurcations."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxfil.equilibria.equilibrium import Equilibrium
from jaxfil.equilibria.search import equilibrium
from jaxfil.model.card import outcome, precision
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import replace_parameter
from jaxfil.model.types import Axes
from jaxfil.orbits.curve import crossings
from jaxfil.xla.known import part_of

EQUILIBRIUM_BIFURCATION_KINDS = ("fold", "hopf", "persistence", "nonsmooth-fold")
"""The kinds of points that `continue_equilibrium` locates.

- `"fold"`: two equilibria of one mode merge, and the branch turns back.
- `"hopf"`: a complex pair of eigenvalues is on the imaginary axis.
- `"persistence"`: a boundary equilibrium with one equilibrium of either mode on its two sides. A
  regular one becomes a pseudo-equilibrium, or comes to rest.
- `"nonsmooth-fold"`: a boundary equilibrium in which the equilibria of both modes merge, and the
  branch turns back.
"""


class EquilibriumBifurcation(eqx.Module):
    """A bifurcation on a branch of equilibria."""

    kind: str = eqx.field(static=True)
    """One of `EQUILIBRIUM_BIFURCATION_KINDS`."""
    value: float
    """The parameter there, located to about 1e-12 of the size of the unknowns."""
    equilibrium: Equilibrium
    """The equilibrium there, in one of the two modes."""
    index: int = eqx.field(static=True)
    """It lies between the equilibria number `index` − 1 and `index` of the branch, or is the
    latter. A boundary equilibrium belongs to the branch, in the mode after."""
    before: tuple[int, ...] = eqx.field(static=True)
    """The mode before, in the order of the branch."""
    after: tuple[int, ...] = eqx.field(static=True)
    """The mode after."""

    def __repr__(self) -> str:
        change = "" if self.before == self.after else f": mode {[*self.before]} to {[*self.after]}"
        return f"{self.kind} at {self.value:.12g}{change}"


class EquilibriumBranch(eqx.Module):
    """A branch of k equilibria along a curve as one parameter varies."""

    parameter: str = eqx.field(static=True)
    """The name of the parameter."""
    values: Float[np.ndarray, " k"]
    """The parameter at each equilibrium. It turns back at folds, smooth or not."""
    equilibria: Equilibrium
    """All equilibria as one record, whose arrays have a leading axis of k."""
    eigenvalues: Complex[np.ndarray, "k n"]
    """The eigenvalues of each, as in `Equilibrium.eigenvalues`."""
    points: list[EquilibriumBifurcation]
    """The bifurcations on the branch, in its order."""
    ended: tuple[str, str] = eqx.field(static=True)
    """The reason for the end of the curve, at either side."""
    result: RESULTS
    """The outcome at the start: `successful`, even if the branch ends before `stop` (see `ended`);
    otherwise the outcome of Newton's method, and the branch has only the given equilibrium."""

    @property
    def stable(self) -> Bool[np.ndarray, " k"]:
        """Whether each equilibrium is stable: all eigenvalues have negative real parts, except the
        0 of a component of the state that only events change, as a latch."""
        return np.asarray(self.equilibria.attracts)

    def at(self, value: float) -> list[Equilibrium]:
        """The equilibria of the branch at a value of the parameter, in its order."""
        found, modes = [], np.asarray(self.equilibria.mode)
        turns = [p for p in self.points if p.kind == "fold"]
        xs = np.asarray([*np.asarray(self.equilibria.x), *(p.equilibrium.x for p in turns)])
        folds = [(p.index, p.value) for p in turns]
        for i, a, b, part in crossings(np.asarray(self.values), value, folds):
            x = xs[a] + part * (xs[b] - xs[a])
            system = replace_parameter(part_of(self.equilibria.system, i), self.parameter, value)
            # Between two equilibria on both sides of a boundary the mode is the one before it.
            found.append(equilibrium(system, jnp.asarray(x), mode=modes[i]))
        return found

    def plot(self, ax: Axes | None = None, component: int = 0) -> Axes:
        """Draw one component against the parameter, unstable parts dashed, pseudo-equilibria thick,
        with the bifurcations on the branch. Returns the matplotlib axes."""
        return draw(self, ax=ax, component=component)

    def __repr__(self) -> str:
        lines = [
            f"EquilibriumBranch of {type(self.equilibria.system).__name__}"
            f"{precision(self.equilibria.x)}: {len(self.values)} equilibria, "
            f"{self.parameter} from {self.values[0]:.6g} to {self.values[-1]:.6g} "
            f"(range {self.values.min():.6g} to {self.values.max():.6g})",
            f"  {outcome(self.result)}",
            f"  ends: {self.ended[0]}; {self.ended[1]}",
        ]
        return "\n".join(lines + [f"  {point}" for point in self.points])
