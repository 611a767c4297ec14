"""The start of a run: the mode of a lane at t0.

Off the surfaces the mode is the side. On a surface it is decided by the fields there, never by the
sign of a zero.
"""

import dataclasses
import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.beginning import begin
from jaxfil.integrate.contacts.guards import NOISE, guards, stays_on, surface_noise, unguarded
from jaxfil.integrate.contacts.switch import with_reactions
from jaxfil.integrate.contacts.turn import no_turn
from jaxfil.integrate.lane.problem import Problem, period_outcome
from jaxfil.integrate.lane.recording import empty_table
from jaxfil.integrate.lane.state import (
    ContactSearch,
    Counts,
    LoopState,
    Motion,
    Pending,
    Trust,
    tables_of,
)
from jaxfil.integrate.lane.step_length import moment, typical_step
from jaxfil.integrate.loop.controller import first_length
from jaxfil.integrate.loop.halving import WATCHED
from jaxfil.integrate.surfaces import (
    filippov,
    reactions,
    unilateral,
    weights as sliding_weights,
)
from jaxfil.integrate.surfaces.corners import Corners, are_coupled, steered
from jaxfil.integrate.surfaces.decision import decide
from jaxfil.integrate.surfaces.entering import held_from_here
from jaxfil.integrate.surfaces.next_derivatives import (
    next_of,
    on_every_side,
    second_derivatives,
    three_derivatives,
)
from jaxfil.integrate.surfaces.question import question_of
from jaxfil.integrate.surfaces.second_order import met_here
from jaxfil.integrate.system.components import (
    Components,
    all_finite,
    any_of,
    first_set,
    largest,
    maximum,
    side_of,
    sign,
    where,
)
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select

# Rounding of a rate at a tangency, in eps of the largest rate there.
_RATE_NOISE = 64
# The largest number of coupled surfaces for which higher derivatives are computed on all sides.
_FEW = 3


def _rates_on_sides(
    system: ComponentSystem,
    t: Array,
    x: Components,
    soon: Array,
    direction: Array,
    sides: Components,
    on: Components,
) -> tuple[Corners, Corners, Corners]:
    """The fields on all sides, dH/dt along each, and the derivative that decides where that is
    zero."""
    if system.m > _FEW and are_coupled(system):
        # For so many combinations of sides third derivatives are not computed.
        return *filippov.corners(system, t, x), second_derivatives(system, t, x, sides, on, soon)
    fields, rates, seconds, thirds = on_every_side(system, t, x, sides, on, soon)
    following = seconds.map(lambda second, third: next_of(second, third, direction), thirds)
    return fields, rates, following


def _resolved(
    system: ComponentSystem,
    direction: Array,
    rate: Components,
    following: Components,
    scales: Components,
) -> Components:
    """A rate, or where it vanishes among rates of these sizes, a tiny number with the sign that it
    has just after."""
    # Smaller than the rounding of the other rates. If all rates vanish, only the sign matters.
    tiny = where(scales > 0, system.eps * scales, 1.0)
    flat = abs(rate) <= _RATE_NOISE * system.eps * scales
    return where(flat, tiny * direction * sign(following), rate)


def _first_mode(
    problem: Problem, x: Components, h: Components, noise: Components, inner: Components
) -> tuple[Components, Components, Components | None, Array, Array | None]:
    """The mode at t0, the surfaces that the state starts on, those with a reset due first, the
    number of admissible modes, and the determinant of the weights. `inner` is the part of the noise
    of H that comes from this state alone."""
    system, grid, known = problem.system, problem.grid, stop_gradient(problem)
    on = abs(h) <= noise
    # A motion that stands still on a surface counts as being on its side +.
    sides = where(on, 1.0, side_of(h))
    # The choice of the mode has no derivative.
    here = stop_gradient((system, grid.t0, x, moment(problem), grid.direction))
    if system.resets and are_coupled(system):
        return _first_mode_together(known, stop_gradient(x), on, sides, inner)
    (fields, rates, following), direction = _rates_on_sides(*here, sides, on), grid.direction
    owed, instant = None, known.same_time(jnp.zeros((), system.dtype))
    if system.resets:
        above = _resolved(system, direction, rates[0], following[0], rates.sizes())
        start = begin(problem, x, on, sides, above, inner)
        on = on & ~start.beside
        free = on & ~start.known
        given = start.sides, free, direction, steered(system), instant, system.slides
        mode, count = filippov.choose(fields, rates, following, *given)
        mode = where(start.rests, 2 * mode, mode)
        count = select(start.consistent & start.differentiable, count, 0)
        # Backward in time a rest may have started at any earlier time, so the motion is not unique.
        count = select(any_of(start.rests) & (grid.direction < 0), 2, count)
        owed = start.owed
    else:
        given = sides, on, direction, steered(system), instant, system.slides
        mode, count = filippov.choose(fields, rates, following, *given)
    determinant = None
    if system.slides:
        weights = sliding_weights.weights(mode, rates)
        determinant = sliding_weights.determinant(mode, rates, weights)
    return mode, on, owed, count, determinant


def _first_mode_together(
    problem: Problem, x: Components, on: Components, sides: Components, inner: Components
) -> tuple[Components, Components, Components | None, Array, Array | None]:
    """`_first_mode` on several surfaces with resets, whose reactions are coupled."""
    system, t, direction = problem.system, problem.grid.t0, problem.grid.direction
    fields, rates = filippov.corners(system, t, x)
    above = sides.like(jnp.ones_like(t))
    _, first, second, third = three_derivatives(system, t, x, moment(problem), above)
    following = next_of(second, third, direction)
    resolved = _resolved(system, direction, first, following, abs(first))
    start = begin(problem, x, on, sides, resolved, inner)
    on = on & ~start.beside
    _, _, normals = system.gradients(t, x)
    c, by_time = start.constraints, start.by_time
    forces = reactions.forces_of(system, t, x, above, c, by_time, normals, fields)
    decided = (on & ~start.known) | start.still
    if system.slides:
        seconds = second_derivatives(system, t, x, start.sides, on, moment(problem))
        forces = forces.with_slides(seconds, ~decided | start.still)
    # If the pressing acceleration vanishes, the sign of the first nonzero derivative decides. Its
    # reaction is then tiny, since a friction may be in proportion to it.
    sizes = forces.accelerations.sizes()
    most = jnp.maximum(largest(sizes), largest(rates.sizes()))
    tiny = select(most > 0, system.eps * most, 1.0)
    leaning = forces.accelerations.map(lambda a: where(sizes == 0, tiny * sign(resolved), a))
    forces = dataclasses.replace(forces, accelerations=leaning)
    instant = problem.same_time(jnp.zeros((), system.dtype))
    question = dataclasses.replace(
        question_of(rates, fields, None, start.sides, decided, direction, steered(system), instant),
        walls=start.still,
        forces=forces,
        slides=system.slides,
    )
    mode, count = decide(question)
    # Without a surface to decide there is one mode, whatever the decision returns.
    count = select(any_of(decided), count, 1)
    count = select(start.differentiable, count, 0)
    # Backward in time a rest may have started at any earlier time, so the motion is not unique.
    rests = unilateral.rests_of(mode)
    count = select(any_of(rests) & (direction < 0), 2, count)
    determinant = None
    if system.slides:
        # The same formula as at the end of a step, so that the two agree to the last bit.
        determinant = filippov.balance(system, t, x, mode, fields, rates).determinant
    return mode, on, start.owed, count, determinant


class Start(eqx.Module):
    """A lane at t0."""

    motion: Motion
    armed: Components
    """Surfaces that it does not start on, or that it slides or rests on, m flags."""
    owed: Components | None
    """Surfaces with a reset due first, m flags; None without resets."""
    num_modes: Array
    """Number of modes that could follow; 1 means that the motion is unique."""


def _start(problem: Problem, x: Components) -> Start:
    system, t, direction = problem.system, problem.grid.t0, problem.grid.direction
    tau, scale = jnp.zeros((), system.dtype), abs(stop_gradient(x))
    if system.m == 0:
        none = Components(())
        motion = Motion(tau, x, system.field(t, x, none), scale, none, none, none, none, None)
        return Start(motion, none, None, jnp.ones((), jnp.int32))
    h, h_t, normals = system.gradients(t, x)
    f = system.field(t, x, h.like(jnp.ones_like(t)))
    # The field of a side on which the motion is not need not be finite.
    speed = stop_gradient(where(abs(f) < jnp.inf, f, 0.0))
    way = abs(typical_step(problem) * speed)
    # Of a state beside zero, at which an earlier run has landed, the rounding of the landing.
    landed = scale + 2 * NOISE * system.eps * way
    inner = noise = surface_noise(system, t, x, landed, h_t, normals)
    if system.resets:
        # A state at which an earlier run ended on the surface has the rounding of its steps.
        noise = surface_noise(system, t, x, scale + way, h_t, normals)
    if problem.same_end is not None:
        # The contact beside this start is one at the end of the arc before.
        beside = problem.same_end * abs(stop_gradient(h_t + normals @ speed))
        inner, noise = maximum(inner, beside), maximum(noise, beside)
    mode, on, owed, count, determinant = _first_mode(problem, x, h, noise, inner)
    # A pinned lane is treated as off all surfaces. Its guards are armed, and no reset is due.
    if problem.kept is not None:
        met = ~problem.kept.on
        mode, on = where(met, mode, problem.kept.mode), on & met
        owed = None if owed is None else owed & met
    if system.slides or system.resets:
        x = held_from_here(system, t, x, mode, on)
    if filippov.holds_together(system):
        f = filippov.field(system, t, x, mode)
    else:
        f = with_reactions(system, t, x, mode, filippov.free_field(system, t, x, mode))
        f = system.squared(f)
    known = stop_gradient((system, t, x, f, mode, noise))
    g, rate, noise = guards(*known, stop_gradient(system.forcing_at(t)))
    # As in `rearmed`, the guard of a surface that the motion leaves at once starts at exactly zero
    # and does not fall, so that the start itself is not a contact.
    armed = stays_on(system, mode) | ~on
    g = where(armed, maximum(g, 0.0), 0.0)
    rate = where(armed, rate, direction * maximum(direction * rate, 0.0))
    if owed is not None:
        # The contact that is here at t0 is earlier or later beside this state.
        gap = h, stop_gradient(h_t + normals @ f)
        tau, x = met_here(system, (t, x), (mode, f), gap, first_set(owed))
    motion = Motion(tau, x, f, scale, mode, g, rate, noise, determinant)
    motion, count = unguarded(problem.kept, motion, count)
    return Start(motion, armed, owed, count)


def initial_state(problem: Problem, x: Components) -> LoopState:
    """The lane at t0."""
    # With a clock, functions at t0 too are evaluated strictly between ticks.
    for extension in problem.extensions:
        problem = extension.before_step(problem, None)
    system, recording = problem.system, problem.recording
    start = _start(problem, x)
    zero, false = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    # The time of a contact at t0 has a derivative, unlike these.
    tau = stop_gradient(start.motion.tau)
    nowhere = system.for_each_surface(false)
    alone = system.m <= 1 or system.resets or system.structure.separate
    state = LoopState(
        motion=start.motion,
        tau_low=tau,
        first_mode=start.motion.mode,
        armed=start.armed,
        search=ContactSearch(length=tau, surfaces=nowhere, rejections=zero),
        trust=_first_trust(problem, start.motion),
        pending=Pending(
            waits=false if start.owed is None else any_of(start.owed),
            surfaces=nowhere if start.owed is None else start.owed,
            grazes=false,
            jumped=false,
            across=nowhere,
            together=None if alone else false,
            planned=false if system.m > 1 or system.ticks else None,
            plan=start.motion.mode,
            repeats=zero,
            # Infinitely long ago, so that the first contact does not count as a repeated one.
            tau=tau - jnp.inf,
        ),
        counts=Counts(
            zero,
            zero,
            zero,
            zero,
            zero,
            period_start=None if problem.grid.forcing is None else zero,
            num_ticks=zero if problem.system.ticks else None,
        ),
        result=_first_result(problem, x, start),
        table=empty_table(system, recording.max_events),
        saves=recording.recorder.empty(system),
        settled=false if system.resets else None,
        turn=no_turn(system, x),
    )
    # Extensions begin with a complete lane, which they may change. A bound violated at t0 ends it.
    own = []
    for extension in problem.extensions:
        state, first = extension.begin(problem, state)
        own.append(first)
    state = dataclasses.replace(state, extensions=tuple(own))
    return state if system.m == 0 else _varied(state)


def _first_trust(problem: Problem, motion: Motion) -> Trust:
    zero, one = jnp.zeros((), jnp.int32), jnp.ones_like(motion.tau)
    longest, error = one * jnp.inf, None
    if problem.tableau.tolerance is not None:
        longest, error = first_length(problem, motion), one
    # The first steps count as long after a refusal, and have the usual error limits.
    return Trust(longest, one * jnp.inf, zero + WATCHED, zero, zero, error)


def _varied(state: LoopState) -> LoopState:
    """The same lane. Numbers that obtain derivatives at contacts have them from the start, with
    value zero.

    JAX traces the derivatives of a loop again until it knows which of its numbers have any. Without
    this function, that took a tenth of the time to a first Jacobian.
    """

    def kept(state: LoopState) -> list:
        rows = [v for table in tables_of(state) for v in (table.ts, table.xs)]
        return [state.motion.tau, *state.motion.x.parts, *rows]

    first = jnp.ravel(state.motion.f.parts[0])[0]
    return eqx.tree_at(kept, state, [_with_rate_of(first, v) for v in kept(state)])


@jax.custom_jvp
def _with_rate_of(source: Array, v: Array) -> Array:
    """v, with a derivative, possibly zero, if `source` has one."""
    return v


@ft.partial(_with_rate_of.defjvp, symbolic_zeros=True)
def _with_rate_of_jvp(primals: tuple, tangents: tuple) -> tuple:
    (_, v), (moved, rate) = primals, tangents
    if not isinstance(moved, SymbolicZero):
        still = jnp.zeros_like(v) if isinstance(rate, SymbolicZero) else rate
        # XLA removes a selection with a constant flag, while to JAX the result depends on `moved`.
        # A product of `moved` and zero would remain, and be NaN for an infinite `moved`.
        rate = select(False, moved, still)
    return v, rate


def _first_result(problem: Problem, x: Components, start: Start) -> RESULTS:
    """The outcome at t0, which is a failure for numbers that are not finite, and for a start
    without a unique continuation."""
    grid, count = problem.grid, start.num_modes
    result = RESULTS.where(count > 1, RESULTS.nonunique, RESULTS.successful)
    result = RESULTS.where(count < 1, RESULTS.mode_undecided, result)
    if not problem.system.slides:
        slid = any_of(start.motion.mode == 0) & (count == 1)
        result = RESULTS.where(slid, RESULTS.undeclared_sliding, result)
    # These tests come last and have precedence, since a mode decided from NaN has no meaning.
    clocks = problem.system.clocks
    fine = all_finite(x, start.motion.f, grid.t0, grid.length, grid.dt, clocks)
    result = RESULTS.where(fine, result, RESULTS.nonfinite)
    for period, _ in clocks:
        result = period_outcome(period, result)
    return result
