"""The functions of sections, and their rates along the motion.

`WatchedSections` evaluates the functions of `Section`s on components. The functions that take the
side, the mode or the reaction are rates of extra components behind the state (`run.observed`),
since these are blended on a slide as the field is.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.surfaces.filippov import ModeField, field_terms
from jaxfil.integrate.surfaces.second_order import beyond_newton_to
from jaxfil.integrate.system.components import Components, dot, pack, total, where
from jaxfil.integrate.system.functions import size_of_time
from jaxfil.integrate.system.lowered import ComponentSystem, ParametrizedFunction
from jaxfil.model.observe import asked_of
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast
from jaxfil.model.section import Section
from jaxfil.xla.trace import Traced


class WatchedSections(eqx.Module):
    """k sections on components, for the loop."""

    functions: tuple[ParametrizedFunction | None, ...]
    """S of each section, a function of time and state; None for one that takes more than these."""
    directions: tuple[int, ...] = eqx.field(static=True)
    of_rate: tuple[bool, ...] = eqx.field(static=True)
    """Whether S is the rate of the function along the motion, for each section."""
    bounds: tuple[bool, ...] = eqx.field(static=True)
    """Whether a crossing is a failure, for each section."""
    terminal: tuple[Array | None, ...]
    """Number of the crossing of each section that ends a run."""
    unseen: Array | None = None
    """Number of first crossings that are counted without being recorded; None for zero."""
    since: Array | None = None
    """The time before which crossings are ignored; None to count all."""
    asking: ComponentSystem | None = None
    """A field whose last components are the functions that take more; None without any."""

    @property
    def need_mode(self) -> tuple[bool, ...]:
        """Whether S depends on the mode of the motion, for each section."""
        each = zip(self.functions, self.of_rate, strict=True)
        return tuple(plain is None or of_rate for plain, of_rate in each)

    def value(self, j: int, system: ComponentSystem, mode: Components) -> Callable:
        """S number j, a function of time and state, on a motion of the given mode."""
        plain = self.functions[j]

        def held(t: Array, x: Components) -> Array:
            # Like the system's functions, on the side of a tick on which the motion is.
            assert plain is not None
            return plain(system.held(t), x)

        function = self._asking_value(j, system, mode) if plain is None else held
        if not self.of_rate[j]:
            return function

        def rate(t: Array, x: Components) -> Array:
            field = ModeField(system, mode)(t, x)
            return jax.jvp(function, (t, x), (jnp.ones_like(t), field))[1]

        return rate

    def _asking_value(self, j: int, system: ComponentSystem, mode: Components) -> Callable:
        """The function of a section that takes more than time and state, on such a motion."""
        assert self.asking is not None
        # The window between ticks is the same as for the field of the motion.
        wider = dataclasses.replace(self.asking, window=system.window)
        field = ModeField(wider, wider.of_surfaces(pack(mode, wider.dtype)))
        # Components of functions that ask follow the state in the order of the sections
        # (`run.observed.sections_of_run`).
        place = system.n + [i for i, f in enumerate(self.functions) if f is None].index(j)
        # The extra components have no effect on the field, so any values serve.
        zeros = jnp.zeros((wider.n - system.n,), wider.dtype)

        def function(t: Array, x: Components) -> Array:
            state = wider.unpack(jnp.concatenate([pack(x, wider.dtype), zeros]))
            return field(t, state).number(place)

        return function

    def outcome(self, result: RESULTS, counts: Components, ended: Array) -> RESULTS:
        """The outcome of a run, given the one before, the number of crossings of each section, and
        whether the run may have `ended` here."""
        each = zip(counts.parts, self.terminal, self.bounds, strict=True)
        for count, last, bound in each:
            if last is not None:
                outcome = RESULTS.out_of_bounds if bound else RESULTS.section_reached
                result = RESULTS.where(ended & (count >= last), outcome, result)
        return result


class Sight(eqx.Module):
    """Values of k sections at one state: S, dS/dt along the motion, and the size of S's terms."""

    value: Components
    rate: Components
    terms: Components


def watch_sections(
    sections: Sequence[Section],
    system: ComponentSystem,
    x0: Array,
    asking: ComponentSystem | None,
    transposed: bool = False,
) -> WatchedSections | None:
    """The sections of a run from states like `x0`, shape (n,); None without sections. Functions
    that take more than time and state are the last components of `asking`."""
    if not sections:
        return None
    t0, x = jnp.zeros((), x0.dtype), system.unpack(x0)
    functions = []
    for section in sections:
        if asked_of(section.function):
            functions.append(None)
            continue
        # Arrays in a function are parameters, like the arrays of a system, and not constants.
        leaves, static = eqx.partition(cast(section.function, x0.dtype), eqx.is_array)
        traced = Traced(
            _on_components(static, x0.dtype),
            leaves,
            t0,
            x,
            transposed=transposed,
            fast=not system.compact,
        )
        functions.append(ParametrizedFunction.of(traced, leaves, system.fence))
    last = [None if s.terminal is None else jnp.asarray(s.terminal, jnp.int32) for s in sections]
    return WatchedSections(
        functions=tuple(functions),
        directions=tuple(s.direction for s in sections),
        of_rate=tuple(s.of_rate for s in sections),
        bounds=tuple(s.is_bound for s in sections),
        terminal=tuple(last),
        asking=asking,
    )


def _on_components(static: Any, dtype: Any) -> Callable:
    def function(leaves: Any, t: Array, x: Components) -> Array:
        return jnp.asarray(eqx.combine(leaves, static)(t, pack(x, dtype)), dtype)

    return function


def see(
    watched: WatchedSections,
    system: ComponentSystem,
    at: tuple[Array, Components],
    motion: tuple[Components, Components],
    size: Components,
    dt: Array,
) -> Sight:
    """The sections at a time and a state, on a motion of the given mode with the field f. `size` is
    the running size of the states, and dt the length of the steps so far."""
    (t, x), (mode, f) = at, motion
    # At rest or stuck, a section of a quantity that is held at zero still has the rounding of the
    # fields that hold it.
    size = size + abs(dt) * field_terms(system, t, x, mode, f)
    values, rates, terms = [], [], []
    for j in range(len(watched.functions)):
        # One gradient serves the rate and the sizes of the terms.
        value, pull = jax.vjp(watched.value(j, system, mode), t, x)
        by_t, by_x = pull(jnp.ones_like(value))
        values.append(value)
        rates.append(by_t + dot(by_x, f))
        terms.append(dot(abs(by_x), size) + abs(by_t * size_of_time(system.clocks, t)))
    # Rates have no derivative, as in `contacts.guards`.
    held, rates = system.hold(Components(values)), system.hold(stop_gradient(Components(rates)))
    return Sight(held, rates, stop_gradient(Components(terms)))


def beyond_newton(
    watched: WatchedSections,
    system: ComponentSystem,
    at: tuple[Array, Components],
    mode: Components,
    aim: Components,
) -> tuple[Array, Components]:
    """The terms of `second_order.beyond_newton` for the time to a crossing of the section `aim`,
    and for the state there."""

    def gap(given: tuple[WatchedSections, ComponentSystem], t: Array, x: Components) -> Any:
        watched, system = given
        functions = [watched.value(j, system, mode) for j in range(len(aim.parts))]
        return total(where(aim, Components(s(t, x) for s in functions), 0.0))

    return beyond_newton_to(gap, lambda given: given[1], (watched, system), at, mode)
