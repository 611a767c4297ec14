"""Many lanes: parameters of a system swept over thousands of values.

A system, the name of a parameter and its values enter; the motion that each value settles on,
sampled once a forcing period, leaves. Lanes run in chunks, a chunk on every core at a time, and
each has its own outcome.
"""

import dataclasses
import functools as ft
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.lane.problem import period_outcome
from jaxfil.integrate.lane.state import SavedStates
from jaxfil.integrate.loop.batch import integrate_batch
from jaxfil.integrate.loop.iterate import integrate
from jaxfil.integrate.run.observed import Observable, Observe
from jaxfil.integrate.run.step_choice import StepChoice, steps_and_stepper
from jaxfil.integrate.steppers.explicit import Stepper, checked_stepper, tableau_of
from jaxfil.integrate.system.grade import is_compact_sweep
from jaxfil.model import check
from jaxfil.model.deprecation import renamed_argument
from jaxfil.model.labels import Labels, labels_of
from jaxfil.model.outcomes import RESULTS, code, outcomes
from jaxfil.model.parameter import cast, get_parameter, parameters
from jaxfil.model.section import Section
from jaxfil.model.system import System
from jaxfil.model.types import PathLike, Scalar, States, SweptValues
from jaxfil.model.warning import warn
from jaxfil.sweep import multiprocess, step_halving
from jaxfil.sweep.checkpoint import (
    Checkpoint,
    Record,
    digest,
    identity,
    observed_identity,
    record_of,
)
from jaxfil.sweep.conditions import Conditions
from jaxfil.sweep.diagram import BifurcationDiagram
from jaxfil.sweep.execution import BLOCK, compiled, one_after_another, side_by_side
from jaxfil.sweep.initial_states import initial_states, state_type
from jaxfil.sweep.interrupt import counted
from jaxfil.sweep.parameter_grid import ParameterGrid, parameter_grid
from jaxfil.sweep.sampling import Sampling, at_point, checked_observe, checked_section
from jaxfil.version import __version__
from jaxfil.xla.kernel import in_blocks, one_kernel


@renamed_argument("name", "parameter")
@counted()
def bifurcation_diagram(
    system: System,
    parameter: str | Sequence[str],
    values: SweptValues,
    x0: States,
    *,
    transient: int | None = None,
    samples: int = 100,
    steps: int | StepChoice = 40,
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
) -> BifurcationDiagram:
    """Sweep a parameter of a system, or several, and sample the motion at each value.

    For each value the system runs `transient` forcing periods T from t = 0 unseen, then `samples`
    periods, and its state is kept at the end of each: a stroboscopic Poincaré section,

        xs[i, k] = x((transient + k + 1) T; values[i])

    With a `section` it is sampled at its crossings instead, of forced and of autonomous systems:
    xs[i, k] is the state at crossing number transient + k + 1 from `transient_time` on, and
    times[i, k] its time.

    Ctrl-C ends the sweep after the chunks under way, or once it is compiled, with a warning, and
    returns what is done; a second one does not wait for chunks. The numbers do not depend on how
    many cores the machine has.

    **Several machines.** After `jax.distributed.initialize()` in every process (on a cluster, of
    `srun python sweep.py`) each makes this same call, computes its share of the chunks, on its
    cores or its one accelerator, and returns the whole diagram, equal to that of one process on the
    same hardware. A checkpoint may be on a file system that they share. With `follow` each computes
    the whole. On a CPU XLA lets a process wait half an hour for the slowest one, or as long as
    `XLA_FLAGS=--xla_cpu_collective_timeout_seconds=…` says.

    **Arguments**

    - `system`: a `System` with a `period`, or with a `section` any.
    - `parameter`: a float leaf of the system; a dotted path for nested modules, and "a[0,1]" for
      an entry of an array. Or k such names.
    - `values`: shape (p,). New values never recompile. For k names, a tuple of k arrays, whose
      product grid is swept, or one array of shape (p, k), a point in parameter space a row.
    - `x0`: the initial state of every lane, shape (n,), or one for each, shape (p, n); on a grid
      (p1, p2, …, n).
    - `transient`: forcing periods, or crossings, before the first sample, 0 or more; by default
      200, and with a `transient_time` 0.
    - `samples`: forcing periods, or crossings, sampled, 1 or more.
    - `steps`: steps per forcing period, or what `choose_step` gives, which has its own `stepper`;
      of an autonomous system per unit of time.
    - `stepper`: as in `solve`; by default `diffrax.Dopri8()`.
    - `follow`: "up" or "down" starts each value, in ascending or descending order, from the last
      one's end, which follows an attractor; by default each starts from `x0`.
    - `checkpoint`: a folder that keeps every chunk of lanes as soon as it is finished. The same
      call goes on from there, after Ctrl-C, a time limit or `kill -9`, and ends with the same
      numbers bit for bit. A call with other arguments is refused. Needs xarray and zarr.
    - `progress`: show a progress bar.
    - `estimate_error`: sweep a second time at half the step, and give the largest distance between
      the samples of the two as `errors`, an estimate of the global error; the cost is threefold.
    - `compact`: as in `solve`; by default so for up to 750,000 steps of all lanes together.
    - `section`: a `Section` whose crossings are sampled, such as `jf.maxima(…)`; its `terminal`
      does not matter here.
    - `max_return`: with a `section`, a time that is longer than the mean one from a crossing to the
      next: a lane is given up after transient + samples times that.
    - `transient_time`: with a `section`, a transient in time and not in crossings: crossings before
      t = `transient_time` do not count. It is the same for all lanes, however often each returns.
    - `observe`: as in `solve`, a function that returns a number or k of them, shape () or (k,):
      they are kept in place of the states, and called as the function is.

    **Returns** a `BifurcationDiagram`: samples `xs`, shape (p, samples, n) or (p1, p2, …, samples,
    n), their `times` with a `section`, and `errors`, shape (p, n) or (p1, p2, …, n), if asked for;
    of what is observed the last dimension is 1 or k.

    **Outcomes**, one for each lane in `results`: `successful`, `max_steps_reached`, `zeno`,
    `nonunique`, `mode_undecided`, `reset_undecided`, `undeclared_sliding`, `nonfinite`,
    `step_too_long`, `invalid_period`, `section_not_reached`, and after Ctrl-C `interrupted`. A lane
    that fails harms no other.

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
    check.system("system", system)
    dtype = state_type(x0)
    system = cast(system, dtype)
    grid = parameter_grid(parameter, values, dtype)
    for each in grid.names:
        get_parameter(system, each)
    if section is not None:
        section, max_return = checked_section(section, max_return, np.asarray(x0), dtype)
        if transient_time is not None:
            longest = check.scalar("transient_time", transient_time, dtype, positive=True)
            transient_time = float(np.asarray(longest))
    elif system.period is None:
        raise ValueError(
            f"`system` must be forced: a diagram samples once a forcing period, and the period of "
            f"{type(system).__name__} is None. Give a `section` to sample at."
        )
    if section is None and transient_time is not None:
        raise ValueError(
            "`transient_time` must be None without a `section`: forcing periods are counted by "
            f"`transient`; got {transient_time!r}."
        )
    if transient is None:
        transient = 200 if transient_time is None else 0
    named = labels_of(system, np.shape(x0)[-1])
    # Titles tell the other parameters too, without units.
    labels = dataclasses.replace(named.of(grid.names), symbols=named.symbols)
    observable = None
    if observe is not None:
        observable = checked_observe(observe, system, np.asarray(x0), dtype)
        units = tuple(pair for pair in labels.units if pair[0] in grid.names)
        labels = Labels(observable.names, labels.symbols, units)
    _check_follow(follow, grid)
    steps, stepper = steps_and_stepper(steps, stepper, system)
    stepper = checked_stepper(stepper)
    conditions = Conditions(
        parameters=_others(system, grid.names),
        x0=initial_states(x0, grid.shape, follow is not None).astype(dtype),
        transient=check.count("transient", transient, least=0),
        steps=steps,
        stepper=tableau_of(stepper).name,
        follow=follow,
        version=__version__,
    )
    samples = check.count("samples", samples)
    if section is not None:
        conditions = dataclasses.replace(
            conditions,
            section=identity(section, np.zeros(np.shape(x0)[-1:], dtype)),
            max_return=float(np.asarray(max_return)),
            transient_time=transient_time,
        )
    if observable is not None:
        identified = observed_identity(observable, system, np.zeros(np.shape(x0)[-1:], dtype))
        conditions = dataclasses.replace(conditions, observe=identified)
    each = (conditions.transient + samples) * conditions.steps
    compact = is_compact_sweep(compact, len(grid.rows), each)
    conditions = dataclasses.replace(conditions, compact=compact)
    check.number_of_steps(
        conditions.steps,
        runs=2 if estimate_error else 1,
        transient=conditions.transient,
        samples=samples,
    )
    record = ft.partial(record_of, system, grid, samples=samples, stepper=stepper)
    how = dict(
        samples=samples,
        stepper=stepper,
        section=section,
        observable=observable,
        progress=progress,
    )
    run = ft.partial(_swept, system, grid, **how)
    kept = _begun(checkpoint, ft.partial(record, conditions), estimate_error)
    found, codes = run(conditions, kept)
    k = found.shape[-1] - (section is not None)
    xs, times = found[..., :k], None if section is None else found[..., k]
    finished = _all_finished("sweep", "samples", codes, checkpoint)
    errors = np.full_like(xs[:, 0], np.nan) if estimate_error else None
    if estimate_error and finished:
        # The same lanes at half the step and not at twice: where a step is long against the motion
        # between two contacts, the error at twice the step says little of the error at one.
        half = dataclasses.replace(conditions, steps=2 * conditions.steps)
        folder = None if checkpoint is None else Path(checkpoint) / step_halving.FOLDER
        other_xs, other_codes = run(half, folder and Checkpoint(folder, record(half)))
        errors = step_halving.errors(xs, codes, other_xs[..., :k], other_codes, half)
        _all_finished("run at half the step", "errors", other_codes, checkpoint)
    return BifurcationDiagram(
        values=grid.values,
        xs=xs.reshape(*grid.shape, *xs.shape[1:]),
        results=outcomes(codes.reshape(grid.shape)),
        parameter=parameter if isinstance(parameter, str) else grid.names,
        system=type(system).__name__,
        conditions=conditions,
        labels=labels,
        errors=None if errors is None else errors.reshape(*grid.shape, -1),
        times=None if times is None else times.reshape(*grid.shape, -1),
    )


def _swept(
    system: System,
    grid: ParameterGrid,
    given: Conditions,
    kept: Checkpoint | None,
    *,
    samples: int,
    stepper: Stepper,
    section: Section | None,
    observable: Observable | None,
    progress: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Samples, shape (p, samples, k), and outcomes (p,) at all points; of a section the times of
    the samples behind them, shape (p, samples, k + 1)."""
    # Counts are traced, so that new ones compile nothing; `samples` is the shape of the result.
    longest, before = given.max_return, given.transient_time
    sampling = Sampling(
        transient=jnp.asarray(given.transient, jnp.int32),
        samples=samples,
        steps=jnp.asarray(given.steps, jnp.int32),
        stepper=stepper,
        compact=given.compact,
        section=section,
        max_return=None if longest is None else jnp.asarray(longest, grid.rows.dtype),
        observable=observable,
        transient_time=None if before is None else jnp.asarray(before, grid.rows.dtype),
    )
    k = given.x0.shape[-1] if observable is None else observable.size
    job = ft.partial(compiled(_run), system, grid.names, sampling)
    shape = samples, k + (section is not None)
    if given.follow is None:
        states = given.x0.reshape(-1, given.x0.shape[-1])
        return side_by_side(job, grid.rows, states, shape, kept, progress)
    # Stable, so that equal values keep their order and a repeated call gives the same diagram.
    order = np.argsort(grid.rows[:, 0], kind="stable")
    order = order if given.follow == "up" else order[::-1]
    xs, codes = one_after_another(job, grid.rows[order], given.x0, shape, kept, progress)
    back = np.argsort(order, kind="stable")
    return xs[back], codes[back]


def _check_follow(follow: object, grid: ParameterGrid) -> None:
    if follow not in (None, "up", "down"):
        raise ValueError(f'`follow` must be "up", "down" or None, got {follow!r}.')
    if follow is not None and len(grid.names) > 1:
        raise ValueError(f"`follow` must be None with several parameters, got {follow!r}.")


def _others(system: System, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The parameters that are not swept."""
    return {key: np.asarray(v) for key, v in parameters(system).items() if key not in names}


def _begun(
    checkpoint: PathLike | None, record: Callable[[], Record], estimate_error: bool
) -> Checkpoint | None:
    """The checkpoint, if one is asked for, after a look whether all processes ask for the same."""
    # Processes with other arguments would wait for each other's chunks for ever.
    if jax.process_count() > 1:
        multiprocess.same(digest({**record(), "estimate_error": str(estimate_error)}))
    return None if checkpoint is None else Checkpoint(checkpoint, record())


def _all_finished(what: str, lost: str, codes: np.ndarray, checkpoint: PathLike | None) -> bool:
    """Whether Ctrl-C left no lane unfinished; a warning where it did."""
    missing = codes == code(RESULTS.interrupted)
    if missing.any():
        rest = "" if checkpoint is None else f"; the same call goes on from {checkpoint}"
        warn(
            f"The {what} was interrupted: {int((~missing).sum())} of {missing.size} lanes are "
            f"finished, the {lost} of the others are NaN{rest}.",
            RuntimeWarning,
        )
    return not missing.any()


def _run(
    system: System,
    names: tuple[str, ...],
    sampling: Sampling,
    rows: Array,
    states: Array,
    lanes: Array,
    *,
    followed: bool,
    whole: bool,
) -> tuple[Array, RESULTS, Array]:
    """A chunk of lanes side by side, or one after the other each from the last one's end; of the
    first so many."""
    rows = sampling.rows(system, names, rows, states)
    problem = ft.partial(sampling.problem, system, names)
    seen = ft.partial(sampling.seen, system, names)
    periods = jax.vmap(lambda row: at_point(system, names, row)[1])(rows)

    def lane(row: Array, x0: Array) -> tuple[SavedStates, RESULTS, Array]:
        own = problem(row, x0)
        return sampling.outcome(integrate(own, own.system.unpack(x0)))

    def block(rows: Array, states: Array) -> tuple[SavedStates, RESULTS, Array]:
        return sampling.outcome(integrate_batch(problem, rows, states))

    alone = one_kernel(lane) if whole else lane
    numbers = jnp.arange(len(rows), dtype=jnp.int32)

    def single(row: Array, x0: Array, i: Array) -> tuple[SavedStates, RESULTS, Array]:
        # The lanes that fill up a chunk are not run.
        return _if(i < lanes, alone, row, x0)

    def each(rows: Array, states: Array) -> tuple[SavedStates, RESULTS, Array]:
        return jax.lax.map(lambda point: single(*point), (rows, states, numbers))

    if not followed:
        run = jax.vmap(lane)
        if whole:
            # One lane after the other is the program of one lane: half the time to compile.
            run = each if sampling.compact else in_blocks(block, BLOCK)
        samples, results, end = _if(lanes > 0, run, rows, states)
        xs = jax.vmap(seen)(rows, states, samples)
        return xs, jax.vmap(period_outcome)(periods, results), end

    def next_point(x: Array, point: tuple[Array, Array]) -> tuple[Array, tuple]:
        # A value whose lane failed leaves the next one the last good state to start from.
        row, i = point
        samples, result, end = single(row, x, i)
        return jnp.where((result == RESULTS.successful) & (i < lanes), end, x), (samples, result)

    end, (samples, results) = jax.lax.scan(next_point, states, (rows, numbers))
    xs = jax.vmap(seen, in_axes=(0, None, 0))(rows, states, samples)
    return xs, jax.vmap(period_outcome)(periods, results), end


def _if(flag: Array, function: Callable, *args: Array) -> Any:
    """`function(*args)` if the flag is set; otherwise it is not called, and what it gives is 0."""

    def nothing(*args: Array) -> Any:
        shapes = jax.eval_shape(function, *args)
        return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    return jax.lax.cond(flag, function, nothing, *args)
