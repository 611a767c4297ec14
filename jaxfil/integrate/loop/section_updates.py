"""The next watch of a lane: after a crossing, a minimum, or a step without either."""

import dataclasses

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.loop.section_cubic import is_wanted, resolved
from jaxfil.integrate.loop.section_state import Watch
from jaxfil.integrate.surfaces.sections import Sight, WatchedSections
from jaxfil.integrate.system.components import Components, any_of, sign, where


def in_half(begun: Watch, start: Array) -> Watch:
    """The watch of a lane that looks at half of a part whose cubic cannot be trusted."""
    half, aimless = 0.5 * (start + begun.high), where(begun.aim, False, begun.aim)
    return dataclasses.replace(begun, length=half, aim=aimless)


def after_minimum(problem: Problem, watch: Watch, sight: Sight) -> Watch:
    """The watch of a lane that has examined a minimum of |S|, continued from there."""
    return dataclasses.replace(
        watch,
        value=sight.value,
        rate=sight.rate,
        away=resolved(problem, sight)[0],
        start=watch.length,
        seeking=jnp.zeros_like(watch.seeking),
    )


def after_crossing(
    watched: WatchedSections,
    problem: Problem,
    watch: Watch,
    sight: Sight,
    which: tuple[Array, Array | bool],
) -> tuple[Array, Watch]:
    """Whether a crossing counts, and the watch after it. `which` has whether the crossing has been
    located, and whether crossings at this time count."""
    (done, counts), (away, _) = which, resolved(problem, sight)
    wanted = is_wanted(watched, problem, watch.side)
    counted = watch.aim & wanted & done & counts
    recorded = any_of(counted)
    # A section whose S has jumped is on its other side at once.
    settled = watch.aim & ~watch.owed
    # A crossed section starts at exactly zero, like the guard of a surface that was just left.
    after = dataclasses.replace(
        watch,
        side=where(watch.aim, -watch.side, watch.side),
        value=where(settled, 0.0, stop_gradient(sight.value)),
        rate=sight.rate,
        away=away & ~settled,
        owed=watch.owed & ~watch.aim,
        start=stop_gradient(watch.length),
        seeking=jnp.zeros_like(watch.seeking),
        counts=watch.counts + counted.astype(jnp.int32),
        total=watch.total + recorded.astype(jnp.int32),
    )
    return recorded, after


def after_step(
    watched: WatchedSections,
    problem: Problem,
    watch: Watch,
    sight: Sight,
    jumped: Array,
    between: Array | None,
) -> Watch:
    """The watch of a lane after a step, with these values of the sections; `jumped` marks steps
    with a reset or a change of mode, and `between` those between two maps."""
    if between is not None:
        unknown = between & Components(watched.need_mode)
        value, rate = (
            where(unknown, before, after)
            for before, after in ((watch.value, sight.value), (watch.rate, sight.rate))
        )
        sight = dataclasses.replace(sight, value=value, rate=rate)
    (away, _), value = resolved(problem, sight), stop_gradient(sight.value)
    owed = jumped & away & (watch.side * value < 0) & is_wanted(watched, problem, watch.side)
    side = where(away & ~owed, sign(value), watch.side)
    return dataclasses.replace(
        watch,
        side=side,
        value=value,
        rate=sight.rate,
        away=away,
        owed=owed,
        start=jnp.zeros_like(watch.start),
        seeking=jnp.zeros_like(watch.seeking),
        tries=jnp.zeros_like(watch.tries),
    )
