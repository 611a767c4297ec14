"""The closure of an orbit through a tangency.

The arcs of the orbit are integrated from their own starts. In the first one the flight around the
tangency is followed in its mode, as if the surface were not there, and its guards are recorded step
by step, since a field or a state may jump at the ticks within.
"""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from jaxfil.bifurcations.tangency import ARRIVAL, Tangency
from jaxfil.integrate.lane.extension import Extension, Step, Verdict
from jaxfil.integrate.lane.problem import KeptMode, Problem, even_grid
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.loop.extensions import problem_of
from jaxfil.integrate.loop.iterate import integrate
from jaxfil.integrate.steppers.explicit import tableau_of
from jaxfil.integrate.surfaces import filippov
from jaxfil.integrate.system.components import Components, pack
from jaxfil.integrate.system.lowered import ComponentSystem, build
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.orbits.shooting import ShootingOptions
from jaxfil.xla.select import select

# Pieces of the flight on either side of the tangency.
_PIECES = 16
# A guard below this fraction of its largest value on the flight is zero, at the tangency itself.
_ROUNDING = 1e-7


class Closing(eqx.Module):
    """The closure residual of an orbit through a tangency, the mismatch of the end of each of M
    arcs with the start of the next one, with its contacts. `holds` is true if the guards of the
    flight, followed as if Σ were not there, are positive except at the tangency, and `passes` if
    its own may also be negative around this, though not at the ends of the flight, where the full
    flow goes on. `contacts` counts the contacts of the orbit elsewhere. `first_mode` is the mode at
    the start."""

    gap: Float[Array, " Mn"]
    t: Array
    x: Float[Array, " n"]
    size: Float[Array, " n"]
    holds: Array
    passes: Array
    contacts: Int[Array, ""]
    first_mode: Float[Array, " m"]
    result: RESULTS


class _Stretch(eqx.Module):
    """A part of an orbit: the time at its start, its length, the state there, and flags."""

    t: Array
    length: Array
    start: Array
    """The start of an arc; not used elsewhere."""
    begins: Array
    """Whether an arc begins with it."""
    keeps: Array
    """Whether it is followed in the mode of the flight."""
    strikes: Array
    """Whether it begins at the tangency."""
    resumes: Array
    """Whether it follows the flight."""


def close(
    system: System,
    period: Array,
    options: ShootingOptions,
    family: Int[Array, ""],
    tangency: Tangency,
) -> Closing:
    """Integrate every arc once, with the reset at the tangency if that is struck."""
    starts = tangency.starts
    on_components = build(system, starts[0], compact=options.compact)
    mode, arrives = on_components.of_surfaces(tangency.mode), family == ARRIVAL
    stretches = _stretches(tangency, period, arrives)

    def follow(carry: tuple, now: _Stretch) -> tuple:
        x, before, size, result = carry
        x = select(now.begins, now.start, x)
        # An arrival is an ordinary contact of the full flow, which starts before the flight.
        x = select(now.resumes & arrives, before, x)
        if system.resets:
            x = select(now.strikes & tangency.struck, system.reset(now.t, x, tangency.surface), x)
        flow = _Flow(on_components, options, KeptMode(mode, now.keeps), period)
        end, seen = flow(now.t, now.length, x)
        # A flight may start where its arc does, and no mode is decided there.
        empty = now.begins & (now.length == 0)
        end, new = select(empty, x, end), RESULTS.where(empty, RESULTS.successful, seen.result)
        seen = eqx.tree_at(
            lambda v: (v.contacts, v.first_mode),
            seen,
            (
                select(empty | now.keeps, 0, seen.contacts),
                select(empty, tangency.mode, seen.first_mode),
            ),
        )
        result = RESULTS.where(result == RESULTS.successful, new, result)
        before = select(now.begins, end, before)
        return (end, before, jnp.maximum(size, seen.size), result), (end, seen)

    first = (starts[0], starts[0], abs(stop_gradient(starts[0])), RESULTS.successful)
    (*_, size, result), (xs, seen) = jax.lax.scan(follow, first, stretches)
    # Each arc ends before the start of the next one, the first of them after the flight.
    ends = xs[2 * _PIECES + 1 :]
    # After a reset the full flow follows the orbit, in a mode of its own.
    number = np.arange(xs.shape[0])
    counts = stretches.keeps & (~tangency.struck | jnp.asarray(number <= _PIECES))
    clear, crosses = seen.guards.are_positive(counts), seen.guards.go_below(counts)
    crosses &= jnp.arange(crosses.size, dtype=jnp.int32) == tangency.surface
    # The flight may have moved out of its arc.
    far = jnp.sqrt(jnp.finfo(starts.dtype).eps) * period
    leaves = (result == RESULTS.successful) & jnp.any(stretches.length < -far)
    result = RESULTS.where(leaves, RESULTS.orbit_lost, result)
    return Closing(
        gap=jnp.ravel(ends - jnp.roll(starts, -1, axis=0)),
        t=tangency.phase * period,
        x=xs[_PIECES],
        size=size,
        holds=jnp.all(clear),
        passes=jnp.all(clear | crosses),
        contacts=jnp.sum(seen.contacts, dtype=jnp.int32),
        first_mode=seen.first_mode[0],
        result=result,
    )


def _stretches(tangency: Tangency, period: Array, arrives: Array) -> _Stretch:
    """The stretches of the orbit: one up to the flight, equal pieces of this on either side of the
    tangency, one to the end of the arc, and the other arcs."""
    arcs, count = tangency.starts.shape[0], 2 * _PIECES
    number = np.arange(count + 1 + arcs)
    node, start, at = (v * period for v in (tangency.node, tangency.start, tangency.phase))
    stop = select(arrives, at, tangency.stop * period)
    nodes = node + period * jnp.arange(arcs).astype(node.dtype) / arcs
    rest, end = select(arrives, start, stop), node + period / arcs
    times = [node[None], _divided(start, at), _divided(at, stop), rest[None], nodes[1:]]
    ahead, behind = ((v / _PIECES) for v in (at - start, stop - at))
    lengths = [
        (start - node)[None],
        jnp.repeat(jnp.stack([ahead, behind]), _PIECES),
        (end - rest)[None],
        jnp.repeat(period / arcs, arcs - 1),
    ]
    arc = np.maximum(number - count - 1, 0)
    return _Stretch(
        t=jnp.concatenate(times),
        length=jnp.concatenate(lengths),
        start=tangency.starts[arc],
        begins=jnp.asarray((number == 0) | (arc > 0)),
        keeps=jnp.asarray((number > 0) & (number <= count)),
        strikes=jnp.asarray(number == _PIECES + 1),
        resumes=jnp.asarray(number == count + 1),
    )


def _divided(start: Array, stop: Array) -> Array:
    """The beginnings of equal pieces."""
    return start + (stop - start) * jnp.arange(_PIECES).astype(start.dtype) / _PIECES


class _Guards(eqx.Module):
    """The least and the largest value of each guard so far."""

    least: Float[Array, "*k m"]
    largest: Float[Array, "*k m"]

    def are_positive(self, counts: Array) -> Bool[Array, " m"]:
        """Whether each is positive beyond rounding on the stretches that count."""
        least = jnp.min(select(counts[:, None], self.least, jnp.inf), axis=0)
        return least >= -self._rounding(counts)

    def go_below(self, counts: Array) -> Bool[Array, " m"]:
        """Whether each is negative at the tangency, but at neither end of the flight."""
        at, first, last = (self.least[i] for i in (_PIECES, 1, 2 * _PIECES))
        last = select(counts[2 * _PIECES], last, jnp.inf)
        return (at < -self._rounding(counts)) & (first > 0) & (last > 0)

    def _rounding(self, counts: Array) -> Float[Array, " m"]:
        return _ROUNDING * jnp.max(select(counts[:, None], self.largest, 0), axis=0)


class _GuardsSeen(Extension):
    """Records the guards of a mode that a lane is pinned to, also between the ends of steps."""

    def begin(self, problem: Problem, state: LoopState) -> tuple[LoopState, _Guards]:
        zero = jnp.zeros(problem.system.m, problem.system.dtype)
        return state, _Guards(zero + jnp.inf, zero)

    def after_step(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: _Guards,
        step: Step,
        verdict: Verdict | None,
    ) -> tuple[LoopState, _Guards]:
        assert problem.kept is not None
        # Its functions are those between two ticks, at both ends of the step.
        system, mode = stop_gradient((problem.system, problem.kept.mode))

        def guards(t: Array, x: Array) -> Array:
            return pack(filippov.guard(system, t, system.unpack(x), mode), x.dtype)

        def with_rates(t: Array, x: Components) -> tuple[Array, Array]:
            along = pack(filippov.field(system, t, x, mode), t.dtype)
            return jax.jvp(guards, (t, pack(x, t.dtype)), (jnp.ones_like(t), along))

        t, h = problem.grid.t0 + state.motion.tau, step.length.h
        ends = stop_gradient(((t, state.motion.x), (t + h, step.end.motion.x)))
        (low, down), (high, up) = (with_rates(*end) for end in ends)
        between = least_between(stop_gradient(h), (low, high), (down, up))[1]
        least = select((down < 0) & (up > 0), between, jnp.minimum(low, high))
        now = _Guards(
            jnp.minimum(own.least, least),
            jnp.maximum(own.largest, jnp.maximum(abs(low), abs(high))),
        )
        return after, jax.tree.map(lambda v, w: select(step.advances, v, w), now, own)


_Number = TypeVar("_Number", Array, np.ndarray)


def least_between(
    length: _Number, values: tuple[_Number, _Number], rates: tuple[_Number, _Number]
) -> tuple[_Number, _Number]:
    """The minimum of the cubic with these values and rates at both ends of a step, the first rate
    negative and the second one not: its fraction of the step, and its value."""
    low, high = values
    down, up = (length * rate for rate in rates)
    cubic, square = 2 * (low - high) + down + up, 3 * (high - low) - 2 * down - up
    inner = square**2 - 3 * cubic * down
    # On a short step values that differ by rounding do not agree with the rates.
    part = (-down / (square + inner.clip(0) ** 0.5)).clip(0, 1)
    return part, ((cubic * part + square) * part + down) * part + low


class _Seen(eqx.Module):
    """The sizes of a stretch, the number of its contacts, its guards, the mode at its start, and
    the outcome."""

    size: Float[Array, " n"]
    contacts: Int[Array, ""]
    guards: _Guards
    first_mode: Float[Array, " m"]
    result: RESULTS


class _Flow(eqx.Module):
    """The flow over stretches of time."""

    system: ComponentSystem
    options: ShootingOptions
    kept: KeptMode
    period: Array

    def __call__(self, t0: Array, length: Array, x: Array) -> tuple[Array, _Seen]:
        """The end of a stretch, and further data."""
        options = self.options
        count = jnp.ceil(options.steps * abs(stop_gradient(length / self.period)))
        num_steps = jnp.clip(jnp.nan_to_num(count), 1, 8 * options.steps).astype(jnp.int32)
        problem = problem_of(
            self.system,
            tableau_of(options.stepper),
            even_grid(t0, length, num_steps, options.max_events),
            kept=self.kept,
            others=(_GuardsSeen(),),
        )
        state = integrate(problem, self.system.unpack(x))
        guards: _Guards = state.extensions[-1]
        seen = _Seen(
            size=jnp.maximum(pack(state.motion.scale, x.dtype), abs(x)),
            contacts=state.counts.at_surfaces,
            guards=guards,
            first_mode=pack(state.first_mode, x.dtype),
            result=state.result,
        )
        return pack(state.motion.x, x.dtype), stop_gradient(seen)
