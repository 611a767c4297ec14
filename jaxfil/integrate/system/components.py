"""Components: the numbers of a state or of its surfaces, as the loop carries them.

Tuples of scalars, or of one array, enter and leave: sums, choices and the like of them. How a state
is held, and why, says `component_system`.
"""

import abc
import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.xla.select import select

Components = tuple[Array, ...]
"""The components of a vector: n (state) or m (surface) scalars; of a state of many numbers one
array of all of them, (n,)."""
Normals = tuple[Components, ...]
"""The m gradients of H, n components each; of surfaces that are one array their sum, in which each
number is that of one surface."""
Forcing = list[Array]
"""What a field takes of time alone, at one time: see `ComponentSystem.forcing`."""


class SmoothField(eqx.Module):
    """A smooth vector field on components, x' = f(t, x)."""

    @abc.abstractmethod
    def __call__(self, t: Array, x: Components, forcing: Forcing | None = None) -> Components:
        """Its value, given what `ComponentSystem.forcing` has found for that time, if anything."""

    @abc.abstractmethod
    def once(self, function: Callable, *args: Any) -> Any:
        """As `ComponentSystem.once`."""


def scalars(x: Array) -> Components:
    """The numbers of an (n,) array, of the modes of m surfaces say."""
    return tuple(x[i] for i in range(x.shape[0]))


def pack(components: Components, dtype: Any) -> Array:
    """The (n,) array of components; of shape (0,) and the given dtype if there are none."""
    if not components:
        return jnp.zeros((0,), dtype)
    return components[0] if is_array(components) else jnp.stack(components)


def is_array(x: Components) -> bool:
    """Whether a state, or what there is of each surface, is one array."""
    return len(x) == 1 and x[0].ndim > 0


def number(x: Components, i: int) -> Array:
    """Number i of components, of a state or of one for each surface."""
    return x[0][i] if is_array(x) else x[i]


def dot(a: Components, b: Components) -> Any:
    """Σ a·b, over all numbers of two states."""
    return sum(_total(u * v) for u, v in zip(a, b, strict=True))


def _total(v: Array) -> Array:
    return v if v.ndim == 0 else jnp.sum(v)


def axpy(x: Components, h: Array, f: Components) -> Components:
    """x + h f."""
    return tuple(a + h * b for a, b in zip(x, f, strict=True))


def where(condition: Array, a: Components, b: Components) -> Components:
    """Componentwise choice between two vectors."""
    return tuple(select(condition, u, v) for u, v in zip(a, b, strict=True))


def least(v: Array) -> Array:
    """The least number of a component."""
    return v if v.ndim == 0 else jnp.min(v)


def total(components: Components) -> Any:
    """The sum of all numbers of all components."""
    return sum(map(_total, components))


def any_of(flags: Components) -> Array:
    """Whether any of the flags is set; False if there are none."""
    total = jnp.zeros((), bool)
    for flag in flags:
        total = total | (flag if flag.ndim == 0 else jnp.any(flag))
    return total


def all_finite(*vectors: Components) -> Array:
    """Whether all components of all vectors are finite."""
    total: Any = 0.0
    for component in stop_gradient([*itertools.chain(*vectors)]):
        total = total + _total(component * 0)  # NaN and inf both give NaN: one test for all
    return jnp.asarray(total == 0)
