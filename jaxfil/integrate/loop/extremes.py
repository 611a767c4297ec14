"""Extremes along a motion: the largest values of functions, including values between steps.

The functions are the rates of extra components behind the state (`run.observed`).

    values and rates at both ends of a step ──> Hermite's cubic ──> is its maximum the largest yet?
                                                                         │ the start of the step,
                                                                         v its mode, the time to it
    at the end of the run: that step again, of the length at which the rate of g changes its sign

In the loop the cubic only determines in which step the largest value lies, so that other steps do
not pay for a search. Its error, of order four, or of order one at a kink of g, does not enter the
result. The lengths are constants in derivatives, like the lengths to contacts. At a maximum of a
smooth piece the rate is zero, and the ends of the pieces move with their contacts, so the
derivative is right in both cases. At a kink, where the rate jumps from ȧ > 0 to ḃ < 0, it is that
of the value at which a and b cross, (ȧ db − ḃ da)/(ȧ − ḃ). Second derivatives have further terms,
since the time of a maximum moves (`_beyond`).
"""

import dataclasses
from collections.abc import Callable
from typing import ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import Cubic
from jaxfil.integrate.lane import clocks
from jaxfil.integrate.lane.extension import Extension, Step, Verdict
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState, Motion
from jaxfil.integrate.loop.extensions import sections_in
from jaxfil.integrate.loop.window import Window
from jaxfil.integrate.steppers.explicit import Tableau, compact_step
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system.components import Components, pack, side_of
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.second_derivative import add_second_derivative
from jaxfil.xla.select import select, select_all

# Largest number of steps to the length at which a rate changes its sign; halvings alone reach the
# rounding of a length.
_STEPS = 60


_Turn: TypeAlias = tuple[Array, Array, Array]
"""Two lengths around a maximum, and the part of the way between them (`_turning_point`)."""
Seen: TypeAlias = tuple[tuple[Array, ...], tuple[Array, ...]]
"""The values of functions and their rates along a motion."""


class Place(eqx.Module):
    """The position on a motion at which one function is largest."""

    value: Array
    """The value there, within a step approximated by the cubic; −inf at first."""
    t: Array
    """The time at the start of the step that contains the maximum."""
    x: Components
    """The state at the start of that step."""
    mode: Components
    """The mode at the start of that step."""
    length: Array
    """The time from the start of the step to the maximum."""
    reach: Array
    """The length of the step; 0 if the maximum is at its end."""


class SoFar(eqx.Module):
    """The values and maxima of k functions along a lane."""

    values: tuple[Array, ...]
    """The values at the lane's state."""
    rates: tuple[Array, ...]
    """The rates along the motion at the lane's state."""
    places: tuple[Place, ...]
    ends: tuple[Array, ...]
    """The largest values at the ends of steps; −inf at first."""
    since: Array
    """The elapsed time at which the window has opened within a step, at a crossing of a section;
    −inf if it opens at the end of a step."""


class Extremes(Extension):
    """The largest values of k functions, which are the rates of the last components of a field."""

    in_free_steps: ClassVar[bool] = True
    between_steps: ClassVar[bool] = True
    field: ComponentSystem
    n: int = eqx.field(static=True)
    """The number of components of the state that precede the functions' components."""
    signs: tuple[float, ...] = eqx.field(static=True)
    """+1 for a maximum; −1 for a minimum, computed as the maximum of −g."""
    window: Window

    def begin(self, problem: Problem, state: LoopState) -> tuple[LoopState, SoFar]:
        values, rates = self._seen(problem, state)
        nothing = self._here(problem, state.motion)
        nowhere = (dataclasses.replace(nothing, value=nothing.value - jnp.inf),) * len(values)
        never = jnp.full_like(state.motion.tau, -jnp.inf)
        own = SoFar(values, rates, nowhere, tuple(v - jnp.inf for v in values), never)
        # The start is a place of its own, if the window is open.
        return state, self._further(problem, state, state, own, own, jnp.zeros((), bool))

    def after_step(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: SoFar,
        step: Step,
        verdict: Verdict | None,
    ) -> tuple[LoopState, SoFar]:
        now = self._now(own, self._seen(problem, after))
        # Across a switch values may jump, and a cubic through both ends would be meaningless.
        found = self._further(problem, state, after, own, now, ~step.switched)
        if (sections := sections_in(after)) is None:
            return after, found
        # A crossing is found by a step that ends on it and is taken back, which the run repeats if
        # it goes on. The window may open or close there.
        crossed = sections.watch.total > self.window.count(state)
        there = dataclasses.replace(after, motion=step.end.motion)
        at = self._now(own, self._seen(problem, there))
        inside = self._further(problem, state, there, own, at, ~step.switched)
        opens = crossed & self.window.is_open(after) & ~self.window.is_open(state)
        return after, dataclasses.replace(
            found,
            places=select_all(crossed, inside.places, found.places),
            ends=select_all(crossed, inside.ends, found.ends),
            since=select(opens, stop_gradient(there.motion.tau), found.since),
        )

    def after_free_step(
        self, problem: Problem, state: LoopState, after: LoopState, own: SoFar, clear: Array
    ) -> SoFar:
        now = self._now(own, self._on_sides(problem, after.motion))
        return select_all(clear, self._further(problem, state, after, own, now, clear), own)

    def _now(self, own: SoFar, seen: Seen) -> SoFar:
        values, rates = seen
        return SoFar(values, rates, own.places, own.ends, own.since)

    def _seen(self, problem: Problem, state: LoopState) -> Seen:
        """Values and rates at the state of a lane. For a lane that neither slides nor rests they
        are the same as in a free step, bit for bit."""
        system = problem.system
        if not system.slides and not system.resets:
            return self._on_sides(problem, state.motion)

        def held(motion: Motion) -> Seen:
            field = self._field(problem)
            own = ModeField(field, field.of_surfaces(pack(motion.mode, system.dtype)))
            found = self._along(problem, own, motion)
            return select_all(state.held, found, self._on_sides(problem, motion))

        def free(motion: Motion) -> Seen:
            return self._on_sides(problem, motion)

        return system.where_any(state.held, held, free, state.motion)

    def _on_sides(self, problem: Problem, motion: Motion) -> Seen:
        field = self._field(problem)
        sides = field.of_surfaces(pack(side_of(motion.mode), field.dtype))
        return self._along(problem, ModeField(field, sides, blended=False), motion)

    def _field(self, problem: Problem) -> ComponentSystem:
        # The window between ticks is the same as for the field of the motion.
        return dataclasses.replace(self.field, window=problem.system.window)

    def _along(self, problem: Problem, field: ModeField, motion: Motion) -> Seen:
        return self._of(field, problem.grid.t0 + motion.tau, self._state(motion.x))

    def _of(self, field: ModeField, t: Array, x: Components) -> Seen:
        """The functions, each with its sign, and their rates along the field."""

        def functions(t: Array, x: Components) -> tuple[Array, ...]:
            numbers = field(t, x)
            each = enumerate(self.signs)
            return tuple(sign * numbers.number(self.n + i) for i, sign in each)

        return jax.jvp(functions, (t, x), (jnp.ones_like(t), field(t, x)))

    def _state(self, x: Components) -> Components:
        """A state of the run on the components of this field. The run may carry other components;
        the integrals of these functions are zero."""
        zero, k = jnp.zeros((), self.field.dtype), len(self.signs)
        if self.field.as_array or x.is_array:
            numbers = pack(x, self.field.dtype)[: self.n]
            return self.field.unpack(jnp.concatenate([numbers, jnp.zeros((k,), numbers.dtype)]))
        return Components((*x.parts[: self.n], *(zero,) * k))

    def _here(self, problem: Problem, motion: Motion) -> Place:
        """The place of a motion, without a value."""
        zero = jnp.zeros_like(motion.tau)
        mode = self.field.of_surfaces(pack(motion.mode, self.field.dtype))
        t = problem.grid.t0 + motion.tau
        return Place(zero, t, self._state(motion.x), mode, zero, zero)

    def _further(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: SoFar,
        now: SoFar,
        smooth: Array,
    ) -> SoFar:
        """The maxima after a step, which is part of a `smooth` piece or ends with a jump."""
        # Elapsed times restart only after `after_step`, so this is the length of the step.
        h = stop_gradient(after.motion.tau - state.motion.tau)
        start, end = self._here(problem, state.motion), self._here(problem, after.motion)
        inside, here = smooth & self.window.is_open(state), self.window.is_open(after)
        here = here & (after.motion.tau >= own.since)
        places, ends = [], []
        for k, place in enumerate(own.places):
            g0, d0, g1, d1 = stop_gradient(
                (own.values[k], own.rates[k], now.values[k], now.rates[k])
            )
            # Rates by the fraction of the step, which is the variable of the cubic.
            cubic = Cubic(g0, h * d0, g1, h * d1)
            theta = cubic.high
            turns = inside & (theta > 0) & (theta < 1)
            turns = turns & (state.motion.tau + theta * h >= own.since)
            top = select(turns, cubic(theta), -jnp.inf)
            # The value at the end has its derivative. A value within the step gets one in `_found`.
            last = select(here, now.values[k], -jnp.inf)
            between = dataclasses.replace(start, value=top, length=theta * h, reach=h)
            found = select_all(top > last, between, dataclasses.replace(end, value=last))
            places.append(select_all(found.value > place.value, found, place))
            ends.append(select(last > own.ends[k], last, own.ends[k]))
        return dataclasses.replace(now, places=tuple(places), ends=tuple(ends))

    def found(self, problem: Problem, own: SoFar) -> Array:
        """The extremes, shape (k,), at the end of one lane; NaN if it ended before the window."""
        # A loop over the places, so that the program contains the step once.
        places = jax.tree.map(lambda *v: jnp.stack(v), *own.places)
        found = jax.lax.map(
            lambda at: self._found(problem, *at),
            (places, jnp.stack(own.ends), jnp.arange(len(places.t))),
        )
        return np.asarray(self.signs, found.dtype) * found

    def _found(self, problem: Problem, place: Place, end: Array, i: Array) -> Array:
        tableau, around = problem.tableau, dataclasses.replace(problem, system=self.field)
        here = dataclasses.replace(self, field=clocks.just_after(around, place.t).system)

        def beyond(here: Extremes, place: Place, i: Array, turn: _Turn, dt: Array) -> Array:
            return _beyond(lambda h: here._within(tableau, place, i, h), turn, place.reach, dt)

        def at(h: Array) -> tuple[Array, Array]:
            return here._within(tableau, place, i, h)

        before, after, part = turn = stop_gradient(_turning_point(at, place))
        # Between the two lengths the rate is a straight line, or jumps.
        value = (1 - part) * at(before)[0] + part * at(after)[0]
        # A place at the end of a step has its exact value and its derivative, from `_further`.
        value = select(place.reach > 0, value, place.value)
        dt = abs(problem.grid.dt)
        value = add_second_derivative(beyond, value, here, place, i, turn, dt)
        # At a kink the cubic may have chosen a step without the largest value.
        value = select(end > value, end, value)
        return select(place.value > -jnp.inf, value, jnp.nan)

    def _within(self, tableau: Tableau, place: Place, i: Array, h: Array) -> tuple[Array, Array]:
        """Function number i and its rate after a length h of the step of a place."""
        field, t, x = ModeField(self.field, place.mode), place.t, place.x
        forcing = self.field.forcing(t, h, tableau.times)
        end = compact_step(tableau, field, t, x, field(t, x), h, forcing)
        values, rates = map(jnp.stack, self._of(field, t + h, end.x))
        return values[i], rates[i]


def _beyond(
    at: Callable[[Array], tuple[Array, Array]], turn: _Turn, reach: Array, dt: Array
) -> Array:
    """Terms of second order of a maximum, of which the value and the first derivatives are zero.

    With the rate r and its slope r′ < 0 at a smooth maximum, the time of the maximum moves by
    −r/r′, and the value rises by −r²/2r′. At a kink with D = a − b it moves by −D/Ḋ, and

        a − (ȧ/Ḋ) D + (ä/Ḋ² − ȧ D̈/Ḋ³) D²/2

    is the value at which a and b cross; the first derivative has a constant part p of D for ȧ/Ḋ.
    """
    before, after, part = turn
    one = jnp.ones_like(before)
    (a, a_t), (_, a_tt) = jax.jvp(at, (before,), (one,))
    (b, b_t), (_, b_tt) = jax.jvp(at, (after,), (one,))
    a_tt, b_tt = stop_gradient((a_tt, b_tt))
    small = float(jnp.finfo(one.dtype).eps) ** 0.5
    rate, slope = select_all(part < 0.5, (a_t, a_tt), (b_t, b_tt))
    smooth = (slope < 0) & (abs(rate) <= -small * slope * dt)
    rises = -0.5 * rate**2 / select(smooth, slope, -one)
    apart, fall = a - b, a_t - b_t
    # The two lengths are so near that a smooth rate falls by less.
    kink = (after - before <= small * reach) & (fall > small * reach * (abs(a_tt) + abs(b_tt)))
    moves = apart / select(kink, fall, one)
    bend = (1 - part) * a_tt + part * b_tt
    crosses = (part - a_t / select(kink, fall, one)) * apart + 0.5 * bend * moves**2
    return select(kink, crosses, select(smooth, rises, 0.0))


def _turning_point(at: Callable[[Array], tuple[Array, Array]], place: Place) -> _Turn:
    """Two lengths between which the rate changes from positive to negative in the step of a place,
    as close as rounding allows, and the part of the way from one to the other at which it does.
    Both are the same without such a change."""

    def rate(h: Array) -> Array:
        return at(h)[1]

    def on(known: tuple[Array, ...]) -> Array:
        low, r_low, high, r_high, count = known
        part = _part(r_low, r_high)
        # The distance of the nearer length. At a jump both are near, with rates that are not small.
        away = jnp.minimum(part, 1 - part) * (high - low)
        small = 4 * jnp.finfo(high.dtype).eps * place.reach
        return (count < _STEPS) & (r_low > 0) & (r_high < 0) & (away > small)

    def closer(known: tuple[Array, ...]) -> tuple[Array, ...]:
        low, r_low, high, r_high, count = known
        secant = low + _part(r_low, r_high) * (high - low)
        # A secant is near at once where the rate is straight. Every other step is a halving, which
        # also approaches a jump.
        h = select(count % 2 == 0, jnp.clip(secant, low, high), _middle(low, high))
        r = rate(h)
        rises = r > 0
        return (
            select(rises, h, low),
            select(rises, r, r_low),
            select(rises, high, h),
            select(rises, r_high, r),
            count + 1,
        )

    middle, zero = place.length, jnp.zeros_like(place.length)
    r_middle, before = rate(middle), zero
    rises = r_middle > 0
    low, high = select(rises, middle, before), select(rises, place.reach, middle)
    known = low, rate(low), high, rate(high), jnp.zeros((), jnp.int32)
    low, r_low, high, r_high, _ = jax.lax.while_loop(on, closer, known)
    turns = (r_low > 0) & (r_high <= 0)
    low, high = select(turns, low, middle), select(turns, high, middle)
    return low, high, select(turns, _part(r_low, r_high), 0.0)


def _middle(low: Array, high: Array) -> Array:
    return low + 0.5 * (high - low)


def _part(r_low: Array, r_high: Array) -> Array:
    """The part of the way between two rates at which a line through them vanishes."""
    fall = r_low - r_high
    return select(fall > 0, r_low / select(fall > 0, fall, 1), 0.0)
