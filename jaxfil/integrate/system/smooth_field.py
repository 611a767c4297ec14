"""`SmoothField`: a vector field between two contacts, and its motion as a `Polynomial` in time."""

import abc
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
from jaxtyping import Array

from jaxfil.integrate.system.components import Components, Forcing
from jaxfil.xla.select import select


class SmoothField(eqx.Module):
    """A smooth vector field on components, x' = f(t, x)."""

    @abc.abstractmethod
    def __call__(self, t: Array, x: Components, forcing: Forcing | None = None) -> Components:
        """f(t, x); `forcing` is the value of `ComponentSystem.forcing` at this time."""

    @abc.abstractmethod
    def once(self, function: Callable, *args: Any) -> Any:
        """The same as `ComponentSystem.once`."""

    @abc.abstractmethod
    def polynomial(
        self, order: int, t: Array, x: Components, h: Array, kinks: bool = False
    ) -> "Polynomial":
        """The motion in a step of length h, as a power series of the given order, perhaps with the
        `kinks` of the field."""


class Polynomial(eqx.Module):
    """A motion within a step of length h, as a power series in the elapsed fraction s of the step,
    x(t + s h) = Σ_k x_k s^k."""

    h: Array
    x: tuple[Components, ...]
    """States, n components, orders 0 to p."""
    guards: tuple[Components, ...]
    """The guards of the mode, m components, orders 0 to p."""
    ends: Array
    """Whether the series is right only at the end of the step, and its guards are unknown."""
    kinks: tuple[Array, ...] | None = None
    """What is compared in the field, positive just after the start, orders 0 to p; None without
    any, or if not asked for."""

    def at(self, s: Array) -> Components:
        """The state at a fraction s of the step."""
        return horner(self.x, s)

    def rate_at(self, s: Array) -> Components:
        """dx/dt at a fraction s of the step; zero in a step of length zero."""
        _, *slopes = (float(k) * c for k, c in enumerate(self.x))
        # Switches take steps of length zero, in which the slopes h f_k/(k + 1) are zero too.
        stays = self.h == 0
        return select(stays, 0.0, 1 / select(stays, 1.0, self.h)) * horner(slopes, s)


def horner(coefficients: Sequence[Any], s: Array) -> Any:
    """Σ_k c_k s^k."""
    *lower, value = coefficients
    for c in reversed(lower):
        value = c + s * value
    return value
