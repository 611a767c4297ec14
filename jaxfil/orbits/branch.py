"""`Branch`: periodic orbits along a curve, with its special points."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.model import dataset_io
from jaxfil.model.card import outcome, precision
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS, is_successful
from jaxfil.model.parameter import replace_parameter
from jaxfil.model.types import Axes, Dataset, PathLike
from jaxfil.orbits.branch_arrays import branch_arrays
from jaxfil.orbits.chattering import rests_in
from jaxfil.orbits.curve import crossings
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.periodic_orbit import periodic_orbit
from jaxfil.orbits.phase_shift import quiet_between, state_at
from jaxfil.xla.known import part_of


class SpecialPoint(eqx.Module):
    """A point at which a branch of periodic orbits changes its character."""

    kind: str = eqx.field(static=True)
    """One of "fold" (the branch turns back), "period-doubling" (a multiplier is −1),
    "neimark-sacker" (a complex pair of multipliers leaves the unit circle), "branch-point" (another
    branch crosses, as one that breaks a symmetry), "rest" (it begins or ceases to rest on a
    surface) and "contacts" (their sequence changes otherwise). Impacts that die out are infinitely
    many, and their number does not change."""
    value: float
    """The parameter value, located to about 1e-10; to about 1e-7 where a contact disappears in a
    graze, since orbits with the contact are known to the square root of rounding there."""
    orbit: Orbit
    """The orbit at this value; where the contacts change, the first one after the change."""
    index: int = eqx.field(static=True)
    """It lies between the orbits number `index` − 1 and `index` of the branch."""
    before: tuple = eqx.field(static=True)
    """The contacts before, as in `Branch.sequences`."""
    after: tuple = eqx.field(static=True)
    """The contacts after."""
    direction: Float[np.ndarray, " u"]
    """The direction of the branch: how much the starts of all arcs, the period of an autonomous
    orbit and the parameter change together."""

    def __repr__(self) -> str:
        more = f"{len(self.before)} to {len(self.after)} contacts"
        if self.kind == "rest":
            before, after = rests_in(self.before), rests_in(self.after)
            told = [("begins", sorted(after - before)), ("ceases", sorted(before - after))]
            words = [f"{verb} on surface {j}" for verb, surfaces in told for j in surfaces]
            more = ", ".join([*words, more])
        changed = self.kind in ("contacts", "rest")
        return f"{self.kind} at {self.value:.12g}" + changed * f": {more}"


class Branch(eqx.Module):
    """A branch of k periodic orbits along a curve as one parameter varies."""

    parameter: str = eqx.field(static=True)
    """The name of the parameter."""
    values: Float[np.ndarray, " k"]
    """The parameter at each orbit. It turns back at a fold."""
    orbits: Orbit
    """All orbits as one record, whose arrays have a leading axis of k."""
    points: list[SpecialPoint]
    """The special points, in the order of the curve."""
    sequences: tuple = eqx.field(static=True)
    """The contacts of each orbit in order, each with its surfaces and the modes after it."""
    ended: tuple[str, str] = eqx.field(static=True)
    """The reason for the end of the curve, at either side. At "closed at …" it has returned to its
    start. At "the branch of half the period was met at …" two orbits of opposite phase coincide, at
    its period doubling. "no orbit was found beyond … (…)" has in parentheses the outcome of the
    shortest step, or that it leads away from the curve, as beyond a grazing orbit, and a large
    multiplier, as on the other side of one."""
    periods: int = eqx.field(static=True)
    """Forcing periods after which an orbit closes."""
    result: RESULTS
    """The outcome at the start: `successful`, even if the branch ends before `stop` (see `ended`);
    otherwise the outcome of Newton's method, and the branch has only the given orbit."""

    @property
    def stable(self) -> np.ndarray:
        """Whether each orbit is stable, shape (k,)."""
        return np.asarray(self.orbits.stable)

    @property
    def lost(self) -> tuple[bool, bool]:
        """Whether no orbit was found beyond the end, at either side."""
        first, last = ("was found beyond" in why for why in self.ended)
        return first, last

    def at(self, value: float) -> list[Orbit]:
        """The orbits of the branch at a value of the parameter, in its order. Newton's method finds
        each from its neighbours on the branch, and raises an error if it fails."""
        found, t0 = [], self.orbits.options.t0
        # A special point may be at another phase.
        turns = [p for p in self.points if p.kind == "fold" and np.all(p.orbit.options.t0 == t0)]
        folds, count = [(p.index, p.value) for p in turns], len(self.values)
        for i, *beside, part in crossings(np.asarray(self.values), value, folds):
            a, b = (
                part_of(self.orbits, j) if j < count else turns[j - count].orbit for j in beside
            )
            found.append(self._between(part_of(self.orbits, i), a, b, part, value))
        return found

    def _between(self, one: Orbit, a: Orbit, b: Orbit, part: float, value: float) -> Orbit:
        """The orbit at a value of the parameter between two neighbours, one of which has its
        options."""
        t0 = float(np.ravel(self.orbits.options.t0)[0])
        quiet = quiet_between(a, b, t0)
        if quiet is None:
            x0 = np.asarray(a.x0) + part * (np.asarray(b.x0) - np.asarray(a.x0))
            return self._found(one, x0, value, one.options.t0, one.period)
        # The state at t0 jumps between them, but not at a phase that no contact passes.
        x, y = (np.asarray(state_at(v, t0, quiet)) for v in (a, b))
        known = replace_parameter(one.system, self.parameter, value).period
        period = float(one.period) if known is None else self.periods * float(known)
        orbit = self._found(one, x + part * (y - x), value, t0 + quiet * period, one.period)
        x0 = np.asarray(state_at(orbit, t0, 0.0))
        back = self._found(one, x0, value, t0, orbit.period, throw=False)
        # An orbit with a contact just there is shot from elsewhere.
        return back if is_successful(back.result) else orbit

    def _found(
        self,
        one: Orbit,
        x0: np.ndarray,
        value: float,
        t0: Array | float,
        period: Array,
        throw: bool = True,
    ) -> Orbit:
        """The orbit near a state, with the options of one of the branch."""
        return periodic_orbit(
            replace_parameter(one.system, self.parameter, value),
            jnp.asarray(x0),
            periods=self.periods,
            period=None if one.system.period is not None else period,
            t0=t0,
            steps=one.options.steps // self.periods,
            stepper=one.options.stepper,
            segments=one.options.arcs,
            max_events=one.options.max_events,
            throw=throw,
        )

    def extremes(self) -> tuple[np.ndarray, np.ndarray]:
        """The smallest and the largest value of each component on every orbit, each (k, n)."""
        least, most = _extremes(self.orbits)
        return np.asarray(least), np.asarray(most)

    def plot(self, ax: Axes | None = None, component: int = 0, extremes: bool = False) -> Axes:
        """Draw one component of x0, or its smallest and largest value on the orbit, against the
        parameter, unstable parts dashed, with the special points. Returns the matplotlib axes."""
        return draw(self, ax=ax, component=component, extremes=extremes)

    def to_xarray(self) -> Dataset:
        """An `xarray.Dataset` of the arrays of its orbits (see `Orbit.to_xarray`) along `orbit`,
        with the parameter as coordinate, and of its special points along `special`, such as
        `special_kind`, `special_value` and `special_x0`.

        Sequences of contacts are JSON. Needs the package xarray.
        """
        return dataset_io.to_xarray(branch_arrays(self))

    def save(self, path: PathLike) -> None:
        """Write to a netCDF file (`path` ends in .nc), a Zarr store (.zarr) or an .npz.

        `jaxfil.load(path, system=…)` returns the same branch, bit for bit. An existing file is
        replaced.
        """
        dataset_io.save(branch_arrays(self), path)

    def __repr__(self) -> str:
        lines = [
            f"Branch of {type(self.orbits.system).__name__}{precision(self.orbits.x0)}: "
            f"{len(self.values)} orbits, "
            f"{self.parameter} from {self.values[0]:.6g} to {self.values[-1]:.6g} "
            f"(range {self.values.min():.6g} to {self.values.max():.6g})",
            f"  {outcome(self.result)}",
            f"  ends: {self.ended[0]}; {self.ended[1]}",
        ]
        return "\n".join(lines + [f"  {point}" for point in self.points])


@eqx.filter_jit
def _extremes(orbits: Orbit) -> tuple[Array, Array]:
    return eqx.filter_vmap(lambda orbit: orbit.extremes())(orbits)
