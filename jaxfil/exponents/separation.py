"""The growth of a small distance between a drive and its response.

The distance is measured after each interval, and the response is put back to the first distance in
the direction in which it then is. Between an impact of one of the two and the same impact of the
other one they are as far apart as it throws them. Their distance is then measured a part of an
interval later.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.exponents.distance import distance_in, size_of
from jaxfil.integrate.contacts.guards import stays_on
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.loop.iterate import integrate
from jaxfil.integrate.surfaces import unilateral
from jaxfil.integrate.surfaces.normals import project
from jaxfil.integrate.system.components import Components, pack
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.model.outcomes import RESULTS
from jaxfil.xla.select import select
from jaxfil.xla.thresholds import SEPARATION

# The parts of an interval after which a distance is measured that could not be at its start.
_PARTS = 16
# A reset that brings the two closer than this fraction of their distance is the one that the other
# one has had.
_CLOSER = 0.5


def parted(
    problem: Callable[[Array, Array, Array], Problem],
    z: Array,
    separation: Array,
    ends: Array,
    result: RESULTS,
) -> tuple[Array, RESULTS, Array]:
    """Drive and response at the end, the outcome, and the growth of the logarithm of their distance
    over the intervals up to each of `ends`. `problem` returns the problem of a part of interval k,
    from one fraction of it to another."""
    n, dtype = z.shape[0] // 2, z.dtype
    eps = float(jnp.finfo(dtype).eps)

    def part(carry: tuple) -> tuple:
        k, begin, waits, z, growth, _ = carry
        end = select(waits, begin + 1, _PARTS)
        now = problem(k, begin.astype(dtype) / _PARTS, end.astype(dtype) / _PARTS)
        state = integrate(now, now.system.unpack(z))
        after, t = pack(state.motion.x, dtype), now.grid.t0 + state.motion.tau
        grown = distance_in(state.motion.x, separation)
        # A distance that cannot be measured within an interval is taken as it is.
        done = end == _PARTS
        measures = _is_comparable(now.system, t, state.motion.x, grown, separation) | (waits & done)
        # A smaller distance is unresolved, and would give a wrong but plausible rate.
        resolved = grown * separation > SEPARATION * eps * size_of(after)
        growth = growth + select(measures, select(resolved, jnp.log(grown), jnp.nan), 0.0)
        apart = (after[n:] - after[:n]) / select(measures & resolved, grown, 1.0)
        z = now.system.unpack(jnp.concatenate([after[:n], after[:n] + apart]))
        return (
            k + done.astype(k.dtype),
            select(done, 0, end),
            ~measures,
            pack(_on_surfaces(now.system, t, z, state.motion.mode), dtype),
            growth,
            state.result,
        )

    def batch(carry: tuple, stop: Array) -> tuple:
        *at, result = carry
        *at, growth, result = jax.lax.while_loop(
            lambda s: (s[0] < stop) & (s[-1] == RESULTS.successful),
            part,
            (*at, jnp.zeros_like(separation), result),
        )
        return (*at, result), growth

    none = jnp.zeros_like(ends[0])
    first = none, none, jnp.zeros((), bool), z, result
    (*_, z, result), growth = jax.lax.scan(batch, first, ends)
    return z, result, growth


def _is_comparable(
    system: ComponentSystem, t: Array, z: Components, distance: Array, unit: Array
) -> Array:
    """Whether none of drive and response has had an impact that is still before the other one."""
    if not system.resets:
        return jnp.ones((), bool)

    def after_reset(surface: Array) -> Array:
        return distance_in(system.reset(t, z, surface), unit)

    closest = jnp.min(jax.vmap(after_reset)(jnp.arange(system.m, dtype=jnp.int32)))
    return ~(closest < _CLOSER * distance)


def _on_surfaces(system: ComponentSystem, t: Array, z: Components, mode: Components) -> Components:
    """A state beside one in this mode, on the surfaces that it slides or rests on, so that a run
    from there does so too. A distance that has shrunk is along a chord of a curved wall, which may
    be behind it."""
    if system.m == 0 or not (system.slides or system.resets):
        return z
    h, _, normals = system.gradients(t, z)
    z = project(system, z, h, normals, stays_on(system, mode))
    if not system.resets:
        return z
    c = unilateral.constraints(system, t, z, unilateral.sides_of(mode))
    push = unilateral.multipliers(c.impulse.gains, c.rate, unilateral.rests_of(mode))
    return c.impulse.directions.added(z, push)
