"""Traced numbers that the functions of a system close over, as parameters of the system.

A rule for derivatives and a loop outside of all transformations see the leaves of a system alone. A
number that `jax.grad` or `jax.vmap` traces, and that a function of the system uses without it being
a leaf, would escape from them.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.model import check
from jaxfil.model.clock import Clock, Clocks
from jaxfil.model.system import System, field_of
from jaxfil.model.wrapped import Wrapped
from jaxfil.xla.known import is_known, is_outside
from jaxfil.xla.program import operations, with_traced_values


class _Opened(Wrapped):
    """A system whose functions have the traced numbers of their closures as leaves."""

    closed: dict[str, tuple[Array, ...]]
    """The numbers of each function that closes over any."""
    _programs: tuple[tuple[str, Any, Any], ...] = eqx.field(static=True)
    """The names of these functions, their programs and the trees of their results."""

    def _of(self, name: str, *args: Any) -> Any:
        leaves = jax.tree.leaves((eqx.filter(self.system, eqx.is_array), args))
        for known, program, tree in self._programs:
            if known == name:
                out = operations(program)(*self.closed[name], *map(jnp.asarray, leaves))
                return jax.tree.unflatten(tree, out)
        return _functions(self.system)[name](*args)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "system":
            raise AttributeError(name)
        return getattr(self.system, name)  # a parameter, or what else the class has

    def vector_field(self, t: Array, x: Array, side: Array, reaction: Array | None = None) -> Array:
        return self._of("vector_field", t, x, side, *(() if reaction is None else (reaction,)))

    def switching(self, t: Array, x: Array) -> Array:
        return self._of("switching", t, x)

    def reset(self, t: Array, x: Array, surface: Array) -> Array:
        return self._of("reset", t, x, surface)

    def tick(self, t: Array, x: Array, clock: Array) -> Array:
        return self._of("tick", t, x, clock)

    @property
    def period(self) -> Array | float | None:
        return self._of("period")

    @property
    def clocks(self) -> Clocks:
        return tuple(Clock(*pair) for pair in self._of("clocks"))

    @property
    def state_names(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.state_names

    @property
    def units(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.units


def _functions(system: System) -> dict[str, Callable[..., Any]]:
    """All functions of a system, by name."""

    def field(t: Array, x: Array, side: Array, reaction: Array | None = None) -> Array:
        return field_of(system, t, x, side, reaction)

    return {
        "vector_field": field,
        "switching": system.switching,
        "reset": system.reset,
        "tick": system.tick,
        "period": lambda: system.period,
        "clocks": lambda: [(clock.period, clock.phase) for clock in system.clocks],
    }


def with_closed_numbers(system: System, x: Array) -> System:
    """The system of states like x, with the traced numbers that its functions close over as leaves;
    the same one if they close over known numbers alone."""
    if is_outside():
        return system
    side = jnp.ones(check.shapes(system, x), x.dtype)
    t, one = jnp.zeros((), x.dtype), jnp.zeros((), jnp.int32)
    felt = (side,) if system.feels_reactions else ()
    args = {"vector_field": (t, x, side, *felt), "switching": (t, x), "period": (), "clocks": ()}
    args |= {"reset": (t, x, one)} if system.resets else {}
    args |= {"tick": (t, x, one)} if system.ticks else {}
    leaves, rest = eqx.partition(system, eqx.is_array)
    closed, programs = {}, []
    for name, given in args.items():

        def function(leaves: Any, given: tuple, name: str = name) -> Any:
            return _functions(eqx.combine(leaves, rest))[name](*given)

        program, shapes = jax.make_jaxpr(function, return_shape=True)(leaves, given)
        if not is_known(program.consts):
            program, closed[name] = with_traced_values(program)
            programs.append((name, program, jax.tree.structure(shapes)))
    return _Opened(system, closed, tuple(programs)) if closed else system
