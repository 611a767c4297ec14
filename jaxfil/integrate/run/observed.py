"""Observables: functions of the time, the state, and optionally side, reaction or mode.

An observable is the rate of extra components behind the state of a wider system, so that on a slide
it is blended as the field is, and at rest it has the reactions. The mode that it may take is the
mode of the motion, on all sides of a blend.
"""

import dataclasses
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane import clocks
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import SavedStates
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.surfaces.sections import WatchedSections, watch_sections
from jaxfil.integrate.system.components import pack
from jaxfil.integrate.system.lowered import ComponentSystem, build
from jaxfil.model import check
from jaxfil.model.observe import Observe, asked_of, value_of
from jaxfil.model.parameter import cast
from jaxfil.model.section import Section
from jaxfil.model.system import System, field_of
from jaxfil.model.wrapped import Wrapped
from jaxfil.xla.select import select, select_all
from jaxfil.xla.valid_derivative import only_if_valid


class Observable(eqx.Module):
    """A user's function, with its numbers in the precision of the run, and the shape of its
    result."""

    function: Observe
    shape: tuple[int, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """The number of components of the result."""
        return math.prod(self.shape)

    @property
    def name(self) -> str:
        """The name of the function, or of its class."""
        name = getattr(self.function, "__name__", type(self.function).__name__)
        return "observed" if name == "<lambda>" else name

    @property
    def names(self) -> tuple[str, ...]:
        """The name of the result, or of each of its components."""
        return tuple(f"{self.name}[{i}]" for i in range(self.size)) if self.shape else (self.name,)


class OfState(eqx.Module):
    """A function of time, state and more, for states with more components at the end."""

    function: Callable[..., Any]
    n: int = eqx.field(static=True)

    def __call__(self, t: Array, x: Array, *others: Any) -> Any:
        return self.function(t, x[: self.n], *others)

    @property
    def __signature__(self) -> inspect.Signature:
        return inspect.signature(self.function)


class _WithRate(Wrapped):
    """A system with more components behind its state, which do not affect surfaces or resets."""

    function: Observe
    n: int = eqx.field(static=True)
    squares: int = eqx.field(static=True, default=0)

    def vector_field(
        self,
        t: Array,
        x: Array,
        side: Array,
        reaction: Array | None = None,
        mode: Array | None = None,
    ) -> Array:
        state, none = x[: self.n], jnp.zeros_like(side)
        # A mode that is not given is the combination of sides, as in `ComponentSystem.mode`.
        known = {
            "side": side,
            "reaction": none if reaction is None else reaction,
            "mode": side if mode is None else mode,
        }
        rate = jnp.ravel(jnp.asarray(value_of(self.function, t, state, known), x.dtype))
        return jnp.concatenate([field_of(self.system, t, state, side, reaction, mode), rate])

    @property
    def feels_reactions(self) -> bool:
        # Without resets no surface is rested on, and all reactions are zero.
        asked = self.system.resets and "reaction" in asked_of(self.function)
        return self.system.feels_reactions or asked

    @property
    def _observes_mode(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return "mode" in asked_of(self.function) or self.system._observes_mode

    @property
    def _squared(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (*self.system._squared, *range(self.n, self.n + self.squares))

    def switching(self, t: Array, x: Array) -> Array:
        return self.system.switching(t, x[: self.n])

    def reset(self, t: Array, x: Array, surface: Array) -> Array:
        after = self.system.reset(t, x[: self.n], surface)
        # The extra components are integrals over time, which do not jump with the state.
        return jnp.concatenate([after, x[self.n :]])

    def tick(self, t: Array, x: Array, clock: Array) -> Array:
        after = self.system.tick(t, x[: self.n], clock)
        return jnp.concatenate([after, x[self.n :]])


def with_rate(
    system: System, observable: Observable, x: Array, *, squared: bool = False
) -> tuple[System, Array]:
    """A system with extra components whose rate is the observable, or its square if `squared`, and
    its state: x and zeros."""
    # x may end in components of earlier observables, which count as a part of the state here. The
    # function does not see them if it is an `OfState`.
    squares = observable.size if squared else 0
    wider = _WithRate(system, observable.function, x.shape[0], squares)
    return wider, jnp.concatenate([x, jnp.zeros((observable.size,), x.dtype)])


def sections_of_run(
    sections: Sequence[Section],
    system: System,
    field: ComponentSystem,
    x0: Array,
    transposed: bool = False,
) -> WatchedSections | None:
    """The sections of a run of a system in its field, from states like x0, shape (n,); None without
    sections."""
    asking = [s.function for s in sections if asked_of(s.function)]
    wider, start = system, x0
    for function in asking:
        # One component for each such section, in their order, as `WatchedSections` expects.
        own = OfState(cast(function, x0.dtype), x0.shape[0])
        wider, start = with_rate(wider, Observable(own, ()), start)
    found = None
    if asking:
        found = build(wider, start, compact=field.compact, transposed=transposed)
    return watch_sections(sections, field, x0, found, transposed)


def checked_observable(name: str, function: Any, system: System, x: Array) -> Observable:
    """A function to be observed in a run from a state like x."""
    function = cast(check.function(name, function, "(t, x, side)"), x.dtype)
    side = jnp.ones(check.shapes(system, x), x.dtype)
    # Side, reaction and mode have one shape.
    given = dict.fromkeys(asked_of(function), side)
    out = check.returned(f"`{name}`", function, "", t=jnp.zeros((), x.dtype), x=x, **given)
    return Observable(function, check.real_shape(name, out))


def observed(
    observable: Observable,
    problem: Problem,
    system: System,
    x0: Array,
    at: SavedStates,
    *,
    both: bool = False,
) -> Array:
    """The values at the states saved in a run from x0, shape (k, *shape); inf for unreached
    entries. States saved on `both` sides of an event have one time in two or more rows, of which
    the earliest is the state before it."""
    wider, start = with_rate(system, observable, x0)
    # `transposed`, since branches that are not taken are evaluated too.
    field = build(wider, start, compact=True, transposed=True)
    around = dataclasses.replace(problem, system=field)
    same, no = at.ts[1:] == at.ts[:-1], jnp.zeros((1,), bool)
    as_next, as_last = jnp.append(same, no), jnp.append(no, same)
    forward = problem.grid.direction > 0
    before = select(forward, as_next & ~as_last, as_last & ~as_next) if both else None

    def value(*row: Any) -> Array:
        # Unreached entries and failed lanes are computed too.
        reached, values = only_if_valid(_value, around, x0, start, *row)
        return select(reached, values, jnp.inf).reshape(observable.shape)

    return jax.vmap(value)(at.ts, at.xs, at.modes, before)


def _value(
    around: Problem,
    x0: Array,
    start: Array,
    t: Array,
    x: Array,
    mode: Array,
    before: Array | None,
) -> tuple[Array, tuple[Array, Array]]:
    """Whether an entry is reached, twice, and the values in its row, given the problem and the
    start of the run that carries them."""
    reached, n = jnp.isfinite(t) & jnp.all(jnp.isfinite(x)), len(x0)
    # Unreached entries are inf; they are replaced before the evaluation.
    t, x = select(reached, t, around.grid.t0), select(reached, x, x0)
    # The mode of an unreached entry may be 0, and would be evaluated as a slide.
    mode = select(reached, mode.astype(x.dtype), 1.0)
    # A single state saved at a tick is the one after it, also backward in time.
    here = clocks.just_after(around, t, in_time=True).system
    if before is not None and here.clocks:
        earlier = clocks.just_before(around, t).system.window
        here = dataclasses.replace(here, window=select_all(before, earlier, here.window))
    carried = here.unpack(jnp.concatenate([x, start[n:]]))
    rate = ModeField(here, here.of_surfaces(mode))(t, carried)
    return reached, (reached, pack(rate, x.dtype)[n:])
