"""The plan of a sweep, its checked arguments.

It defines the work of each lane (`sampling`), the record by which a checkpoint identifies its sweep
(`record`) and the conditions in a saved diagram (`conditions`).
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.lane.problem import FINER
from jaxfil.integrate.run.averaging import Averaging, checked_averaging
from jaxfil.integrate.run.observed import Observable, checked_observable
from jaxfil.integrate.run.step_choice import expected_steps, steps_and_stepper
from jaxfil.integrate.steppers.explicit import checked_stepper, tableau_of
from jaxfil.integrate.system.grade import is_compact_sweep
from jaxfil.model import check
from jaxfil.model.labels import Labels, labels_of
from jaxfil.model.parameter import cast
from jaxfil.model.section import Section, sections_of
from jaxfil.model.system import System
from jaxfil.sweep.initial_states import initial_states, state_type
from jaxfil.sweep.parameter_grid import ParameterGrid, parameter_grid
from jaxfil.sweep.sampling import Samples, Sampling, depends_on_time
from jaxfil.xla.kernel import BLOCK


@dataclasses.dataclass(frozen=True)
class SweepPlan:
    """All arguments that affect the numbers of a sweep."""

    sampling: Sampling
    """The system, and the sampling of each lane."""
    grid: ParameterGrid
    """The points in parameter space, one for each lane."""
    x0: np.ndarray
    """The initial state of all lanes, shape (n,), or one for each."""
    follow: str | None
    """"up" or "down" if each value begins at the end of the previous one."""
    labels: Labels
    """Names of its quantities in pictures and named arrays."""

    @property
    def start(self) -> np.ndarray:
        """The initial states of lanes. If each lane starts at the phase of the forcing at which the
        previous one ended, a phase of 0 is appended."""
        return np.append(self.x0, self.x0.dtype.type(0)) if self.sampling.phased else self.x0

    @property
    def steps_per_lane(self) -> int:
        """Steps of a lane that is sampled once a forcing period."""
        each = self.sampling
        return (int(each.transient) + each.samples) * int(each.steps)

    def unfinished(self) -> Samples[np.ndarray]:
        """Samples of all lanes before the run, all unknown."""
        each, observable = self.sampling, self.sampling.observable
        k = self.x0.shape[-1] if observable is None else observable.size
        shape, dtype = (len(self.grid.rows), each.samples), self.x0.dtype
        times = None if each.section is None else np.full(shape, np.nan, dtype)
        halvings, averaging = np.zeros(shape[:1], np.int32), each.averaging
        averages = None
        if averaging is not None:
            averages = np.full((*shape[:1], len(averaging.columns)), np.nan, dtype)
        return Samples(np.full((*shape, k), np.nan, dtype), times, halvings, averages)

    def at_half_the_step(self) -> "SweepPlan":
        """The same plan with twice as many steps."""
        each = self.sampling
        half = dataclasses.replace(each, steps=2 * each.steps, share=FINER * each.share)
        return dataclasses.replace(self, sampling=half)


def sweep_plan(
    system: Any, parameter: Any, values: Any, x0: Any, *, follow: Any, runs: int, **sampled: Any
) -> SweepPlan:
    """The plan of these arguments of `bifurcation_diagram`, with `runs` runs; a second one is at
    half the step. They are checked here and therefore have no types yet."""
    check.system("system", system)
    dtype = state_type(x0)
    state = jnp.zeros(np.shape(x0)[-1:], dtype)
    system = cast(system, dtype)
    grid = parameter_grid(system, parameter, values, dtype)
    _check_follow(follow, grid)
    states = initial_states(x0, grid.shape, follow is not None).astype(dtype)
    sampling = sampling_of(
        system,
        state,
        grid.names,
        lanes=len(grid.rows),
        block=BLOCK if follow is None else 1,
        runs=runs,
        followed=follow is not None,
        **sampled,
    )
    labels = _labels(system, grid, sampling.observable, state.size)
    return SweepPlan(sampling, grid, states, follow, labels)


def sampling_of(
    system: System,
    x0: Array,
    names: tuple[str, ...] = (),
    *,
    transient: Any,
    samples: Any,
    steps: Any,
    stepper: Any,
    compact: Any,
    section: Any,
    max_return: Any,
    transient_time: Any,
    average: Any,
    always_averages: bool = False,
    observe: Any = None,
    lanes: int,
    block: int | None = None,
    runs: int = 1,
    followed: bool = False,
) -> Sampling:
    """The sampling of `lanes` lanes of a system, in a block of so many, from states like x0; the
    other arguments are those of `bifurcation_diagram`, whose `average` may be None unless the
    sampling `always_averages`. Lanes are `followed` if each begins where another one ends."""
    state = np.zeros(x0.shape, x0.dtype)
    section, longest, since = _sampled_at(system, section, max_return, transient_time, state)
    observable = None if observe is None else _observable(observe, system, state)
    steps, stepper = steps_and_stepper(steps, stepper, system)
    unseen, samples = _unseen(transient, since), check.count("samples", samples)
    averaging = None
    if always_averages or average is not None:
        tolerance = tableau_of(checked_stepper(stepper)).tolerance
        averaging = _averaging(average, system, state, section, samples, tolerance is not None)
    check.number_of_steps(steps, runs=runs, transient=unseen, samples=samples)
    stepper = checked_stepper(stepper)
    # The system of a lane and its state are both extended by the integrals along the motion.
    run = (system, x0) if averaging is None else averaging.carried(system, x0)
    grade = is_compact_sweep(
        compact,
        *run,
        stages=tableau_of(stepper).stages,
        lanes=lanes,
        # At half the step there are twice as many.
        steps=(unseen + samples) * expected_steps(steps, stepper) * (3 if runs > 1 else 1),
        block=block,
    )
    return Sampling(
        system=system,
        names=names,
        transient=jnp.asarray(unseen, jnp.int32),
        samples=samples,
        steps=jnp.asarray(steps, jnp.int32),
        stepper=stepper,
        compact=grade,
        section=section,
        max_return=longest,
        transient_time=since,
        observable=observable,
        averaging=averaging,
        share=jnp.ones((), x0.dtype),
        phased=followed and section is not None and depends_on_time(system),
    )


def _averaging(
    average: Any,
    system: System,
    state: np.ndarray,
    section: Section | None,
    samples: int,
    resolves: bool,
) -> Averaging:
    """The averages between the samples; `resolves` as in `Averaging`."""
    averaging = checked_averaging(
        *("average", average, system, jnp.asarray(state)),
        resolves=resolves,
        lasting=section is not None,
    )
    if section is not None and samples < 2:
        raise ValueError(
            "`samples` must be 2 or more with `average` and a `section`: averages are those from "
            f"the first sample to the last; got {samples}."
        )
    return averaging


def _unseen(transient: Any, since: Array | None) -> int:
    """Forcing periods, or crossings, before the first sample."""
    if transient is None:
        return 200 if since is None else 0
    return check.count("transient", transient, least=0)


def _sampled_at(
    system: System,
    section: Any,
    max_return: Any,
    transient_time: Any,
    state: np.ndarray,
) -> tuple[Section | None, Array | None, Array | None]:
    """The section to sample at, the bound of its mean return time, and the transient in time, in
    the precision of the run; None for once a forcing period."""
    if section is None:
        if system.period is None:
            raise ValueError(
                f"`system` must be forced, since a diagram samples once a forcing period, and the "
                f"period of {type(system).__name__} is None. Give a `section` to sample at."
            )
        if max_return is not None:
            raise ValueError(
                "`max_return` must be None without a `section` to return to, got "
                f"{check.told(max_return)}."
            )
        if transient_time is not None:
            raise ValueError(
                "`transient_time` must be None without a `section`, since forcing periods are "
                f"counted by `transient`; got {check.told(transient_time)}."
            )
        return None, None, None
    check.instance("section", section, Section)
    sections_of("section", section, system, jnp.asarray(state))
    if section.is_bound:
        raise ValueError("`section` must be one that motions cross, got a bound.")
    longest = check.scalar("max_return", max_return, state.dtype, positive=True)
    section = dataclasses.replace(section, function=cast(section.function, state.dtype))
    if transient_time is None:
        return section, longest, None
    return (
        section,
        longest,
        check.scalar("transient_time", transient_time, state.dtype, positive=True),
    )


def _observable(observe: Any, system: System, state: np.ndarray) -> Observable:
    """The function recorded instead of the states at samples."""
    observable = checked_observable("observe", observe, system, jnp.asarray(state))
    if len(observable.shape) > 1:
        raise ValueError(
            f"`observe` must return a number, or k of them in a row, got shape {observable.shape}."
        )
    return observable


def _labels(system: System, grid: ParameterGrid, observable: Observable | None, n: int) -> Labels:
    """Names of the samples' components, and of the swept parameters."""
    named = labels_of(system, n)
    # Titles name the other parameters too, without units.
    labels = dataclasses.replace(named.of(grid.names), symbols=named.symbols)
    if observable is None:
        return labels
    units = tuple(pair for pair in labels.units if pair[0] in grid.names)
    return Labels(observable.names, labels.symbols, units)


def _check_follow(follow: object, grid: ParameterGrid) -> None:
    if follow is not None and not (isinstance(follow, str) and follow in ("up", "down")):
        raise ValueError(f'`follow` must be "up", "down" or None, got {check.told(follow)}.')
    if follow is not None and len(grid.names) > 1:
        raise ValueError(f"`follow` must be None with several parameters, got {follow!r}.")
