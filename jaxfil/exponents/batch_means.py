"""Means of a rate over batches of time, with standard errors from their scatter."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.xla.select import select

# Number of batches of an average; the lanes of a computation wait for each other between batches.
# Few batches are long, and long ones are independent, as the standard error requires.
BATCHES = 32
# A change of the mean by this many standard errors is a change of the motion. With 32 batches and
# Gaussian noise this happens by chance for one exponent in some thousands.
_CHANGE = 5.0


def batch_ends(periods: Array, batches: int) -> Array:
    """Number of periods at the end of each batch, as equal as integers can be."""
    # k·periods // batches would overflow in 32 bits; separate quotient and remainder do not.
    k = jnp.arange(1, batches + 1, dtype=periods.dtype)
    whole, rest = periods // batches, periods % batches
    return k * whole + k * rest // batches


def averages(growth: Array, times: Array) -> tuple[Array, Array, Array, Array]:
    """Means, running means, standard errors and steadiness of growth (batches, k) up to `times`."""
    batches = growth.shape[0]
    running_ = _sums(np.tri(batches, dtype=bool), growth) / times[:, None]
    return running_[-1], running_, _standard_error(growth, times), _settled(growth, times)


def _sums(of: np.ndarray, values: Array) -> Array:
    """The sums of the rows of values (b, k) that are true in a row of `of` (c, b), shape (c, k);
    rows outside every sum may be infinite. A matrix product would end a kernel."""
    return jnp.sum(select(jnp.asarray(of)[..., None], values, 0), axis=1)


def _standard_error(growth: Array, times: Array) -> Array:
    """The standard error of the mean rate, from the scatter of the batches; 0 for −inf."""
    batches = growth.shape[0]
    if batches == 1:
        return jnp.full_like(growth[0], jnp.nan)
    # Batches may differ by a period in length. Each is compared with the growth of the mean rate in
    # its own time.
    lasting = jnp.diff(times, prepend=0.0)
    finite = select(growth == -jnp.inf, 0.0, growth)
    mean = jnp.sum(finite, axis=0) / times[-1]
    scatter = jnp.sum((finite - mean * lasting[:, None]) ** 2, axis=0)
    error = jnp.sqrt(scatter * batches / (batches - 1)) / times[-1]
    return select(jnp.any(growth == -jnp.inf, axis=0), 0.0, error)


def _settled(growth: Array, times: Array) -> Array:
    """Whether no split of the batches into early and late ones shows two different means.

    The means of the two parts are compared with the scatter within them (Student's t, the largest
    over all splits). The excess growth of the shorter part must also be significant, because every
    exponent begins with a factor below e. Batches with and without a lost direction are compared in
    the same way.
    """
    known = ~jnp.any(jnp.isnan(growth))
    if growth.shape[0] < 3:
        return known
    # A growth of −inf has no mean; its frequency is compared instead of its size.
    lost = growth == -jnp.inf
    lasting = jnp.diff(times, prepend=0.0)[:, None]
    rates = select(lost, 0.0, growth) / lasting
    changes = _changes(rates, 1 / jnp.mean(lasting)) | _changes(lost.astype(growth.dtype), 0.5)
    # NaN in one batch marks a failed lane, whose motion is unknown.
    return known & ~jnp.any(changes)


def _changes(values: Array, least: Array | float) -> Array:
    """Whether the mean of values (batches, k) changes at some split by more than their scatter
    explains, and by more than `least` over the number of batches in the shorter part."""
    batches = values.shape[0]
    # All splits at once, one per row; triangular masks select either side.
    k = np.arange(1, batches)
    early = np.tri(batches - 1, batches, dtype=bool)  # a row: a split
    early_mean = _sums(early, values) / jnp.asarray(k[:, None], values.dtype)
    late_mean = _sums(~early, values) / jnp.asarray(batches - k[:, None], values.dtype)
    mean = select(jnp.asarray(early)[..., None], early_mean[:, None], late_mean[:, None])
    # Two means were taken from the batches, which leave this many degrees of freedom.
    variance = jnp.sum((values - mean) ** 2, axis=1) / (batches - 2)
    weight = jnp.asarray(1 / k + 1 / (batches - k), values.dtype)[:, None]
    shorter = jnp.asarray(np.minimum(k, batches - k)[:, None], values.dtype)
    # The largest t over all splits exceeds a single one by chance; `_CHANGE` allows for it.
    difference = abs(early_mean - late_mean)
    beyond_chance = difference > _CHANGE * jnp.sqrt(variance * weight)
    return jnp.any(beyond_chance & (difference * shorter > least), axis=0)
