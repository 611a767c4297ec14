"""`FourierOrbit`: a periodic orbit as a Fourier series. Phases φ = t/T range from 0 to 1."""

import functools as ft

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfil.model.card import outcome, precision
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.types import Scalar
from jaxfil.xla.select import select


class FourierOrbit(eqx.Module):
    """A periodic orbit as a Fourier series, x(t) = c₀ + Σ_k a_k cos kωt + b_k sin kωt."""

    coefficients: Float[Array, "k n"]
    """c₀, a₁, b₁, a₂, b₂, …, shape (2K + 1, n)."""
    period: Float[Array, ""]
    """The period, 2π/ω."""
    residual: Float[Array, ""]
    """The largest residual of Galerkin's equations, relative to the size of ẋ."""
    result: RESULTS
    """The outcome of the search."""
    num_steps: Int[Array, ""]
    """Number of evaluations of the residual by Newton's method."""

    @property
    def harmonics(self) -> int:
        """K, the number of the highest harmonic."""
        return (self.coefficients.shape[-2] - 1) // 2

    @property
    def amplitudes(self) -> Float[Array, "k n"]:
        """√(a_k² + b_k²) of every harmonic, from 0 (|c₀|) to K, shape (K + 1, n)."""
        return _amplitudes(self.coefficients)

    def evaluate(self, t: Scalar) -> Float[Array, " n"]:
        """The state at a time, shape (n,)."""
        t = jnp.asarray(t, self.coefficients.dtype)
        return _series_at(t, self.period, self.coefficients)

    def __repr__(self) -> str:
        *batch, _, n = self.coefficients.shape
        told = precision(self.coefficients)
        if isinstance(self.coefficients, jax.core.Tracer) or batch:
            shape = tuple(batch)
            return f"FourierOrbit{told}: a batch of shape {shape}, {self.harmonics} harmonics"
        return (
            f"FourierOrbit{told}: {outcome(self.result)}\n  {self.harmonics} harmonics of "
            f"{n} components, period {float(self.period):.12g}, residual "
            f"{float(self.residual):.1e} after {int(self.num_steps)} Newton steps"
        )


@jax.jit
def _amplitudes(c: Array) -> Array:
    pairs = jnp.sqrt(c[..., 1::2, :] ** 2 + c[..., 2::2, :] ** 2)
    return jnp.concatenate([abs(c[..., :1, :]), pairs], axis=-2)


@jax.jit
def _series_at(t: Array, period: Array, c: Array) -> Array:
    return waves_at(t / period, (c.shape[-2] - 1) // 2) @ c


def equal_phases(count: int, dtype: jnp.dtype) -> np.ndarray:
    """Phases that are equally spaced in a period."""
    return np.arange(count, dtype=dtype) / np.asarray(count, dtype)


@ft.partial(jax.jit, static_argnames="harmonics")
def project(phases: Array, values: Array, harmonics: int) -> Array:
    """The coefficients of a series through samples at equally spaced phases."""
    basis = jax.vmap(ft.partial(waves_at, harmonics=harmonics))(phases)
    # The mean of a squared wave is one half; for the constant it is one.
    norm = select(jnp.arange(2 * harmonics + 1) == 0, 1.0, 2.0).astype(values.dtype)
    return norm[:, None] * (basis.T @ values) / phases.shape[0]


def waves_at(phase: Array, harmonics: int) -> Float[Array, " k"]:
    """The waves 1, cos 2πφ, sin 2πφ, cos 4πφ, … at a phase φ, shape (2K + 1,)."""
    angles = 2 * jnp.pi * phase * jnp.arange(1, harmonics + 1).astype(phase.dtype)
    waves = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1).reshape(-1)
    return jnp.concatenate([jnp.ones((1,), phase.dtype), waves])


def slope_of(c: Array, harmonics: int) -> Array:
    """The coefficients of dx/dφ."""
    k = 2 * jnp.pi * jnp.arange(1, harmonics + 1).astype(c.dtype)[:, None]
    waves = jnp.stack([k * c[2::2], -k * c[1::2]], axis=1).reshape(-1, c.shape[1])
    return jnp.concatenate([jnp.zeros_like(c[:1]), waves])
