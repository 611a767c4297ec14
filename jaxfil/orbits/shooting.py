"""The shooting function: the arcs of an orbit, their closure residual, and their derivatives.

Every arc has derivatives with respect to its own start and to global unknowns q (a parameter, the
period itself), by forward mode through every contact.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from jaxfil.integrate.lane.problem import NOTHING, Problem, Recording, even_grid, period_outcome
from jaxfil.integrate.loop.extensions import problem_of
from jaxfil.integrate.loop.iterate import integrate
from jaxfil.integrate.loop.start import initial_state
from jaxfil.integrate.run.solution import Events, events_of
from jaxfil.integrate.steppers.explicit import Stepper, tableau_of
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import build
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.orbits.constant import Constant
from jaxfil.xla.kernel import kernel_if_it_fits
from jaxfil.xla.select import select


class ShootingOptions(eqx.Module):
    """Options of the integration of an orbit. Its arcs are the `segments` of `periodic_orbit`."""

    t0: Float[Array, ""]
    """The initial time, the phase of the forcing."""
    steps: int = eqx.field(static=True)
    """Number of steps of the whole orbit."""
    arcs: int = eqx.field(static=True)
    """Number of arcs of multiple shooting."""
    stepper: Stepper = eqx.field(static=True)
    """The stepper."""
    max_events: int = eqx.field(static=True)
    """The largest number of contacts of the orbit, the length of its table of events."""
    compact: bool = eqx.field(static=True)
    """Whether the stages of a step are in a loop (see `solve`)."""

    def problem(
        self,
        system: System,
        x0: Array,
        t0: Array,
        length: Array,
        arcs: int,
        end: Array | None = None,
    ) -> Problem:
        """The problem of one arc, which starts at `t0` and takes the time `length`, up to `end`
        without the rounding of a sum. It has its share of the steps if `arcs` arcs of this length
        make up the orbit."""
        num_steps = jnp.asarray(-(-self.steps // arcs), jnp.int32)
        grid = even_grid(t0, length, num_steps, self.max_events, end)
        grid = dataclasses.replace(grid, closes=True)
        recording = Recording(max_events=self.max_events)
        field = build(system, x0, compact=self.compact)
        return problem_of(field, tableau_of(self.stepper), grid, recording)


class Shot(eqx.Module):
    """All M arcs of an orbit: their ends, derivatives, and contacts."""

    ends: Float[Array, "M n"]
    """The states at the ends of the arcs."""
    by_start: Float[Array, "M n n"]
    """The derivative of each end with respect to the start of its arc."""
    by_global: Float[Array, "M n k"]
    """The derivative of each end with respect to the global unknowns q."""
    size: Float[Array, " n"]
    """The scale of each component: the largest of the loop's running maxima of |x| at the ends of
    the arcs (`Motion.scale`), which fade from step to step; 1 for a component that is zero."""
    events: Events | None
    """The contacts of all arcs in order."""
    num_events: Int[Array, ""]
    """The number of contacts of all arcs."""
    first_mode: Int[Array, " m"]
    """The mode at t0."""
    result: RESULTS
    """The outcome of the first failed arc; `max_events_reached` if none has failed but all
    contacts together exceed `ShootingOptions.max_events`."""
    constant: Constant
    """The components without a field."""

    @property
    def monodromy(self) -> Float[Array, "n n"] | Float[np.ndarray, "n n"]:
        """∂x(t0 + T)/∂x(t0), the product of the arcs' derivatives."""
        total = self.by_start[0]
        for matrix in self.by_start[1:]:
            total = matrix @ total
        return total


Setting = Callable[[Array], tuple[System, Array]]
"""Maps global unknowns (k,) to the system and the period."""


def shoot(
    setting: Setting, options: ShootingOptions, starts: Float[Array, "M n"], q: Float[Array, " k"]
) -> Shot:
    """Integrate every arc from its start."""
    n = starts.shape[1]

    def arc(number: Array, start: Array) -> tuple:
        def end(z: Array) -> tuple[Array, tuple]:
            system, period = setting(z[n:])
            length = period / options.arcs
            t0, then = (options.t0 + k * length for k in (number, number + 1))
            problem = options.problem(system, z[:n], t0, length, options.arcs, then)
            state = integrate(problem, problem.system.unpack(z[:n]))
            x = pack(state.motion.x, z.dtype)
            # From the states at the steps, the recent ones above all (`guards.larger`), which is
            # accurate enough for the scale of a component.
            size = jnp.maximum(pack(state.motion.scale, z.dtype), abs(x))
            mode = pack(state.first_mode, z.dtype).astype(jnp.int8)
            result = period_outcome(period, state.result)
            constant = Constant(problem.system.structure.constant)
            count = state.counts.num_events
            more = (x, size, events_of(state.table), count, mode, result, constant)
            return x, jax.tree.map(stop_gradient, more)

        def slopes(z: Array) -> tuple:
            by, more = jax.jacfwd(end, has_aux=True)(z)
            return by[:, :n], by[:, n:], *more

        # One derivative by all inputs of an arc; the directions share the steps, the contacts and
        # the loop.
        return kernel_if_it_fits(slopes, options.compact)(jnp.concatenate([start, q]))

    numbers = jnp.arange(options.arcs).astype(starts.dtype)
    if options.arcs == 1:  # a batch of one would take as long to trace as a larger batch
        done = jax.tree.map(lambda v: v[None], arc(numbers[0], starts[0]))
    else:
        done = jax.vmap(arc)(numbers, starts)
    by_start, by_global, ends, sizes, events, counts, modes, results, constant = done
    result = first_failure(results, options.arcs)
    count = jnp.sum(counts, dtype=jnp.int32)
    # The table of the orbit is as long as that of an arc.
    full = (result == RESULTS.successful) & (count > options.max_events)
    result = RESULTS.where(full, RESULTS.max_events_reached, result)
    size = jnp.max(sizes, axis=0)
    return Shot(
        ends=ends,
        by_start=by_start,
        by_global=by_global,
        size=select(size == 0, 1, size),
        events=merged(events, options.max_events),
        num_events=count,
        first_mode=modes[0],
        result=result,
        constant=constant,
    )


def first_failure(results: RESULTS, arcs: int) -> RESULTS:
    """The outcome of the first failed arc, given those of all; `successful` without one."""
    result = RESULTS.successful
    # The last write wins.
    for i in reversed(range(arcs)):
        one = jax.tree.map(lambda v, i=i: v[i], results)
        result = RESULTS.where(one == RESULTS.successful, result, one)
    return result


def merged(events: Events | None, size: int) -> Events | None:
    """The events of all arcs in one table, in order of time, its first `size` rows."""
    if events is None:
        return None
    if events.ts.shape[0] == 1:  # in order already
        return jax.tree.map(lambda v: v[0], events)
    flat = jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), events)
    order = jnp.argsort(flat.ts, stable=True)[:size]
    return jax.tree.map(lambda v: v[order], flat)


def starts_from(
    setting: Setting, options: ShootingOptions, x0: Float[Array, " n"], q: Array
) -> Array:
    """The starts of all arcs on the trajectory from x0, shape (M, n). An arc that cannot be
    integrated, and those after it, start where the last one did."""
    if options.arcs == 1:
        return x0[None]
    forward = flow_map(setting, options, q, 1 / options.arcs)

    def next_start(x: Array, number: Array) -> tuple[Array, Array]:
        end = forward(x, number)
        return end, end

    numbers = jnp.arange(options.arcs - 1).astype(x0.dtype)
    return jnp.concatenate([x0[None], jax.lax.scan(next_start, x0, numbers)[1]])


def flow_map(
    setting: Setting, options: ShootingOptions, q: Array, part: float
) -> Callable[[Array, Array], Array]:
    """A function from a state at the start of stretch number 0, 1, …, each this `part` of the
    period, to the state at its end; the same state if it cannot be integrated."""
    system, period = setting(q)
    length = part * period

    def forward(x: Array, number: Array) -> Array:
        arcs = max(1, round(1 / part))
        t0, end = (options.t0 + k * length for k in (number, number + 1))
        problem = options.problem(system, x, t0, length, arcs, end)
        problem = dataclasses.replace(problem, recording=NOTHING)
        state = integrate(problem, problem.system.unpack(x))
        return select(state.result == RESULTS.successful, pack(state.motion.x, x.dtype), x)

    return kernel_if_it_fits(forward, options.compact)


def velocity(setting: Setting, options: ShootingOptions, x0: Float[Array, " n"], q: Array) -> Array:
    """The field at (t0, x0) in the mode in which the solution starts, shape (n,)."""
    system, period = setting(q)
    problem = options.problem(system, x0, options.t0, period, options.arcs)
    problem = dataclasses.replace(problem, recording=NOTHING)
    return pack(initial_state(problem, problem.system.unpack(x0)).motion.f, x0.dtype)
