"""The first moment: which mode a lane starts in.

A problem and an initial state enter; a `LoopState` ready for the loop leaves. Off the surfaces the
mode is the side. On a surface it is what the fields there say, never the sign of a zero.
"""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts import accumulation, resets
from jaxfil.integrate.contacts.guards import guards, stays_on, surface_noise, unguarded
from jaxfil.integrate.contacts.switch import with_reactions
from jaxfil.integrate.lane import clocks
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.recording import empty_saves, empty_table
from jaxfil.integrate.lane.state import LoopState, Start
from jaxfil.integrate.loop import section_search
from jaxfil.integrate.surfaces import filippov, unilateral, weights as sliding_weights
from jaxfil.integrate.surfaces.weights import Corners, CornerTable, every_side
from jaxfil.integrate.system.components import Components, all_finite, any_of, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select

# Rounding of a rate at a tangency, in eps of the largest rate there.
_RATE_NOISE = 64


def _resolved_rates(system: ComponentSystem, t: Array, x: Components, direction: Array) -> Corners:
    """dH/dt along the field of every combination of sides; where it vanishes, an infinitesimal of
    the sign that dH/dt takes at once (from the second, then the third derivative of H)."""
    rates, seconds, thirds = _all_rates(system, t, x)
    scales = [sliding_weights.size_of(rates, j) for j in system.surfaces]

    def resolved(j: int, rate: Array, second_: Array, third: Array) -> Array:
        tiny = select(scales[j] > 0, system.eps * scales[j], 1.0)
        sign = select(second_ != 0, direction * jnp.sign(second_), jnp.sign(third))
        flat = abs(rate) <= _RATE_NOISE * system.eps * scales[j]
        return select(flat, tiny * sign, rate)

    return sliding_weights.map_components(resolved, rates, seconds, thirds)


def _all_rates(system: ComponentSystem, t: Array, x: Components) -> tuple[Corners, ...]:
    """The first three derivatives of H on every combination of sides. The higher ones are not
    affine in the sides, be the field or not."""
    # One program for all of them, be they few: it holds third derivatives of the field.
    three = ft.partial(_three_rates, system, t, x)
    if system.structure.separate:
        rows = [system.for_each_surface(jnp.asarray(s, system.dtype)) for s in (1.0, -1.0)]
        return tuple(map(list, zip(*map(three, rows), strict=True)))
    columns = every_side(system.m).T.astype(system.dtype)
    each = jax.vmap(lambda *sides: three(sides))(*columns)
    if system.m > 2:
        return tuple(map(CornerTable, each))
    return tuple([tuple(v[k] for v in rates) for k in range(4)] for rates in each)


def _three_rates(
    system: ComponentSystem, t: Array, x: Components, sides: Components
) -> tuple[Components, Components, Components]:
    """The first three derivatives of H along the field of some sides."""

    def along(t: Array, x: Components) -> tuple[Array, Components]:
        return jnp.ones_like(t), system.field(t, x, sides)

    def first(t: Array, x: Components) -> Components:
        return system.rate(t, x, along(t, x)[1])

    def two(t: Array, x: Components) -> tuple[Components, Components]:
        return jax.jvp(first, (t, x), along(t, x))

    (one, second), (_, third) = jax.jvp(two, (t, x), along(t, x))
    return one, second, third


def _first_mode(
    problem: Problem, x: Components, h: Components, noise: Components
) -> tuple[Components, Components, Components, Array, Array | None]:
    """The mode at t0, the surfaces the state starts on, those whose reset comes first, the number
    of admissible modes, and the determinant of the weights."""
    system, grid = problem.system, problem.grid
    sides = tuple(select(v < 0, -jnp.ones_like(v), jnp.ones_like(v)) for v in h)
    on = tuple(abs(v) <= size for v, size in zip(h, noise, strict=True))
    # Which mode it is has no derivative.
    rates = _resolved_rates(*stop_gradient((system, grid.t0, x, grid.direction)))
    owed: Components = ()
    if system.resets:
        start = resets.begin(problem, x, on, sides, sliding_weights.first_corner(rates))
        free = tuple(o & ~known for o, known in zip(on, start.known, strict=True))
        mode, count = filippov.choose(system.m, rates, start.sides, free, grid.direction)
        mode = tuple(select(r, 2 * s, s) for r, s in zip(start.rests, mode, strict=True))
        count = select(start.consistent, count, 0)
        # In backward time a rest may have begun at any time.
        count = select(any_of(start.rests) & (grid.direction < 0), 2, count)
        owed = start.owed
    else:
        mode, count = filippov.choose(system.m, rates, sides, on, grid.direction)
    determinant = None
    if system.slides:
        weights = sliding_weights.weights(mode, rates)
        determinant = sliding_weights.determinant(mode, rates, weights)
    return mode, on, owed, count, determinant


def _start(problem: Problem, x: Components) -> Start:
    system, t, direction = problem.system, problem.grid.t0, problem.grid.direction
    if system.m == 0:
        f = system.field(t, x, ())
        return Start(f, (), (), (), (), (), (), jnp.ones((), jnp.int32), None)
    h, h_t, normals = system.gradients(t, x)
    size = tuple(map(abs, stop_gradient(x)))
    if system.resets:
        # A state that an earlier run has left on the surface has the rounding of its steps.
        f = system.field(t, x, tuple(jnp.ones_like(v) for v in h))
        dt = problem.grid.dt
        size = tuple(s + stop_gradient(abs(dt * v)) for s, v in zip(size, f, strict=True))
    noise = surface_noise(system, t, size, h_t, normals)
    mode, on, owed, count, determinant = _first_mode(problem, x, h, noise)
    if problem.kept is not None:
        met = ~problem.kept.on
        mode = where(met, mode, problem.kept.mode)
        on, owed = (tuple(v & met for v in flags) for flags in (on, owed))
    moving = mode if system.slides else unilateral.sides_of(mode)
    f = filippov.free_field(system, t, x, moving)
    f = with_reactions(system, t, x, mode, f)
    known = stop_gradient((system, t, x, f, mode, noise))
    g, rate, noise = guards(*known, stop_gradient(system.forcing_at(t)))
    stays = stays_on(system, mode)
    armed = tuple(s | ~on_j for s, on_j in zip(stays, on, strict=True))
    g = tuple(select(a, jnp.maximum(v, 0.0), 0.0) for a, v in zip(armed, g, strict=True))
    rate = tuple(
        select(a, r, direction * jnp.maximum(direction * r, 0.0))
        for a, r in zip(armed, rate, strict=True)
    )
    start = Start(f, mode, g, rate, armed, noise, owed, count, determinant)
    return unguarded(problem.kept, start)


def initial_state(problem: Problem, x: Components) -> LoopState:
    """The lane at t0."""
    ticks = clocks.first_ticks(problem) if problem.system.clocks else None
    problem = clocks.between_ticks(problem, ticks)
    system, recording = problem.system, problem.recording
    start = _start(problem, x)
    tau = jnp.zeros((), system.dtype)
    zero, false = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    state = LoopState(
        tau=tau,
        rest=tau,
        x=x,
        f=start.f,
        size=tuple(map(abs, stop_gradient(x))),
        mode=start.mode,
        first_mode=start.mode,
        g=start.g,
        rate=start.rate,
        determinant=start.determinant,
        armed=start.armed,
        noise=start.noise,
        cut=tau,
        aim=system.for_each_surface(false),
        pending=any_of(start.owed),
        hit=start.owed if system.resets else system.for_each_surface(false),
        graze=false,
        jumped=false,
        settled=false if system.resets else None,
        turn=accumulation.no_turn(system, x),
        index=zero,
        tries=zero,
        frozen=zero,
        contact_tau=tau - jnp.inf,
        num_iterations=zero,
        num_accepted=zero,
        num_events=zero,
        num_saved=zero,
        result=_first_result(problem, x, start),
        table=empty_table(system, recording.max_events),
        saves=empty_saves(system, recording),
        period_start=None if problem.grid.forcing is None else zero,
        ticks=ticks,
        left=() if ticks is None or system.m == 0 else tuple(map(jnp.zeros_like, x)),
    )
    state = section_search.begin(problem, state)
    return state if system.m == 0 else _varied(state)


def _varied(state: LoopState) -> LoopState:
    """The same lane; what contacts give derivatives has them from the start, of value zero.

    JAX traces the derivatives of a loop anew until it knows which of its numbers have any: a tenth
    of the time to a first Jacobian.
    """

    def kept(state: LoopState) -> list:
        kept = (state.table, state.saves, state.crossings)
        records = [record for record in kept if record is not None]
        return [state.tau, *state.x, *(v for record in records for v in (record.ts, record.xs))]

    return eqx.tree_at(
        kept, state, [_with_rate_of(jnp.ravel(state.f[0])[0], v) for v in kept(state)]
    )


@jax.custom_jvp
def _with_rate_of(source: Array, v: Array) -> Array:
    """v, with a derivative, be it zero, if `source` has one."""
    return v


@ft.partial(_with_rate_of.defjvp, symbolic_zeros=True)
def _with_rate_of_jvp(primals: tuple, tangents: tuple) -> tuple:
    (_, v), (moved, rate) = primals, tangents
    if not isinstance(moved, SymbolicZero):
        still = jnp.zeros_like(v) if isinstance(rate, SymbolicZero) else rate
        rate = select(False, moved, still)
    return v, rate


def _first_result(problem: Problem, x: Components, start: Start) -> RESULTS:
    """The outcome at t0: bad numbers, or a start that no single solution leaves."""
    grid, count = problem.grid, start.num_modes
    result = RESULTS.where(count > 1, RESULTS.nonunique, RESULTS.successful)
    result = RESULTS.where(count < 1, RESULTS.mode_undecided, result)
    if not problem.system.slides:
        slid = any_of(tuple(s == 0 for s in start.mode)) & (count == 1)
        result = RESULTS.where(slid, RESULTS.undeclared_sliding, result)
    fine = all_finite(x, start.f, (grid.t0, grid.length, grid.dt))
    return RESULTS.where(fine, result, RESULTS.nonfinite)
