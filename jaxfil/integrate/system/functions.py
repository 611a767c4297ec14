"""The user's functions as functions of array leaves and of components.

These are functions that `xla.trace` can trace, made from a `System` without its arrays. For fields
that depend on reactions there are two more, the part added by reactions and the second derivative
of H.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.system.components import Components, Forcing, pack, scalars
from jaxfil.model import check
from jaxfil.model.system import System, field_of
from jaxfil.xla.select import select
from jaxfil.xla.series import Expansion, Series
from jaxfil.xla.trace import Traced


class ParametrizedFunction(eqx.Module):
    """One of the user's functions, on components, with its parameters."""

    # The program is static and its parameters are not, so that new values compile no new program.
    traced: Traced = eqx.field(static=True)
    parameters: Any
    """The array leaves, after the traced numbers that the function closes over."""
    fence: Array | None

    @staticmethod
    def of(traced: Traced, leaves: Any, fence: Array | None) -> "ParametrizedFunction":
        """A function traced for these leaves."""
        return ParametrizedFunction(traced, (traced.closed_over, leaves), fence)

    def __call__(self, *args: Any, **options: Any) -> Any:
        return self.traced(self.parameters, *args, fence=self.fence, **options)

    def ahead(self, t: Array) -> Forcing:
        """The values of its expensive operations on time alone."""
        return self.traced.ahead(self.parameters, t)

    def expanded(self, expansion: Expansion, *args: Any) -> list[Any]:
        """Power series of its results, given series of its arguments or constants."""
        return self.traced.expanded(expansion, self.parameters, *args)

    def expanded_rate(
        self, expansion: Expansion, t: Series, x: list[Any], along: list[Any]
    ) -> list[Any]:
        """Power series of the rate of change of its results along a direction."""
        return self.traced.expanded_rate(expansion, self.parameters, [t, *x], along)


def unpacked(numbers: Any, as_array: bool) -> Components:
    """The components of a state given as an (n,) array."""
    return Components([numbers] if as_array else scalars(numbers))


def on_components(
    static: System, h_shape: tuple[int, ...], dtype: Any, as_array: bool, packed: bool
) -> tuple[Callable, Callable, Callable, Callable]:
    """The field, the switching function, the reset and the map of ticks of a system as functions of
    its array leaves and of components."""
    m = 1 if h_shape == () else h_shape[0]

    def of_surfaces(numbers: Components) -> Array:
        # A scalar H has a scalar side.
        return numbers.parts[0] if h_shape == () else pack(numbers, dtype)

    def field(
        leaves: System,
        t: Array,
        x: Components,
        sides: Components,
        reaction: Components | None = None,
        mode: Components | None = None,
    ) -> Components:
        # None stays None. A vector of components is always true, even one of zeros.
        given = (v and of_surfaces(v) for v in (reaction, mode))
        f = field_of(eqx.combine(leaves, static), t, pack(x, dtype), of_surfaces(sides), *given)
        return unpacked(f, as_array)

    def switching(leaves: System, t: Array, x: Components) -> Components:
        h = eqx.combine(leaves, static).switching(t, pack(x, dtype))
        # H of one surface may be a scalar.
        h = jnp.reshape(h, (m,))
        return Components([h] if packed else scalars(h))

    def reset(leaves: System, t: Array, x: Components, surface: Array) -> Components:
        return unpacked(eqx.combine(leaves, static).reset(t, pack(x, dtype), surface), as_array)

    def tick(leaves: System, t: Array, x: Components, clock: Array) -> Components:
        return unpacked(eqx.combine(leaves, static).tick(t, pack(x, dtype), clock), as_array)

    return field, switching, reset, tick


def reacting(
    field: Callable, traced: Callable[..., Traced], at: tuple[Any, ...], asked: tuple[Any, ...]
) -> tuple[Traced, Traced]:
    """A field that depends on reactions, as a function `(leaves, t, x, sides, reaction, *asked)`,
    and the part of the field that reactions add, as a function of the same arguments."""

    def felt(leaves: System, t: Array, x: Components, sides: Components, *given: Any) -> Components:
        reaction, *asked = given
        # The field is affine in reactions, so its derivative at zero along them is that part.

        def of_reaction(reaction: Components) -> Components:
            return field(leaves, t, x, sides, reaction, *asked)

        return jax.jvp(of_reaction, (0.0 * reaction,), (reaction,))[1]

    # Reactions have the form of the sides, the last of `at`, with one number for each surface.
    given = *at, at[-1], *asked
    return traced(field, *given), traced(felt, *given)


def rate_of(field: Callable, switching: Callable) -> Callable:
    """dH/dt along a field without reactions, as a function `(leaves, t, x, sides)`."""

    def rate(leaves: System, t: Array, x: Components, sides: Components) -> Components:
        along = jnp.ones_like(t), field(leaves, t, x, sides)
        return jax.jvp(ft.partial(switching, leaves), (t, x), along)[1]

    return rate


def accelerations(
    field: Callable, rate: Callable, traced: Callable[..., Traced], at: tuple[Any, ...]
) -> Traced:
    """d²H/dt² along a field that depends on reactions, as a function of the same arguments, given
    `rate_of`."""

    def second(leaves: System, t: Array, x: Components, sides: Components, reaction: Any) -> Any:
        # dH/dt is a function of the field without reactions. Only its change along the motion
        # includes them.
        along = jnp.ones_like(t), field(leaves, t, x, sides, reaction)
        return jax.jvp(lambda t, x: rate(leaves, t, x, sides), (t, x), along)[1]

    return traced(second, *at, at[-1])


def clocks_of(system: System, dtype: Any) -> tuple[tuple[Array, Array], ...]:
    """Periods and phases of a system's clocks."""
    pairs = [(clock.period, clock.phase) for clock in check.clocks(system)]
    return tuple((jnp.asarray(a, dtype), jnp.asarray(b, dtype)) for a, b in pairs)


def size_of_time(clocks: Sequence[tuple[Array, Array]], t: Array) -> Array:
    """A number of the size that the rounding of t is proportional to. With clocks it includes the
    phases, which may be much larger than times, in ticks φ + kT as well as in a field's own t − φ.
    """
    if not clocks:
        return t
    return abs(t) + ft.reduce(jnp.maximum, (abs(phase) for _, phase in clocks))


def fence_of(leaves: Any, x0: Array) -> Array:
    """The number 1, opaque to the compiler and different for each lane, that sines are divided by.
    XLA removes a conditional around a single sine (`ComponentSystem.once`) but keeps a division."""
    numbers = [v for v in jax.tree.leaves((leaves, x0)) if v.dtype == x0.dtype and v.size]
    firsts = [jnp.ravel(v)[0] for v in jax.lax.stop_gradient(numbers)]
    never = sum(firsts) == jnp.finfo(x0.dtype).max
    return select(never, 2.0, 1.0).astype(x0.dtype)
