"""`solve`: one initial value problem."""

import dataclasses
import functools as ft
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem, Recording, TimeGrid, iteration_budget
from jaxfil.integrate.lane.recorders import SaveDense, SaveSteps, SaveTimes
from jaxfil.integrate.lane.recording import mode_codes
from jaxfil.integrate.lane.state import LoopState, SavedStates
from jaxfil.integrate.loop.extensions import problem_of, sections_in
from jaxfil.integrate.loop.iterate import integrate, integrate_with_checkpoints
from jaxfil.integrate.run.failure import raise_unless_successful
from jaxfil.integrate.run.observed import Observable, checked_observable, observed, sections_of_run
from jaxfil.integrate.run.options import (
    Adjoint,
    Options,
    options_of,
    resolution,
    valid_ts,
)
from jaxfil.integrate.run.solution import Dense, Solution, crossings_of, errors, events_of
from jaxfil.integrate.run.step_choice import StepLength, dt_and_stepper
from jaxfil.integrate.steppers.adaptive import Adaptive
from jaxfil.integrate.steppers.explicit import Stepper, checked_stepper, tableau_of
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.grade import is_compact_run
from jaxfil.integrate.system.lowered import build
from jaxfil.model import check
from jaxfil.model.labels import labels_of
from jaxfil.model.observe import Observe
from jaxfil.model.outcomes import is_good
from jaxfil.model.parameter import cast
from jaxfil.model.section import Section, Sections, sections_of
from jaxfil.model.system import System
from jaxfil.model.types import Scalar, State
from jaxfil.xla.kernel import kernel_if_it_fits
from jaxfil.xla.lanes import is_batch_first
from jaxfil.xla.select import select

# Steps that end this close to the end of the span (in steps) are its last.
_WHOLE = 1e-6
# The largest number of steps that every float precision holds exactly.
_MOST = check.MOST_STEPS + 1 - 2**7


def solve(
    system: System,
    x0: State,
    t0: Scalar,
    t1: Scalar,
    dt: StepLength,
    *,
    stepper: Stepper | None = None,
    saveat: diffrax.SaveAt = diffrax.SaveAt(t1=True),  # noqa: B008
    max_events: int | None = 1024,
    max_steps: int | None = None,
    adjoint: Adjoint = diffrax.ForwardMode(),  # noqa: B008
    throw: bool = True,
    estimate_error: bool = False,
    compact: bool | None = None,
    sections: Sections | None = None,
    observe: Observe | None = None,
) -> Solution:
    r"""Integrate a nonsmooth system from `x0` at `t0` to `t1`.

    ẋ = F(t, x, side), side_j = sgn H_j(t, x), in Filippov's sense where the solution stays on a
    surface. Steps have the fixed length `dt`, or a length that follows a tolerance. A step is
    shorter only at the end of the span, where it ends on a contact, a tick of a clock or a terminal
    section, or where it is halved because it cannot be trusted; the next ones return to the grid. A
    state at a saving time comes from an additional step. Contacts are located to a few eps, and the
    order of the stepper is preserved.

    **Arguments**

    - `system`: a `System`; its float leaves are cast to the dtype of `x0`.
    - `x0`: initial state, shape (n,). Its dtype is the dtype of the whole computation;
      integers become floats.
    - `t0`, `t1`: the span of time; backward if t1 < t0.
    - `dt`: the length of a step, positive, and more than 8 eps·max(|t0|, |t1|); or `Adaptive`, a
      tolerance by which each step has its own length; or the result of `choose_step`, which has
      its own `stepper`.
    - `stepper`: an explicit diffrax Runge–Kutta solver such as `diffrax.Tsit5()`, `RK4()`,
      `Taylor()`, or for stiff fields `Rodas5P()`; by default `diffrax.Dopri8()`. One of order one
      or two has no error estimate in fixed steps: a step too long to be stable is not detected.
    - `saveat`: `diffrax.SaveAt` with one of `t1`, `ts`, `steps`, `dense` (and `t0` with `steps`);
      other options raise an error that names them. With `steps` the arrays have `max_steps` rows,
      by default several thousand; a smaller `max_events` makes them shorter.
    - `max_events`: length of the event table; None for no table and no limit.
    - `max_steps`: limit of the loop's iterations (a step takes one, a contact or a crossing about
      four, a tick two, a saving time one). By default 32 for each step and tick, and 100,000 for
      contacts. Where an array of that length is kept (`steps`, `dense`, reverse mode) it is 1 for
      each step, 6 for each of `max_events` (of 256 if that is None), 1 for each saving time, and
      16, rounded up to a power of two; it is then needed if the span or `dt` is traced, or there
      are many ticks, or more contacts and crossings.
    - `adjoint`: with `diffrax.ForwardMode()`, `jax.grad` and `jax.vjp` compute the forward
      derivative by each number that varies, and transpose the result; for hundreds of parameters,
      `diffrax.RecursiveCheckpointAdjoint()` runs the loop backward, with second derivatives by
      `jax.jacfwd(jax.grad(…))`. First and second derivatives with respect to x0, t0, t1,
      `saveat.ts` and every float leaf of the system are exact through crossings, slides and resets;
      third ones raise. At a graze one is infinite. States that a failed run does not reach have the
      derivative zero.
    - `throw`: raise an error unless the outcome is `successful` or `section_reached`; with False
      return every outcome in `result`. The error says t, x and the surface where it stopped, but
      not from within `jit`.
    - `estimate_error`: also run at half the step, and return the distance between the two as
      `errors`, an estimate of the global error; the cost is threefold. Needs `saveat` with `t1`
      or `ts`.
    - `compact`: whether the program is compact, with its stages in a loop and its lanes run one
      after the other. It compiles in a fifth to a half of the time of one that is written out, and
      takes 1.5 to 2 times as long to run for one lane, 5 to 30 times for many. By default a run of
      up to 8 lanes of a `jax.vmap` around it is compact (a `vmap` around a `jax.jit` that contains
      the call cannot be detected); diagrams, basins and exponents are compact if that is estimated
      to take less time over a few calls, compilation included: up to some 1 to 9 million steps of
      all lanes. So is a run of any number of lanes if that saves a minute of compilation, for
      several surfaces with resets in a state of several masses.
    - `sections`: a `Section`, or several, whose crossings are located on the way, without an effect
      on the motion. Their table has `max_events` rows too.
    - `observe`: a function of the time and the state, shape (n,), that returns an array of any
      shape: an energy, a force. It may take arguments of these names, each of the shape of H:
      `side`, as in `System.vector_field`; `reaction`, the forces of the surfaces rested on, in
      which it must be affine; `mode`, +1 or −1 on a side, 0 on a slide, +2 or −2 at rest. Its
      values at the saved times, just after their contacts, are `observed`; with `steps`, those just
      before a tick of a clock are too. On a slide they are blended from both sides, as the field
      is; for a dry friction, −F·side, this is the force that holds. Needs `saveat` with `t1`, `ts`
      or `steps`.

    **Returns** a `Solution`, valid up to `t_final`. Rows of `ts` and `xs` that a run has not
    reached are inf, as with `t1` the only row of a failed run is. If a section ended the run, the
    row of `t1` has the time and the state there.

    **Outcomes**: `successful`; `section_reached`, which is a success, and `out_of_bounds` for a run
    ended by a section; `max_steps_reached`, `max_events_reached`, `nonfinite` and `step_too_long`
    for a run that cannot continue; `nonunique`, `mode_undecided`, `undeclared_sliding` and `zeno`
    for a solution without a unique continuation; `reset_undecided` and, in backward time,
    `irreversible_reset` for a reset without one; `invalid_period` for a clock whose traced period
    is not positive.

    **Source**: the switch model: Piiroinen and Kuznetsov, An event-driven method to simulate
    Filippov systems with accurate computing of sliding motions, ACM Transactions on Mathematical
    Software 34 (2008); the derivative through contacts: Leine and Nijmeijer, Dynamics and
    Bifurcations of Non-Smooth Mechanical Systems, Springer 2004.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> sol = jf.solve(jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0]), 0.0, 20.0, 0.1)
    >>> print(round(float(sol.xs[-1, 0]), 4), int(sol.num_events))
    -0.2 4
    """
    x = check.state("x0", x0)
    check.flags(throw=throw, estimate_error=estimate_error)
    dtype = x.dtype
    check.system("system", system)
    system = cast(system, dtype)
    labels = labels_of(system, x.shape[0])
    start, stop = check.scalar("t0", t0, dtype), check.scalar("t1", t1, dtype)
    step, stepper = dt_and_stepper(dt, stepper)
    adaptive, length = isinstance(dt, Adaptive), _whole(start, stop)
    if not adaptive:
        length = check.scalar("dt", step, dtype, positive=True)
    stepper = checked_stepper(stepper)
    compact = is_compact_run(compact, system, x, (start, stop, length))
    # The numbers as the user gave them, since under `jit` an array of JAX is not a known number.
    times = t0, t1, length if adaptive else step
    options = options_of(saveat, max_events, max_steps, adjoint, compact, times, dtype, adaptive)
    recorder = options.recorder
    if estimate_error and not recorder.at_known_times:
        raise ValueError(
            f"`estimate_error` must be False with a `saveat` of {recorder.name}, since errors are "
            "estimated at times that do not depend on the step, t1 or ts; got True."
        )
    observable = None
    if observe is not None:
        observable = checked_observable("observe", observe, system, x)
        if isinstance(recorder, SaveDense):
            raise ValueError(
                "`observe` must be None with a `saveat` of dense, which saves no times; pass it to "
                f"`evaluate(t, observe=…)`; got {check.told(observe)}."
            )
    watched = sections_of("sections", sections, system, x)
    if estimate_error and any(s.terminal is not None for s in watched):
        raise ValueError(
            "`estimate_error` must be False with a section that ends the run, since errors are "
            "estimated at times that do not depend on the step; got True."
        )
    if throw:
        # Without `throw` the outcome is `nonfinite`.
        check.finite("x0", x)
    run = _solve
    # JAX (0.10) cannot batch equinox's loop with checkpoints within a `jit` and then differentiate
    # it, since it uses the rule of one lane for the batch.
    if options.reverse and is_batch_first((system, x, start, stop, length)):
        run = _run
    sol = run(system, x, start, stop, length, stepper, options, watched, observable)
    if estimate_error:
        # The estimate has no derivatives, and needs neither sections nor an observable.
        half = options.at_half_the_step()
        still, x, start, stop, half = _constant((system, x, start, stop, half))
        finer = _solve(still, x, start, stop, length / 2, stepper, half)
        sol = dataclasses.replace(sol, errors=errors(sol, finer))
    sol = dataclasses.replace(sol, labels=labels)
    return raise_unless_successful(sol, system, x) if throw else sol


def _whole(start: Array, stop: Array) -> Array:
    """The length of the single grid step of a run whose steps follow a tolerance."""
    start, stop = jax.lax.stop_gradient((start, stop))
    length, least = abs(stop - start), resolution(start, stop)
    # A step must exceed the rounding of times even in a span that does not.
    return select(length > least, length, 1.0 + 2 * least)


def _constant(tree: Any) -> Any:
    """The same values without derivatives."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), rest)


def _run(
    system: System,
    x0: Array,
    t0: Array,
    t1: Array,
    dt: Array,
    stepper: Stepper,
    options: Options,
    sections: tuple[Section, ...] = (),
    observable: Observable | None = None,
) -> Solution:
    problem_over = ft.partial(_problem, system, stepper, options, sections)

    def run(x0: Array, *span: Array) -> Solution:
        problem = problem_over(x0, *span)
        x = problem.system.unpack(x0)
        if options.reverse:
            assert options.budget is not None
            state = integrate_with_checkpoints(problem, x, options.budget, options.checkpoints)
        else:
            state = integrate(problem, x)
        if any(s.terminal is not None for s in sections):
            state = problem.recording.recorder.at_section(problem, state)
        return _solution(problem, options, x0, state)

    # The conversion of the end is inside the kernel. Its derivatives then need no values from
    # outside, so that a Jacobian is one kernel, not two; and each small part outside would take
    # longer to compile than to trace.
    whole = run if options.reverse else kernel_if_it_fits(run, options.compact)
    sol = whole(x0, t0, t1, dt)
    assert sol.ts is not None and sol.xs is not None and sol.modes is not None
    if observable is not None:
        problem, saves = problem_over(x0, t0, t1, dt), SavedStates(sol.ts, sol.xs, sol.modes)
        both = isinstance(options.recorder, SaveSteps)
        values = observed(observable, problem, system, x0, saves, both=both)
        return dataclasses.replace(sol, observed=values)
    if not isinstance(options.recorder, SaveDense):
        return sol
    # The span of dense output ends where the run stopped, which may be before t1.
    dense = Dense(system, t0, sol.t_final, sol.ts, sol.xs, sol.modes, stepper, options.compact)
    return dataclasses.replace(sol, ts=None, xs=None, modes=None, _dense=dense)


_solve = eqx.filter_jit(_run)


def _problem(
    system: System,
    stepper: Stepper,
    options: Options,
    sections: tuple[Section, ...],
    x0: Array,
    t0: Array,
    t1: Array,
    dt: Array,
) -> Problem:
    """The problem of a solve, as the loop takes it."""
    # The table of crossings is as long as the table of events.
    recording = Recording(options.recorder.since(t0), options.max_events, options.max_events)
    field = build(system, x0, compact=options.compact, transposed=options.reverse)
    watched = sections_of_run(sections, system, field, x0, options.reverse)
    grid = _time_grid(t0, t1, dt, options)
    # A budget that is a user's, the length of an array, or the default of a tolerance is a limit.
    limited = options.budget is not None
    return problem_of(field, tableau_of(stepper), grid, recording, watched, limited=limited)


def _time_grid(t0: Array, t1: Array, dt: Array, options: Options) -> TimeGrid:
    """The grid of a solve. Invalid values that were traced, and therefore not checked earlier, make
    it NaN, which has an outcome of its own."""
    length = t1 - t0
    valid, num_times = dt > resolution(t0, t1), 0
    if isinstance(options.recorder, SaveTimes):
        num_times = options.recorder.ts.shape[0]
        valid = valid & valid_ts(options.recorder.ts, t0, t1)
    dt = select(valid, jax.lax.stop_gradient(dt), jnp.nan)
    steps = jax.lax.stop_gradient(abs(length) / dt)
    # The bound must be a number of the precision of the run.
    most = min(_MOST, float(jnp.finfo(dt.dtype).max))
    num_steps = jnp.clip(jnp.ceil(steps - _WHOLE), 1, most).astype(jnp.int32)
    # A saving time between grid points takes an iteration of its own.
    ample, budget = iteration_budget(num_steps) + num_times, options.budget
    iterations = ample if budget is None else jnp.asarray(budget, jnp.int32)
    # More steps than an int32 holds exhaust the budget at once, since the count would overflow.
    iterations = select(steps > most, 0, iterations)
    dt = select(length < 0, -dt, dt)
    return TimeGrid(t0, length, dt, num_steps, iterations, share=options.share, end=t1)


def _solution(problem: Problem, options: Options, x0: Array, state: LoopState) -> Solution:
    """The public result of a finished lane. Without a recorder the only row is the end, inf if the
    run has not reached t1."""
    t0 = problem.grid.t0
    t, x, mode = (
        t0 + state.motion.tau,
        pack(state.motion.x, problem.system.dtype),
        mode_codes(state.motion.mode),
    )
    if state.saves is None:
        done = is_good(state.result)
        ts, xs = select(done, t, jnp.inf)[None], select(done, x, jnp.inf)[None]
        modes = mode[None]
    else:
        ts, xs, modes = state.saves.ts, state.saves.xs, state.saves.modes
    if options.recorder.with_t0:
        ts, xs = jnp.append(t0[None], ts), jnp.append(x0[None], xs, axis=0)
        modes = jnp.append(mode_codes(state.first_mode)[None], modes, axis=0)
    sections = sections_in(state)
    return Solution(
        ts=ts,
        xs=xs,
        modes=modes,
        events=events_of(state.table),
        num_events=state.counts.num_events,
        result=state.result,
        stats={
            "num_steps": state.counts.num_accepted,
            "num_halvings": state.trust.halvings,
            "num_iterations": state.counts.num_iterations,
            "num_saved": state.counts.num_saved,
        },
        t_final=t,
        x_final=x,
        mode_final=mode,
        crossings=crossings_of(sections and sections.table),
        num_crossings=sections and sections.watch.total,
        compact=problem.compact,
    )
