"""Averages of a lane over its samples: means, root mean squares, extremes, sums over events.

Means are integrals carried with the state, as in `average`; the other quantities are extensions of
the loop.
"""

import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.lane.extension import Extension
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.loop.event_sums import Sums, event_sums
from jaxfil.integrate.loop.extremes import Extremes, SoFar
from jaxfil.integrate.loop.long_integrals import LongIntegrals
from jaxfil.integrate.loop.window import Window
from jaxfil.integrate.run.observed import Observable, OfState, checked_observable, with_rate
from jaxfil.integrate.system.lowered import ComponentSystem, build
from jaxfil.model import check
from jaxfil.model.argument import signature_of
from jaxfil.model.parameter import cast
from jaxfil.model.quantity import KINDS, RMS, EventSum, Maximum, Minimum, Quantity
from jaxfil.model.section import Section
from jaxfil.model.system import System
from jaxfil.xla.select import select

_EXTREMES = Maximum, Minimum
# The name of a single quantity whose function has no name.
_ALONE = "average"


class _OfSystem(eqx.Module):
    """A user's function that takes the system of its lane."""

    function: Callable[..., Any]
    system: System

    def __call__(self, *args: Any) -> Any:
        # By name, since `system` may be an argument at any position.
        named = dict(zip(self.__signature__.parameters, args, strict=False))
        return self.function(**named, system=self.system)

    @property
    def __signature__(self) -> inspect.Signature:
        # Without `system`, for functions that look at the names of the arguments (`asked_of`).
        own = inspect.signature(self.function)
        return own.replace(parameters=[v for k, v in own.parameters.items() if k != "system"])


def _with_system(function: Callable[..., Any], system: System) -> Callable[..., Any]:
    """A user's function with the system of its lane bound, if it takes one."""
    signature = signature_of(function)
    asks = signature is not None and "system" in signature.parameters
    # A function that closes over a system instead would not see its parameters swept.
    return _OfSystem(function, system) if asks else function


class _Row(eqx.Module):
    """Functions of the states before and after an event, combined into one that returns all their
    numbers in one array. States may have more components at the end."""

    functions: tuple[Callable[..., Any], ...]
    n: int = eqx.field(static=True)

    def __call__(self, t: Array, before: Array, after: Array, surfaces: Array) -> Array:
        at = t, before[: self.n], after[: self.n], surfaces
        return jnp.concatenate([jnp.ravel(jnp.asarray(f(*at), t.dtype)) for f in self.functions])


class _Zeros(eqx.Module):
    """The rate of numbers that only change between steps."""

    k: int = eqx.field(static=True)

    def __call__(self, t: Array, x: Array) -> Array:
        return jnp.zeros((self.k,), x.dtype)


class Averaged(eqx.Module):
    """A quantity to be averaged."""

    quantity: Quantity
    name: str = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    """The shape of its function's result."""

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return math.prod(self.shape)

    @property
    def columns(self) -> list[str]:
        """The names of its numbers."""
        names = [f"{self.name}[{i}]" for i in range(self.size)]
        return names if self.shape else [self.name]

    @property
    def is_integral(self) -> bool:
        """Whether it is an integral carried behind the state."""
        return not isinstance(self.quantity, (*_EXTREMES, EventSum))

    def function(self, system: System) -> Callable[..., Any]:
        """Its function for lanes of a system."""
        return _with_system(_function_of(self.quantity), system)

    def observed(self, function: Callable[..., Any], n: int) -> Observable:
        """A function of its shape, of states of which the first n components are the motion's."""
        return Observable(OfState(function, n), self.shape)


class Averaging(eqx.Module):
    """The quantities of a lane."""

    each: tuple[Averaged, ...]
    h_shape: tuple[int, ...] = eqx.field(static=True)
    """The shape of `System.switching`."""
    n: int = eqx.field(static=True)
    """The number of components of a state."""
    resolves: bool = eqx.field(static=True)
    """Whether the functions of extremes are integrated too, so that the steps of a tolerance
    resolve them: while a mass sticks the state is exact in any step, and its force is not."""
    lasting: bool = eqx.field(static=True)
    """Whether integrals go on for the whole run, and each is two numbers (`long_integrals`)."""

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of all numbers, in order."""
        return tuple(column for one in self.each for column in one.columns)

    @property
    def integrals(self) -> int:
        """The number of integrals carried behind the state."""
        return sum(one.size for one in self._integrated)

    @property
    def _integrated(self) -> list[Averaged]:
        """The integrals in order, followed by the extremes that are integrated too."""
        found = [one for one in self.each if one.is_integral]
        extremes = [one for one in self.each if isinstance(one.quantity, _EXTREMES)]
        return found + extremes if self.resolves else found

    def named(self, row: Any) -> dict[str, Any]:
        """The quantities as arrays, from an array with all their numbers along the last axis."""
        found, start = {}, 0
        for one in self.each:
            numbers = row[..., start : start + one.size]
            found[one.name] = numbers.reshape(*row.shape[:-1], *one.shape)
            start += one.size
        return found

    def carried(self, system: System, x: Array) -> tuple[System, Array]:
        """A system that carries the integrals behind its state, and that state: x and zeros."""
        wider = system
        for one in self._integrated:
            # Each integral is one more component at the end, of a function of the first n. A
            # square is taken of the value along the motion, which is the holding force of a brake,
            # whose values on both sides have the same square.
            rate, squared = one.function(system), isinstance(one.quantity, RMS)
            wider, x = with_rate(wider, one.observed(rate, self.n), x, squared=squared)
        if self.lasting and self.integrals > 0:
            still = Observable(_Zeros(self.integrals), (self.integrals,))
            wider, x = with_rate(wider, still, x)
        return wider, x

    def since(self, states: Array) -> Array:
        """The integrals from the first of states that carry them to the last one, in a run in which
        they are `lasting`."""
        changes = states[-1] - states[0]
        return changes[self.n : self.n + self.integrals] + changes[self.n + self.integrals :]

    def section(self, section: Section) -> Section:
        """A section of states that carry integrals."""
        return eqx.tree_at(lambda s: s.function, section, OfState(section.function, self.n))

    def extensions(
        self,
        system: System,
        field: ComponentSystem,
        x: Array,
        first: Array,
        transposed: bool = False,
    ) -> tuple[Extension, ...]:
        """The extensions for lanes of a system whose `field` carries the integrals, from states
        like x with these. The span of the averages starts at grid point number `first`, or at this
        crossing of the section. `found` is differentiated in reverse mode if `transposed`."""
        window = Window(first)
        found: list[Extension] = []
        if self.lasting and self.integrals > 0:
            found.append(LongIntegrals(self.integrals))
        # Extremes have a wider system of their own. Their functions are evaluated and not
        # integrated, so the lane does not carry them.
        wider, start, signs, sums, count = system, x[: self.n], [], [], 0
        for one in self.each:
            if isinstance(one.quantity, _EXTREMES):
                wider, start = with_rate(wider, one.observed(one.function(system), self.n), start)
                signs += [1.0 if isinstance(one.quantity, Maximum) else -1.0] * one.size
            elif isinstance(one.quantity, EventSum):
                sums, count = [*sums, one.function(system)], count + one.size
        if signs:
            rates = build(wider, start, compact=field.compact, transposed=transposed)
            found.append(Extremes(rates, self.n, tuple(signs), window))
        if sums:
            row = _Row(tuple(sums), self.n)
            found.append(event_sums(row, count, field, x, self.h_shape, window))
        return tuple(found)

    def found(self, problem: Problem, own: tuple[SoFar | Sums, ...], means: Array) -> Array:
        """All numbers of a lane in one array, from the states of these extensions at its end and
        the means of the integrals."""
        extremes = sums = jnp.zeros((0,), means.dtype)
        for state in own:
            if isinstance(state, Sums):
                sums = jnp.stack(state.numbers.parts)
            else:
                (extension,) = (e for e in problem.extensions if isinstance(e, Extremes))
                extremes = extension.found(problem, state)
        rows = []
        for one in self.each:
            size = one.size
            if isinstance(one.quantity, _EXTREMES):
                # Each kind has its numbers in the order of its quantities.
                row, extremes = extremes[:size], extremes[size:]
            elif isinstance(one.quantity, EventSum):
                row, sums = sums[:size], sums[size:]
            else:
                row, means = means[:size], means[size:]
                # The mean is of the square.
                row = _root(row) if isinstance(one.quantity, RMS) else row
            rows.append(row)
        return jnp.concatenate(rows)


def _root(square: Array) -> Array:
    """The square root, whose derivative is 0 at a square of zero, and not 0/0."""
    zero = square == 0
    return select(zero, 0.0, jnp.sqrt(select(zero, 1.0, square)))


def averages_in(state: LoopState) -> tuple[SoFar | Sums, ...]:
    """The states of the extensions of averages, at the end of a lane or of many."""
    return tuple(v for v in state.extensions if isinstance(v, (SoFar, Sums)))


def checked_averaging(
    name: str, given: Any, system: System, x: Array, *, resolves: bool, lasting: bool
) -> Averaging:
    """The quantities in the argument `name`, for runs from a state like x; `resolves` and `lasting`
    as in `Averaging`."""
    several = isinstance(given, Mapping)
    quantities = dict(given) if several else {_name_of(given): given}
    # Results are indexed by these names, which are also the names of columns.
    if not quantities or not all(isinstance(key, str) and key for key in quantities):
        raise ValueError(
            f"`{name}` must be a function of (t, x, side), a quantity such as jaxfil.RMS, or a "
            f"dictionary of these by their names, got {check.told(given)}."
        )
    h_shape, each = check.shapes(system, x), []
    for key, quantity in quantities.items():
        where = f"{name}[{key!r}]" if several else name
        shape = _checked(where, quantity, system, x, h_shape)
        each.append(Averaged(cast(quantity, x.dtype), key, shape))
    return Averaging(tuple(each), h_shape, x.shape[0], resolves, lasting)


def _function_of(quantity: Any) -> Any:
    return quantity.function if isinstance(quantity, KINDS) else quantity


def _name_of(quantity: Any) -> str:
    """The name of a single quantity."""
    function = _function_of(quantity)
    name = getattr(function, "__name__", type(function).__name__)
    return _ALONE if name == "<lambda>" else name


def _checked(
    name: str, quantity: Any, system: System, x: Array, h_shape: tuple[int, ...]
) -> tuple[int, ...]:
    """The shape of the result of a quantity's function."""
    function = check.function(name, _function_of(quantity), "(t, x, side)")
    function = _with_system(cast(function, x.dtype), system)
    if not isinstance(quantity, EventSum):
        return checked_observable(name, function, system, x).shape
    # Flags of surfaces are passed as numbers of the run's precision (`event_sums`).
    given = {"before": x, "after": x, "surfaces": jnp.ones(h_shape, x.dtype)}
    out = check.returned(f"`{name}`", function, "", t=jnp.zeros((), x.dtype), **given)
    if isinstance(out, (int, float)):  # a Python number such as 1.0, which counts events
        return ()
    return check.real_shape(name, out)
