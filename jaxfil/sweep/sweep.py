"""`bifurcation_diagram`: parameters of a system swept over thousands of values.

Lanes run in chunks, a chunk on every core at a time, and each lane has its own outcome.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from jaxfil.integrate.run.step_choice import StepCount
from jaxfil.integrate.steppers.explicit import Stepper
from jaxfil.model import check
from jaxfil.model.observe import Observe
from jaxfil.model.outcomes import RESULTS, code, outcomes
from jaxfil.model.quantity import Quantities
from jaxfil.model.section import Section
from jaxfil.model.system import System
from jaxfil.model.types import PathLike, Scalar, States, SweptValues
from jaxfil.model.warning import warn
from jaxfil.sweep import multiprocess, step_halving
from jaxfil.sweep.checkpoint import Checkpoint
from jaxfil.sweep.conditions import conditions_of
from jaxfil.sweep.diagram import BifurcationDiagram
from jaxfil.sweep.execution import one_after_another, side_by_side
from jaxfil.sweep.interrupt import counted
from jaxfil.sweep.plan import SweepPlan, sweep_plan
from jaxfil.sweep.record import digest, record_of
from jaxfil.sweep.sampling import Samples


@counted()
def bifurcation_diagram(
    system: System,
    parameter: str | Sequence[str],
    values: SweptValues,
    x0: States,
    *,
    transient: int | None = None,
    samples: int = 100,
    steps: StepCount = 40,
    stepper: Stepper | None = None,
    follow: Literal["up", "down"] | None = None,
    checkpoint: PathLike | None = None,
    progress: bool = True,
    estimate_error: bool = False,
    compact: bool | None = None,
    section: Section | None = None,
    max_return: Scalar | None = None,
    transient_time: Scalar | None = None,
    observe: Observe | None = None,
    average: Quantities | None = None,
) -> BifurcationDiagram:
    """Sweep a parameter of a system, or several, and sample the motion at each value.

    For each value the system discards the first `transient` forcing periods T from t = 0, then runs
    `samples` periods and stores its state at the end of each, a stroboscopic Poincaré section,

        xs[i, k] = x((transient + k + 1) T; values[i])

    With a `section` its crossings are sampled instead, for forced and autonomous systems:
    xs[i, k] is the state at crossing number transient + k + 1 from `transient_time` on, and
    times[i, k] its time.

    Ctrl-C stops after the running chunks (or after compiling), with a warning, and returns the
    finished lanes; a second one stops at once. The numbers do not depend on the number of cores.

    **Several machines.** After `jax.distributed.initialize()` in every process (on a cluster, of
    `srun python sweep.py`) each process makes this same call, computes its share of the chunks, on
    its cores or its one accelerator, and returns the whole diagram, equal to the diagram of one
    process on the same hardware. A checkpoint may be on a file system that they share. With
    `follow` each computes the whole. On a CPU XLA lets a process wait half an hour for the slowest
    one, or the time in `XLA_FLAGS=--xla_cpu_collective_timeout_seconds=…`.

    **Arguments**

    - `system`: a `System` with a `period`, or any `System` with a `section`.
    - `parameter`: a scalar float leaf of the system; a dotted path for nested modules, and "a[0,1]"
      for an entry of an array. Or k such names.
    - `values`: shape (p,). New values never recompile. For k names, a tuple of k arrays, whose
      product grid is swept, or one array of shape (p, k), one point in parameter space per row.
    - `x0`: the initial state of every lane, shape (n,), or one for each, shape (p, n); on a grid
      (p1, p2, …, n).
    - `transient`: forcing periods, or crossings, before the first sample, 0 or more; by default
      200, and with a `transient_time` 0.
    - `samples`: sampled forcing periods, or crossings, 1 or more.
    - `steps`: steps per forcing period, for an autonomous system per unit of time; or `Adaptive`, a
      tolerance; or the result of `choose_step`, which has its own `stepper`.
    - `stepper`: as in `solve`; by default `diffrax.Dopri8()`.
    - `follow`: "up" or "down" starts each value, in ascending or descending order, from the end of
      the previous one, which follows an attractor; by default each starts from `x0`. At a `section`
      the phases of the force and of clocks continue too, and a lane starts at a time of its first
      period, or later if the clocks do not return to their phases after it.
    - `checkpoint`: a folder in which every chunk of lanes is stored as soon as it is finished. The
      same call resumes from there, after Ctrl-C, a time limit or `kill -9`, and ends with the same
      numbers bit for bit. A call with other arguments raises an error. Needs xarray and zarr.
    - `progress`: show a progress bar, and above it the cause of the first failure if all of the
      first lanes to finish have failed.
    - `estimate_error`: sweep a second time at half the step, and return the largest distance
      between the samples of the two as `errors`, an estimate of the global error; the cost is
      threefold.
    - `compact`: as in `solve`.
    - `section`: a `Section` whose crossings are sampled, such as `jf.maxima(…)`; its `terminal` is
      ignored.
    - `max_return`: with a `section`, a time longer than the mean time between crossings. A lane
      ends after transient + samples times this time.
    - `transient_time`: with a `section`, a transient in time instead of crossings. Crossings before
      t = `transient_time` do not count. It is the same for all lanes, however often each returns.
    - `observe`: as in `solve`, a function that returns a number or k numbers, shape () or (k,).
      They are stored instead of the states, under the name of the function.
    - `average`: numbers of each lane over the sampled time, from the end of the transient to the
      last sample, or with a `section` from the first sample to the last. Pass a function of the
      time, the state and the sides, whose mean is taken as in `average`; or `jf.RMS`, `jf.Maximum`,
      `jf.Minimum` or `jf.EventSum` of one; or a dictionary of these by name. An argument `system`
      receives the system of the lane, with the swept values. The share of time on a side of a
      surface is the mean of 0.5·(1 + side). Where a function jumps off the surfaces of the system,
      the error of its mean is of the order of a step, or with `Adaptive` of the tolerance. Times
      are the times in `vector_field`, which may restart each period.

    **Returns** a `BifurcationDiagram`: samples `xs`, shape (p, samples, n) or (p1, p2, …, samples,
    n), their `times` with a `section`, and `errors`, shape (p, n) or (p1, p2, …, n), if requested;
    for observed values the last dimension is 1 or k. `averages` holds the averages by name, arrays
    of the shape of the lanes and of the function's value, NaN for a failed lane.

    **Outcomes**, one for each lane in `results`: `successful`, `max_steps_reached`, `zeno`,
    `nonunique`, `mode_undecided`, `reset_undecided`, `undeclared_sliding`, `nonfinite`,
    `step_too_long`, `invalid_period`, `section_not_reached`, and after Ctrl-C `interrupted`. A lane
    that fails does not affect the others.

    **Source**: textbook; S. H. Strogatz, Nonlinear Dynamics and Chaos, Perseus (1994), section 10.2
    for diagrams and 12.5 for stroboscopic sections.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> sd, x0 = jf.systems.SDOscillator(), jnp.array([0.3, 0.1])
    >>> d = jf.bifurcation_diagram(
    ...     sd, "omega", jnp.array([0.6, 1.2]), x0, transient=20, samples=5, progress=False)
    >>> d.xs.shape
    (2, 5, 2)
    >>> omega, f0 = jnp.array([0.6, 0.8, 1.2]), jnp.array([0.2, 0.3])
    >>> d = jf.bifurcation_diagram(
    ...     sd, ("omega", "f0"), (omega, f0), x0, transient=20, samples=5, progress=False)
    >>> d.xs.shape
    (3, 2, 5, 2)
    >>> d = jf.bifurcation_diagram(sd, "omega", jnp.array([0.6, 1.2]), x0, transient=20, samples=5,
    ...     steps=20, estimate_error=True, progress=False)
    >>> d.errors.shape, bool(d.errors.max() < 1e-2)
    ((2, 2), True)
    """
    check.flags(progress=progress, estimate_error=estimate_error)
    folder = None if checkpoint is None else check.path("checkpoint", checkpoint)
    plan = sweep_plan(
        system,
        parameter,
        values,
        x0,
        transient=transient,
        samples=samples,
        steps=steps,
        stepper=stepper,
        follow=follow,
        compact=compact,
        section=section,
        max_return=max_return,
        transient_time=transient_time,
        observe=observe,
        average=average,
        runs=2 if estimate_error else 1,
    )
    kept = _begun(folder, plan, estimate_error)
    found, codes = _swept(plan, kept, progress)
    finished = _all_finished("sweep", "samples", codes, folder)
    errors = np.full_like(found.xs[:, 0], np.nan) if estimate_error else None
    if estimate_error and finished:
        errors = _errors(plan, found.xs, codes, folder, progress)
    return _assembled(plan, found, codes, errors)


def _swept(
    plan: SweepPlan, kept: Checkpoint | None, progress: bool
) -> tuple[Samples[np.ndarray], np.ndarray]:
    """Samples, shape (p, samples, k), and outcomes (p,) at all points."""
    run = side_by_side if plan.follow is None else one_after_another
    return run(plan, kept, progress)


def _errors(
    plan: SweepPlan,
    xs: np.ndarray,
    codes: np.ndarray,
    checkpoint: PathLike | None,
    progress: bool,
) -> np.ndarray:
    """The distance of the samples from the samples of a second sweep."""
    # The same lanes at half the step instead of twice the step. Where a step is long against the
    # motion between two contacts, the error at twice the step does not predict the error.
    half = plan.at_half_the_step()
    kept = None
    if checkpoint is not None:
        kept = _checkpoint(Path(checkpoint) / step_halving.FOLDER, half)
    other, other_codes = _swept(half, kept, progress)
    errors = step_halving.errors(xs, codes, other.xs, other_codes, half.steps_per_lane)
    _all_finished("run at half the step", "errors", other_codes, checkpoint)
    return errors


def _assembled(
    plan: SweepPlan, found: Samples[np.ndarray], codes: np.ndarray, errors: np.ndarray | None
) -> BifurcationDiagram:
    """The diagram of all lanes, along the dimensions of the grid."""
    grid, xs, times = plan.grid, found.xs, found.times
    return BifurcationDiagram(
        values=grid.values,
        xs=xs.reshape(*grid.shape, *xs.shape[1:]),
        results=outcomes(codes.reshape(grid.shape)),
        parameter=grid.names[0] if len(grid.names) == 1 else grid.names,
        system=type(plan.sampling.system).__name__,
        conditions=conditions_of(plan),
        labels=plan.labels,
        errors=None if errors is None else errors.reshape(*grid.shape, -1),
        times=None if times is None else times.reshape(*grid.shape, -1),
        halvings=found.halvings.reshape(grid.shape),
        averages=_averages(plan, found.averages),
    )


def _averages(plan: SweepPlan, rows: np.ndarray | None) -> dict[str, np.ndarray] | None:
    """The averages of all lanes by name, along the dimensions of the grid."""
    averaging = plan.sampling.averaging
    if averaging is None or rows is None:
        return None
    return averaging.named(rows.reshape(*plan.grid.shape, rows.shape[-1]))


def _begun(checkpoint: PathLike | None, plan: SweepPlan, estimate_error: bool) -> Checkpoint | None:
    """The checkpoint, if requested, after a check that all processes have the same arguments."""
    # Processes with other arguments would wait for each other's chunks for ever.
    if jax.process_count() > 1:
        multiprocess.same(digest({**record_of(plan), "estimate_error": str(estimate_error)}))
    return None if checkpoint is None else _checkpoint(checkpoint, plan)


def _checkpoint(path: PathLike, plan: SweepPlan) -> Checkpoint:
    return Checkpoint(path, record_of(plan), timed=plan.sampling.section is not None)


def _all_finished(what: str, lost: str, codes: np.ndarray, checkpoint: PathLike | None) -> bool:
    """Whether all lanes are finished; warns if Ctrl-C ended the sweep."""
    missing = codes == code(RESULTS.interrupted)
    if missing.any():
        rest = "" if checkpoint is None else f"; the same call continues from {checkpoint}"
        warn(
            f"The {what} was interrupted: {int((~missing).sum())} of {missing.size} lanes are "
            f"finished, the {lost} of the others are NaN{rest}.",
            RuntimeWarning,
        )
    return not missing.any()
