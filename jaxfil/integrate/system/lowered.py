"""The lowered system: the fields and surfaces of a `System` on components.

A `ComponentSystem` has static sizes (n states, m surfaces) and functions on tuples of scalars. In a
batch each scalar is one contiguous array of lanes, which XLA turns into vector instructions; an
(n,) state in the loop would be strided. A large state is one array nevertheless, since its program
would grow with n, and the array's own numbers fill the vectors. A compact program, which has one
lane, holds every state as an array. The numbers of the surfaces are one array too, where there are
several that are independent of each other (`ComponentSystem.packed`).
"""

import dataclasses
import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.system import dependencies
from jaxfil.integrate.system.components import Components, Forcing, on_each, scalars
from jaxfil.integrate.system.dependencies import Structure
from jaxfil.integrate.system.fenced import Fenced
from jaxfil.integrate.system.functions import (
    ParametrizedFunction,
    accelerations,
    clocks_of,
    fence_of,
    on_components,
    rate_of,
    reacting,
    unpacked,
)
from jaxfil.integrate.system.refused import (
    check_affine,
    check_derivatives,
    check_loops,
    check_reactions,
    check_sharding,
)
from jaxfil.integrate.system.rows import Rows
from jaxfil.integrate.system.squares import squared
from jaxfil.model import check
from jaxfil.model.system import System
from jaxfil.xla.rounding import rounding_of
from jaxfil.xla.series import Expansion, Series
from jaxfil.xla.trace import EARLY, FIRST, LATE, Traced

# The largest number of scalar components of a state, and of surfaces of a state that is one array,
# in a program that is written out and in a compact one.
_FEW, _FEW_SURFACES = (12, 2), (1, 1)
# The largest number of surfaces that are scalar components, even if coupled.
_MANY_SURFACES = 3


class ComponentSystem(Fenced):
    """A system on components: n states, m surfaces."""

    n: int = eqx.field(static=True)
    m: int = eqx.field(static=True)
    slides: bool = eqx.field(static=True)
    """Whether sliding is compiled."""
    resets: bool = eqx.field(static=True)
    """Whether resets are compiled."""
    dtype: Any = eqx.field(static=True)
    structure: Structure = eqx.field(static=True)
    """Which numbers of the field and of H depend on which side and state."""
    compact: bool = eqx.field(static=True)
    """Whether it is small: sines are one operation, only arrays are computed ahead (`grade`)."""
    transposed: bool = eqx.field(static=True)
    """Whether the program is differentiated in reverse mode."""
    as_array: bool = eqx.field(static=True)
    """Whether a state is one array."""
    holds_itself: tuple[bool, ...] = eqx.field(static=True)
    """Flags of surfaces whose reaction acts through the field alone; empty without reactions."""
    packed: bool = eqx.field(static=True)
    """Whether all surfaces are one (m,) array, and a state too: for separate surfaces without
    resets that share no number of it, and for large m."""
    _field: Any
    _switching: Any
    _felt: Any
    _reset: Any
    _tick: Any
    _rounding: Any
    _rate_rounding: Any
    clocks: tuple[tuple[Array, Array], ...]
    """Periods and phases of the clocks."""
    window: tuple[Array, Array] | None = None
    """The interval to which times are clamped (see `clocks`)."""
    asks_mode: bool = eqx.field(static=True, default=False)
    """Whether the field takes the mode, for an observable of the motion."""
    mode: Components | None = None
    """The mode passed to the field; None stands for the sides of the evaluation."""
    squares: tuple[int, ...] = eqx.field(static=True, default=())
    """Numbers of the field whose square is the rate of a motion (see `squares`)."""

    def in_mode(self, mode: Components) -> "ComponentSystem":
        """The system for a motion in this mode."""
        if not self.asks_mode:
            return self
        return dataclasses.replace(self, mode=jax.lax.stop_gradient(mode))

    def _seen(self, sides: Components) -> tuple[Components, ...]:
        """The mode passed to the functions of the system, if they take it."""
        return (sides if self.mode is None else self.mode,) if self.asks_mode else ()

    def held(self, t: Array) -> Array:
        """A time, clamped to the window, for the functions of the system."""
        if self.window is None:
            return t
        low, high = self.window
        # The clamped value, with the derivative of t.
        return t + jax.lax.stop_gradient(jnp.clip(t, low, high) - t)

    @property
    def eps(self) -> float:
        """Machine epsilon of the precision."""
        return float(jnp.finfo(self.dtype).eps)

    @property
    def fence(self) -> Array | None:
        """The fence of a lane's functions (see `ParametrizedFunction`)."""
        return self._switching.fence

    def forcing(self, t: Array, h: Array, times: Sequence[float]) -> list[Forcing]:
        """The expensive values of the field that depend on time alone, at t + c·h for each c of
        `times`. Both sides of a surface and all stages at one time share them."""

        def at(t: Array, h: Array) -> list[Forcing]:
            return [self.forcing_at(t + c * h) for c in times]

        def together(t: Array, h: Array) -> Forcing:
            return jax.vmap(self.forcing_at)(t + h * np.array(times, self.dtype))

        if not jax.eval_shape(self.forcing_at, t):
            return [[] for _ in times]
        if not self.compact:
            return self.once(at, t, h)
        rows = self.once(together, t, h)
        return [[v[k] for v in rows] for k in range(len(times))]

    def forcing_at(self, t: Array) -> Forcing:
        """The expensive values of the field at one time; in a compact program only arrays."""
        return self._field.ahead(self.held(t))

    def field(
        self,
        t: Array,
        x: Components,
        sides: Components,
        alone: bool = False,
        forcing: Forcing | None = None,
        term: bool = False,
    ) -> Components:
        """F(t, x, sides) for sides of exactly ±1, with the values of `forcing` for t if given.
        `alone` means that the result is used in one vector only, blended or not, and `term` that it
        is blended or reactions are added, before its numbers are `squared`."""
        more = (None, *self._seen(sides)) if self.asks_mode else ()
        f = self._field(self.held(t), x, sides, *more, alone=alone, known=forcing)
        return f if term else self.squared(f)

    def squared(self, f: Components) -> Components:
        """The rate of a motion from its field."""
        return squared(self.squares, f)

    @property
    def feels_reactions(self) -> bool:
        """Whether the field depends on reactions."""
        return self._felt is not None

    def felt(self, t: Array, x: Components, sides: Components, reaction: Components) -> Components:
        """The part of the field added by m reactions, in which it is affine."""
        return self._felt(self.held(t), x, sides, reaction, *self._seen(sides))

    def expansion(self) -> Expansion:
        """A new expansion, in which power series of the system's functions are computed."""
        return self._field.traced.expansion(self.fence)

    def expanded_field(
        self, expansion: Expansion, t: Series, x: list[Any], sides: Components
    ) -> list[Any]:
        """Power series of F(t, x, sides), before its numbers are squared."""
        more = (None, *self._seen(sides)) if self.asks_mode else ()
        return self._field.expanded(expansion, self._held_series(expansion, t), x, sides, *more)

    def expanded_switching(self, expansion: Expansion, t: Series, x: list[Any]) -> list[Any]:
        """Power series of H(t, x)."""
        return self._switching.expanded(expansion, self._held_series(expansion, t), x)

    def expanded_rate(
        self, expansion: Expansion, t: Series, x: list[Any], f: list[Any]
    ) -> list[Any]:
        """Power series of dH/dt along a field."""
        along = [expansion.constant(jnp.ones((), self.dtype)), *f]
        return self._switching.expanded_rate(expansion, self._held_series(expansion, t), x, along)

    def _held_series(self, expansion: Expansion, t: Series) -> Series:
        return t if self.window is None else expansion.linear(self.held(t[0]), t[1])

    def switching(self, t: Array, x: Components) -> Components:
        """H(t, x)."""
        return self._switching(self.held(t), x)

    def rounding(self, t: Array, x: Components) -> Components | None:
        """The rounding error inside H, in eps, excluding the rounding of t and x; None if zero."""
        return self._rounding and self._rounding(self.held(t), x)

    def rate_rounding(self, t: Array, x: Components, sides: Components) -> Components | None:
        """The same of dH/dt along the field on some sides, for systems with resets."""
        return self._rate_rounding and self._rate_rounding(self.held(t), x, sides)

    @property
    def may_lack_gradients(self) -> bool:
        """Whether H may have a value without a gradient, as √x at 0."""
        return self._switching.traced.is_singular

    def reset(self, t: Array, x: Components, surface: Array) -> Components:
        """The state after an impact on `surface`."""
        return self._reset(self.held(t), x, jnp.asarray(surface, jnp.int32))

    def tick(self, t: Array, x: Components, clock: Array) -> Components:
        """The state after a tick of a clock; a negative number stands for the first clock."""
        return self._tick(self.held(t), x, jnp.maximum(jnp.asarray(clock, jnp.int32), 0))

    @property
    def ticks(self) -> bool:
        """Whether ticks change the state."""
        return self._tick is not None

    def unpack(self, x: Array) -> Components:
        """The components of a state, shape (n,)."""
        return unpacked(x, self.as_array)

    def constant(self, numbers: np.ndarray) -> Components:
        """The components of a constant state, shape (n,)."""
        return on_each(lambda v: jnp.asarray(v, self.dtype), unpacked(numbers, self.as_array))

    def of_surfaces(self, numbers: Any) -> Components:
        """Numbers in an (m,) array as components."""
        return Components([numbers] if self.packed else scalars(numbers))

    def for_each_surface(self, number: Array) -> Components:
        """The same number for each of the surfaces."""
        return Components([jnp.full((self.m,), number)] if self.packed else (number,) * self.m)

    def rate(self, t: Array, x: Components, f: Components) -> Components:
        """dH/dt along the direction (1, f)."""
        _, rate = jax.jvp(self.switching, (t, x), (jnp.ones_like(t), f))
        return rate

    def gradients(self, t: Array, x: Components) -> tuple[Components, Components, Rows]:
        """H, ∂H/∂t and the gradients ∂H_j/∂x."""
        h, pull = jax.vjp(self.switching, t, x)
        if not self.packed:
            by_t, rows = zip(*(pull(unit) for unit in self._units), strict=True)
            return h, Components(by_t), Rows(rows)
        _, h_t = jax.jvp(lambda t: self.switching(t, x), (t,), (jnp.ones_like(t),))
        if self.structure.members is None or self.resets:
            return h, h_t, self.rows_of(lambda unit: pull(unit)[1:])
        _, row = pull(h.like(jnp.ones_like(t)))
        return h, h_t, Rows([row], self.structure.members)

    def rows_of(self, pull: Callable) -> Rows:
        """The gradients of m quantities, one for each surface, given the transposed derivative,
        which maps m cotangents to a tuple of one cotangent of the state."""
        return self.for_units(lambda unit: pull(unit)[0])

    def for_units(self, row: Callable[[Components], Components]) -> Rows:
        """A row of n numbers for each surface, computed from the surface's unit vector."""
        if not self.packed:
            return Rows(map(row, self._units))
        units = jnp.eye(self.m, dtype=self.dtype)
        return Rows.array(jax.vmap(lambda unit: row(Components([unit])))(units).parts[0])

    @property
    def _units(self) -> list[Components]:
        """The unit vectors of the surfaces, as m components each."""
        return [Components(jnp.asarray(v, self.dtype) for v in row) for row in np.eye(self.m)]


def build(system: System, x0: Array, *, compact: bool, transposed: bool = False) -> ComponentSystem:
    """The components of a system whose float leaves have the dtype of `x0`, shape (n,), for a
    `compact` program or not. `transposed` programs are differentiated in reverse mode; their
    derivatives must be independent of sides that are not taken."""
    check_sharding((system, x0))
    h_shape = check.shapes(system, x0)
    m = 1 if h_shape == () else h_shape[0]
    several = len(x0) > _FEW[compact] and m > _FEW_SURFACES[compact] and not system.resets
    if several or m > _MANY_SURFACES:
        packed = _build(system, x0, compact, transposed, h_shape, packed=True)
        alone = packed.structure.separate and packed.structure.members is not None
        if alone or m > _MANY_SURFACES:
            check_affine(system, packed.structure, m)
            return packed
    return _build(system, x0, compact, transposed, h_shape, packed=False)


def _build(
    system: System,
    x0: Array,
    compact: bool,
    transposed: bool,
    h_shape: tuple[int, ...],
    packed: bool,
) -> ComponentSystem:
    """`build`, with the surfaces as one array if `packed`."""
    n, dtype = x0.shape[0], x0.dtype
    as_array = n > _FEW[compact] or packed
    t0, x = jnp.zeros((), dtype), unpacked(x0, as_array)
    m = 1 if h_shape == () else h_shape[0]
    resets = system.resets and m > 0
    leaves, static = eqx.partition(system, eqx.is_array)
    field, switching, *maps = on_components(static, h_shape, dtype, as_array, packed)
    sides = Components([jnp.ones((m,), dtype)] if packed else (jnp.ones((), dtype),) * m)
    traced = ft.partial(Traced, transposed=transposed, fast=not compact)
    asked = (sides,) if system._observes_mode else ()
    more, when = ((None, *asked) if asked else ()), (FIRST, EARLY, LATE, LATE, LATE, LATE)
    # A slide or a rest stays where a root of H in its field has an infinite slope.
    of_field = ft.partial(traced, bounded=m > 0 and (system.slides or resets))
    traced_field = of_field(field, leaves, t0, x, sides, *more, when=when[: 4 + len(more)])
    traced_switching = traced(switching, leaves, t0, x)
    check_derivatives(vector_field=traced_field, switching=traced_switching)
    check_loops(switching=traced_switching)
    of_numbers = [unpacked(row, as_array) for row in np.eye(n, dtype=bool)]
    of_sides = [Components([row] if packed else row) for row in np.eye(m, dtype=bool)]
    rate = rate_of(field, switching)
    seen, felt, holds_itself = traced_field, None, ()
    if resets and system.feels_reactions:
        at = leaves, t0, x, sides
        seen, felt = reacting(field, of_field, at, asked)
        check_reactions(system, seen, at, asked)
        more = sides, *asked
        second = accelerations(field, rate, traced, at)
        holds_itself = dependencies.of_own_reactions(second, at, of_sides)
    functions = seen, traced_switching
    reacts = felt is not None
    found = dependencies.of(functions, (leaves, t0), of_numbers, of_sides, reacts, more)
    bounds = rounding_of(switching, leaves, t0, x) if m > 0 else None
    traced_bounds = bounds and traced(bounds, leaves, t0, x)
    rate_bounds = rounding_of(rate, leaves, t0, x, sides) if resets else None
    traced_rate_bounds = rate_bounds and traced(rate_bounds, leaves, t0, x, sides)
    clocks = clocks_of(system, dtype)
    there_are = resets, system.ticks and len(clocks) > 0
    reset, tick = (
        traced(function, leaves, t0, x, jnp.int32(0)) if there else None
        for function, there in zip(maps, there_are, strict=True)
    )
    on_cpu = jax.default_backend() == "cpu"
    # In compact programs a sine is one operation, which XLA does not recompute.
    fence = fence_of(leaves, x0) if on_cpu and not compact else None
    return ComponentSystem(
        n=n,
        m=m,
        slides=system.slides and m > 0,
        resets=resets,
        dtype=dtype,
        structure=found,
        compact=compact,
        transposed=transposed,
        as_array=as_array,
        holds_itself=holds_itself,
        packed=packed,
        _field=ParametrizedFunction.of(traced_field, leaves, fence),
        _switching=ParametrizedFunction.of(traced_switching, leaves, fence),
        _felt=felt and ParametrizedFunction.of(felt, leaves, fence),
        _reset=reset and ParametrizedFunction.of(reset, leaves, fence),
        _tick=tick and ParametrizedFunction.of(tick, leaves, fence),
        _rounding=traced_bounds and ParametrizedFunction.of(traced_bounds, leaves, fence),
        _rate_rounding=traced_rate_bounds
        and ParametrizedFunction.of(traced_rate_bounds, leaves, fence),
        clocks=clocks,
        asks_mode=system._observes_mode,
        squares=system._squared,
        _opaque_one=jax.lax.optimization_barrier(jnp.ones((), dtype)) if on_cpu else None,
    )
