"""Means of a rate over batches of time, with what their scatter tells.

How much a logarithm has grown in each batch enters; the mean rate, its running estimates, its
standard error, and whether it was the rate of one motion throughout, leave.
"""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.model.card import outcome, precision

# An average is taken in this many batches, between which the lanes of a computation wait.
BATCHES = 32
# A change of the mean by this many standard errors is a change of the motion: with 32 batches and
# Gaussian noise one exponent in some thousands has such a change by chance.
_CHANGE = 5.0


def batch_ends(periods: Array, batches: int) -> Array:
    """Periods done at the end of each batch, as equal as whole numbers can be."""
    k = jnp.arange(1, batches + 1, dtype=periods.dtype)
    whole, rest = periods // batches, periods % batches
    return k * whole + k * rest // batches


def averages(growth: Array, times: Array) -> tuple[Array, Array, Array, Array]:
    """Means, running means, standard errors and steadiness of growth (batches, k) up to `times`."""
    running_ = jnp.cumsum(growth, axis=0) / times[:, None]
    return running_[-1], running_, _standard_error(growth, times), _settled(growth, times)


def _standard_error(growth: Array, times: Array) -> Array:
    """Of the mean rate, from the scatter of the batches' rates; 0 where it is −inf."""
    batches = growth.shape[0]
    if batches == 1:
        return jnp.full_like(growth[0], jnp.nan)
    lasting = jnp.diff(times, prepend=0.0)
    finite = jnp.where(growth == -jnp.inf, 0.0, growth)
    mean = jnp.sum(finite, axis=0) / times[-1]
    scatter = jnp.sum((finite - mean * lasting[:, None]) ** 2, axis=0)
    error = jnp.sqrt(scatter * batches / (batches - 1)) / times[-1]
    return jnp.where(jnp.any(growth == -jnp.inf, axis=0), 0.0, error)


def _settled(growth: Array, times: Array) -> Array:
    """Whether no split of the batches into early and late ones shows two different means.

    The means of the two parts are compared with the scatter within them (Student's t, the largest
    over all splits). What the shorter part has more or less grown by the end must also matter: a
    factor below e is how every exponent begins. Batches in which a direction was lost, and those in
    which none was, are compared in the same way, and each matters.
    """
    known = ~jnp.any(jnp.isnan(growth))
    if growth.shape[0] < 3:
        return known
    lost = growth == -jnp.inf
    lasting = jnp.diff(times, prepend=0.0)[:, None]
    rates = jnp.where(lost, 0.0, growth) / lasting
    changes = _changes(rates, 1 / jnp.mean(lasting)) | _changes(lost.astype(growth.dtype), 0.5)
    return known & ~jnp.any(changes)


def _changes(values: Array, least: Array | float) -> Array:
    """Whether the mean of values (batches, k) changes at some split by more than their scatter
    explains, and by more than `least` over the number of batches in the shorter part."""
    batches = values.shape[0]
    k = np.arange(1, batches)
    early = jnp.asarray(np.tril(np.ones((batches - 1, batches))), values.dtype)  # a row: a split
    early_mean = early @ values / jnp.asarray(k[:, None], values.dtype)
    late_mean = (1 - early) @ values / jnp.asarray(batches - k[:, None], values.dtype)
    mean = jnp.where(early[..., None] > 0, early_mean[:, None], late_mean[:, None])
    variance = jnp.sum((values - mean) ** 2, axis=1) / (batches - 2)
    weight = jnp.asarray(1 / k + 1 / (batches - k), values.dtype)[:, None]
    shorter = jnp.asarray(np.minimum(k, batches - k)[:, None], values.dtype)
    difference = abs(early_mean - late_mean)
    beyond_chance = difference > _CHANGE * jnp.sqrt(variance * weight)
    return jnp.any(beyond_chance & (difference * shorter > least), axis=0)


def average_card(name: str, found: Any, exponents: Any, errors: Any) -> str:
    """What was averaged, over how long, and whether it is to be trusted, in a few lines."""
    name += precision(found.x0)
    if isinstance(found.result._value, jax.core.Tracer) or found.times.ndim > 1:
        return f"{name}: a batch of shape {found.times.shape[:-1]}"
    numbers, spreads = np.atleast_1d(exponents), np.atleast_1d(errors)
    pairs = zip(numbers, spreads, strict=True)
    told = ", ".join(f"{a:.5g} ± {b:.1g}" if np.isfinite(a) else f"{a}" for a, b in pairs)
    state = np.array2string(np.asarray(found.x0), precision=6, separator=", ")
    lines = [
        f"{name}: {outcome(found.result)}",
        f"  {told} per unit time, over a time of {float(found.times[-1]):.6g} from x0 = {state}",
    ]
    if not found.settled:
        lines.append(
            "  not settled: the growth changed for good on the way; take a longer transient"
        )
    return "\n".join(lines)
