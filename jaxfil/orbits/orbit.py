"""`Orbit`: a periodic orbit, with multipliers, stability, states at any time and extreme values."""

import functools as ft
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from jaxfil.integrate.run.options import enough_iterations
from jaxfil.integrate.run.solution import Dense, Events, Solution
from jaxfil.integrate.run.solve import solve
from jaxfil.integrate.run.step_choice import expected_steps
from jaxfil.integrate.system.dependencies import constants_of
from jaxfil.model import dataset_io
from jaxfil.model.card import outcome, precision
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS, EventKind, raise_if_failed
from jaxfil.model.system import System
from jaxfil.model.types import Axes, Dataset, PathLike
from jaxfil.orbits.constant import unchanged
from jaxfil.orbits.extremes import extremes_of
from jaxfil.orbits.orbit_arrays import orbit_arrays
from jaxfil.orbits.shooting import ShootingOptions, first_failure, merged
from jaxfil.xla.known import in_numpy, is_known, part_of
from jaxfil.xla.select import select

# The factor by which there is room for more steps if there was not enough, and for a traced run,
# which cannot be repeated; and the room from which on there is no more.
_MORE, _MOST_ROOM = 16, 2**20


class Orbit(eqx.Module):
    """A periodic orbit, x(t0 + T) = x(t0).

    Only `x0`, `starts` and `period` have derivatives (with respect to the float leaves of the
    system); all other derivatives are NaN.
    """

    x0: Float[Array, " n"]
    """The state at t0 = `options.t0`."""
    period: Float[Array, ""]
    """The period T, a multiple of the forcing period, or computed for an autonomous system."""
    monodromy: Float[Array, "n n"]
    """The monodromy matrix ∂x(t0 + T)/∂x(t0), exact through every contact. NaN if it does not
    exist."""
    residual: Float[Array, ""]
    """The largest mismatch of any arc's end with the next one's start, each component relative to
    its running maximum on the orbit, which fades from step to step."""
    events: Events | None
    """The contacts of one period, in order."""
    num_events: Int[Array, ""]
    """The number of contacts of one period."""
    first_mode: Int[Array, " m"]
    """The mode at t0: ±1 is a side of a surface, 0 sliding on it."""
    result: RESULTS
    """The outcome of the search."""
    system: System
    """The system, with the parameters of this orbit."""
    starts: Float[Array, "M n"]
    """The states at the starts of the M arcs of multiple shooting; the first one is `x0`."""
    num_steps: Int[Array, ""]
    """Number of evaluations of the period map by Newton's method."""
    options: ShootingOptions
    """The options of the integration."""

    @property
    def multipliers(self) -> Complex[Array, "*batch n"]:
        """The Floquet multipliers, eigenvalues of the monodromy matrix, shape (n,). An autonomous
        orbit has a multiplier 1, and so has a component whose field is zero, such as a latch, that
        no event changes; a sticking orbit has a multiplier 0."""
        return _multipliers(self.monodromy)

    @property
    def stable(self) -> Array:
        """Whether all multipliers are inside the unit circle, except an autonomous system's 1, and
        the 1 of a component of the state that only events change, but none of this orbit."""
        constant = constants_of(self.system, self.x0, self.x0.ndim - 1)
        others = _multipliers(_without(constant, self.monodromy))
        inside = _are_inside(others, autonomous=self.system.period is None)
        return inside & (self.result == RESULTS.successful)

    def states(self, ts: Float[Array, " k"]) -> Float[Array, "k n"]:
        """The states at times of the first period, in order, shape (k, n)."""
        sol = self._saved(1, ts)
        assert sol.xs is not None
        return sol.xs

    def extremes(self) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The smallest and the largest value of each component on the orbit, between the steps
        too, each of shape (n,); NaN if it cannot be followed for a period."""
        return extremes_of(self.system, self.options, self.starts, self.period)

    def dense(self) -> Dense:
        """Every step of the first period. Raises an error if it cannot be followed."""

        def run(room: int) -> Solution:
            return self._solved(1, diffrax.SaveAt(dense=True), room)

        dense = self._every_step(run)._dense
        assert dense is not None
        return dense

    def trajectory(self, periods: int = 1) -> Solution:
        """The orbit as a `Solution` with ten states for each step, because a step of high order is
        too long for a straight line."""
        end = self.options.t0 + periods * self.period
        ts = jnp.linspace(self.options.t0, end, 10 * self._steps * periods + 1)
        return self._saved(periods, ts)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the orbit in the plane of its first two components, with the surfaces of its system;
        returns the matplotlib axes."""
        return draw(self, ax=ax)

    def to_xarray(self) -> Dataset:
        """An `xarray.Dataset` of `x0`, `period`, `monodromy`, the contacts (`event_t`, `event_x`,
        `event_kind`, …), `multiplier_real` and `multiplier_imag`, `stable` and `outcome` in words;
        for a batch with the leading dimension `lane`.

        The attributes have the system, its parameters and the options of the integration. Needs the
        package xarray.
        """
        return dataset_io.to_xarray(orbit_arrays(self))

    def save(self, path: PathLike) -> None:
        """Write to a netCDF file (`path` ends in .nc), a Zarr store (.zarr) or an .npz.

        `jaxfil.load(path, system=…)` returns the same orbit, bit for bit. An existing file is
        replaced.
        """
        dataset_io.save(orbit_arrays(self), path)

    @property
    def _steps(self) -> int:
        """Approximate number of steps of a period."""
        return expected_steps(self.options.steps, self.options.stepper)

    def _saved(self, periods: int, ts: Array) -> Solution:
        """The run from t0 with its states at some times."""
        # An unstable orbit cannot be followed for long, and starts again after each period.
        if self.options.arcs == periods == 1:
            return self._solved(periods, diffrax.SaveAt(ts=ts))
        return _joined(self, self._arcs(periods, ts), ts)

    def _arcs(self, periods: int = 1, ts: Array | None = None) -> Solution:
        """The arcs of some periods, a batch of runs, each from its own start, since errors would
        grow too much in one run. With times, each has the states at those within it; without, every
        step."""
        count = self.options.arcs * periods
        # As many steps as in the search for the orbit.
        steps = -(-self.options.steps // self.options.arcs)
        length = self.period / self.options.arcs
        starts = jnp.tile(self.starts, (periods, 1))

        def run(number: Array, start: Array, room: int | None) -> Solution:
            t0 = self.options.t0 + number * length
            t1 = t0 + length
            at = (
                diffrax.SaveAt(dense=True)
                if ts is None
                else diffrax.SaveAt(ts=jnp.clip(ts, t0, t1))
            )
            return solve(
                self.system,
                start,
                t0,
                t1,
                length / steps,
                stepper=self.options.stepper,
                saveat=at,
                max_events=self.options.max_events,
                max_steps=room,
                throw=False,
            )

        def all_of(room: int | None) -> Solution:
            each = eqx.filter_vmap(ft.partial(run, room=room))
            return each(jnp.arange(count).astype(starts.dtype), starts)

        return all_of(None) if ts is not None else self._every_step(all_of)

    def _every_step(self, run: Callable[[int], Solution]) -> Solution:
        """A run, or a batch of runs, with every step, given the iterations there is room for."""
        # How many a run takes is unknown under a tolerance, with ticks, or with halved steps.
        room, known = enough_iterations(self._steps, self.options.max_events), is_known(self)
        sol = run(room if known else _MORE * room)
        while known and room < _MOST_ROOM and _is_short(sol):
            room *= _MORE
            sol = run(room)
        return raise_if_failed(sol, sol.result)

    def _solved(self, periods: int, saveat: diffrax.SaveAt, room: int | None = None) -> Solution:
        """The run from t0, in as many iterations as there is `room` for if every step is saved."""
        t0, period = in_numpy((self.options.t0, self.period))
        return solve(
            self.system,
            self.x0,
            t0,
            t0 + periods * period,
            period / self.options.steps,
            stepper=self.options.stepper,
            saveat=saveat,
            max_events=self.options.max_events * periods,
            max_steps=room,
            throw=False,
        )

    def __repr__(self) -> str:
        return _card(self)


def _is_short(sol: Solution) -> bool:
    """Whether a run, or any of several, has used up its iterations."""
    return bool(np.any(sol.result == RESULTS.max_steps_reached))


def dense_arcs(orbit: Orbit) -> list[Dense]:
    """Every step of the first period of an orbit, of each arc from its own start."""
    if orbit.options.arcs == 1:
        return [orbit.dense()]
    arcs = orbit._arcs()._dense
    return [part_of(arcs, i) for i in range(orbit.options.arcs)]


@jax.jit
def _multipliers(monodromy: Array) -> Array:
    # A failed orbit has no multipliers; LAPACK must not receive a NaN.
    fine = jnp.all(jnp.isfinite(monodromy), axis=(-2, -1))
    values = jnp.linalg.eigvals(select(fine[..., None, None], monodromy, 0))
    return select(fine[..., None], values, jnp.nan)


@jax.jit
def _without(constant: Array, monodromy: Array) -> Array:
    """The monodromy matrix with a multiplier 0 in place of the 1 of each constant component that no
    event has changed."""
    return select(unchanged(constant, monodromy)[..., None], 0, monodromy)


@ft.partial(jax.jit, static_argnames="autonomous")
def _are_inside(multipliers: Array, autonomous: bool) -> Array:
    """Whether all multipliers, except an autonomous system's 1, are inside the unit circle."""
    size = abs(multipliers)
    if autonomous:
        # It equals 1 up to the error of the orbit; the nearest multiplier is taken.
        trivial = jnp.argmin(abs(multipliers - 1), axis=-1)[..., None]
        size = select(jnp.arange(size.shape[-1]) == trivial, 0, size)
    return jnp.max(size, axis=-1) < 1


def _joined(orbit: Orbit, arcs: Solution, ts: Array) -> Solution:
    """The arcs of an orbit as one run with the states at some times."""
    assert arcs.xs is not None and arcs.modes is not None
    count = arcs.xs.shape[0]
    length = orbit.period / orbit.options.arcs
    # A state at the end of an arc is the start of the next one.
    own = jnp.floor((ts - orbit.options.t0) / length).astype(jnp.int32)
    own, each = jnp.clip(own, 0, count - 1), jnp.arange(ts.shape[0])
    return Solution(
        ts=jnp.asarray(ts),
        xs=arcs.xs[own, each],
        modes=arcs.modes[own, each],
        events=merged(arcs.events, orbit.options.max_events * count),
        num_events=jnp.sum(arcs.num_events, dtype=jnp.int32),
        result=first_failure(arcs.result, count),
        stats=jax.tree.map(lambda v: jnp.sum(v, dtype=v.dtype), arcs.stats),
        t_final=arcs.t_final[-1],
        x_final=arcs.x_final[-1],
        mode_final=arcs.mode_final[-1],
        labels=arcs.labels,
        compact=arcs.compact,
    )


def _card(orbit: Orbit) -> str:
    told = precision(orbit.x0)
    if isinstance(orbit.x0, jax.core.Tracer) or orbit.x0.ndim > 1:
        *batch, n = orbit.x0.shape
        return f"Orbit{told}: a batch of shape {tuple(batch)}, states of {n}"
    show = ft.partial(np.array2string, precision=10, separator=", ")
    lines = [
        f"Orbit of {type(orbit.system).__name__}{told}: {outcome(orbit.result)}",
        f"  period {float(orbit.period):.12g}, x0 = {show(np.asarray(orbit.x0))} at t = "
        f"{float(orbit.options.t0):g}",
        f"  multipliers {show(np.asarray(orbit.multipliers))}: "
        + ("stable" if bool(orbit.stable) else "unstable"),
        f"  {_sequence(orbit)}, residual {float(orbit.residual):.1e} "
        f"after {int(orbit.num_steps)} Newton steps",
    ]
    return "\n".join(lines)


def _sequence(orbit: Orbit) -> str:
    if orbit.events is None or int(orbit.num_events) == 0:
        return "no contacts"
    kinds = np.asarray(orbit.events.kinds)
    return ", ".join(EventKind(k).name for k in kinds[kinds != EventKind.none])
