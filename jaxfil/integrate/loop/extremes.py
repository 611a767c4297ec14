"""Extremes along a motion: the largest values of functions, including values between steps.

The functions are the rates of extra components behind the state (`run.observed`).

    values and rates at both ends of a step ──> Hermite's cubic ──> is its maximum the largest yet?
                                                                         │ the start of the step,
                                                                         v its mode, the time to it
    at the end of the run: that step again, of the length at which the rate of g changes its sign

In the loop the cubic only determines in which step the largest value lies, so that other steps do
not pay for a search. Its error, of order four, or of order one at a kink of g, does not enter the
result. A step that is a polynomial may be as long as a whole period; it has several cubics. The
lengths are constants in derivatives, like the lengths to contacts. At a maximum of a smooth piece
the rate is zero, and the ends of the pieces move with their contacts, so the derivative is right in
both cases. At a kink, where the rate jumps from ȧ > 0 to ḃ < 0, it is that of the value at which a
and b cross, (ȧ db − ḃ da)/(ȧ − ḃ). Second derivatives have further terms, since the time of a
maximum moves (`turning_point.beyond`).
"""

import dataclasses
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
from jaxfil.integrate.loop.turning_point import Turn, beyond, turning_point
from jaxfil.integrate.loop.window import Window
from jaxfil.integrate.steppers.explicit import Tableau, compact_step
from jaxfil.integrate.steppers.taylor import TaylorTableau
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system.components import Components, pack, side_of
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.smooth_field import Polynomial
from jaxfil.xla.second_derivative import add_second_derivative
from jaxfil.xla.select import select, select_all

# Orders of a polynomial for each of the cubics by which its step is examined: such steps are longer
# in proportion.
_ORDERS = 4


Seen: TypeAlias = tuple[tuple[Array, ...], tuple[Array, ...]]
"""The values of functions and their rates along a motion."""


def cubics_of(tableau: Tableau) -> int:
    """The number of parts of a step in each of which a cubic is near a function of the state."""
    return (tableau.order + 1) // _ORDERS if isinstance(tableau, TaylorTableau) else 1


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


class _Piece(eqx.Module):
    """A part of a step."""

    start: Place
    """Its start, without a value."""
    tau: Array
    """The elapsed time at its start."""
    h: Array
    """Its length."""
    seen: Seen
    """Values and rates at its start."""
    until: Seen
    """Values and rates at its end."""
    counts: Array
    """Whether the motion goes through it."""

    def top(self, k: int, inside: Array, since: Array) -> Place:
        """The place at which the cubic of function number k is largest; with the value −inf if that
        is not `inside` of the window."""
        g0, d0, g1, d1 = stop_gradient(tuple(v[k] for v in (*self.seen, *self.until)))
        # Rates by the fraction of the piece, which is the variable of the cubic.
        cubic = Cubic(g0, self.h * d0, g1, self.h * d1)
        # Between two pieces the maximum may be beyond the end of both, by rounding.
        theta, small = cubic.high, float(jnp.finfo(self.h.dtype).eps) ** 0.5
        turns = inside & self.counts & (theta > -small) & (theta < 1 + small)
        theta = jnp.clip(theta, 0.0, 1.0)
        turns = turns & (self.tau + theta * self.h >= since)
        value = select(turns, cubic(theta), -jnp.inf)
        return dataclasses.replace(self.start, value=value, length=theta * self.h, reach=self.h)


class Extremes(Extension):
    """The largest values of k functions, which are the rates of the last components of a field."""

    in_free_steps: ClassVar[bool] = True
    follows_contacts: ClassVar[bool] = True
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
        return state, self._further(problem, state, state, own, own, None, jnp.zeros((), bool))

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
        smooth, path = ~step.switched, step.path
        found = self._further(problem, state, after, own, now, path, smooth)
        if step.between is not None:
            # A state between two maps is no limit of the motion from either side, and its mode is
            # not decided yet.
            found = select_all(step.between, own, found)
        if (sections := sections_in(after)) is None:
            return after, found
        # A crossing is found by a step that ends on it and is taken back, which the run repeats if
        # it goes on. The window may open or close there.
        crossed = sections.watch.total > self.window.count(state)
        there = dataclasses.replace(after, motion=step.end.motion)
        at = self._now(own, self._seen(problem, there))
        inside = self._further(problem, state, there, own, at, path, smooth)
        opens = crossed & self.window.is_open(after) & ~self.window.is_open(state)
        if step.between is not None:
            crossed = crossed & ~step.between
        return after, dataclasses.replace(
            found,
            places=select_all(crossed, inside.places, found.places),
            ends=select_all(crossed, inside.ends, found.ends),
            since=select(opens, stop_gradient(there.motion.tau), found.since),
        )

    def after_free_step(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: SoFar,
        path: Polynomial | None,
        clear: Array,
    ) -> SoFar:
        now = self._now(own, self._on_sides(problem, after.motion))
        return select_all(clear, self._further(problem, state, after, own, now, path, clear), own)

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
        path: Polynomial | None,
        smooth: Array,
    ) -> SoFar:
        """The maxima after a step, along a `path` if it is a polynomial, which is part of a
        `smooth` piece or ends with a jump."""
        end, here = self._here(problem, after.motion), self.window.is_open(after)
        here, inside = here & (after.motion.tau >= own.since), smooth & self.window.is_open(state)
        pieces, places, ends = self._pieces(problem, state, after, own, now, path), [], []
        for k, place in enumerate(own.places):
            # The value at the end has its derivative. A value within the step gets one in `_found`.
            last = select(here, now.values[k], -jnp.inf)
            found = dataclasses.replace(end, value=last)
            for piece in pieces:
                between = piece.top(k, inside, own.since)
                found = select_all(between.value > found.value, between, found)
            places.append(select_all(found.value > place.value, found, place))
            ends.append(select(last > own.ends[k], last, own.ends[k]))
        return dataclasses.replace(now, places=tuple(places), ends=tuple(ends))

    def _pieces(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: SoFar,
        now: SoFar,
        path: Polynomial | None,
    ) -> list["_Piece"]:
        """The parts of a step in each of which a cubic is near the functions."""
        # Elapsed times restart only after `after_step`, so this is the length of the step.
        h = stop_gradient(after.motion.tau - state.motion.tau)
        first, last = (own.values, own.rates), (now.values, now.rates)

        def piece(motion: Motion, h: Array, seen: Seen, until: Seen, counts: Array) -> _Piece:
            return _Piece(self._here(problem, motion), motion.tau, h, seen, until, counts)

        if path is None:
            return [piece(state.motion, h, first, last, jnp.ones((), bool))]
        # The step may be a part of its path.
        share, count = h / select(path.h == 0, 1.0, path.h), cubics_of(problem.tableau)
        motions, seen = [state.motion], [first]
        for s in np.arange(1, count) / count:
            tau, x = state.motion.tau + float(s) * h, path.at(float(s) * share)
            motions.append(dataclasses.replace(state.motion, tau=tau, x=x))
            seen.append(self._seen(problem, dataclasses.replace(state, motion=motions[-1])))
        each = zip(motions, seen, (*seen[1:], last), strict=True)
        pieces = [piece(motion, h / count, v, w, ~path.ends) for motion, v, w in each]
        # A path that is right only at its end has one piece.
        return [*pieces, piece(state.motion, h, first, last, path.ends)]

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

        def more(here: Extremes, place: Place, i: Array, turn: Turn, dt: Array) -> Array:
            return beyond(lambda h: here._within(tableau, place, i, h), turn, place.reach, dt)

        def at(h: Array) -> tuple[Array, Array]:
            return here._within(tableau, place, i, h)

        before, after, part = turn = stop_gradient(turning_point(at, place.length, place.reach))
        # Between the two lengths the rate is a straight line, or jumps.
        value = (1 - part) * at(before)[0] + part * at(after)[0]
        # A place at the end of a step has its exact value and its derivative, from `_further`.
        value = select(place.reach > 0, value, place.value)
        dt = abs(problem.grid.dt)
        value = add_second_derivative(more, value, here, place, i, turn, dt)
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
