"""The prime period of an autonomous orbit; a guess of the period may converge to a multiple.

Contacts show the multiplicity; for an orbit without contacts the states after fractions of the
period do.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.run.solution import Events, switches
from jaxfil.model.system import System
from jaxfil.orbits.shooting import ShootingOptions, flow_map
from jaxfil.xla.known import array_of

# Larger multiples result only from a guess as far off, which is not expected.
_MOST = 12
# An orbit may close if its states differ by less than this fraction; with other steps they differ
# by the error of the steps. Newton's method decides.
_CLOSE = 1e-4


def times_round(
    system: System, options: ShootingOptions, x0: Array, period: Array, events: Events | None
) -> list[int]:
    """The numbers of equal parts of the period, more than one, after each of which the orbit may
    close, the largest first."""
    contacts = switches(events)
    if contacts.size:
        known = jax.tree.map(lambda v: np.asarray(v)[contacts], events)
        start = abs(np.asarray(x0))
        closes = [_repeats(known, start, float(period), k) for k in range(1, _MOST + 1)]
    else:
        parts = array_of(1 / np.arange(1.0, _MOST + 1), x0.dtype)
        gaps = np.asarray(_gaps(system, options, x0, period, parts))
        closes = gaps < _CLOSE
    return [k for k in range(_MOST, 1, -1) if closes[k - 1]]


def _repeats(events: Events, start: np.ndarray, period: float, k: int) -> bool:
    """Whether contacts repeat after each k-th of the period, for an orbit with the sizes `start` of
    the components at its start."""
    ts, xs = np.asarray(events.ts), np.asarray(events.xs)
    count = ts.size
    if count % k:
        return False
    shift = count // k
    later = np.append(ts, ts + period)[shift : shift + count]
    same = np.all(abs(later - ts - period / k) < _CLOSE * period)
    size = np.maximum(np.max(abs(xs), axis=0), start)
    # A component that is zero on the surface has the rounding of its motion at every contact.
    size = np.maximum(size, _CLOSE * size.max())
    return bool(same and np.all(abs(np.roll(xs, -shift, axis=0) - xs) <= _CLOSE * size))


@eqx.filter_jit
def _gaps(
    system: System, options: ShootingOptions, x0: Array, period: Array, parts: Array
) -> Array:
    """The distance of the orbit from closing after each fraction of the period, relative to the
    largest distance."""

    def gap(part: Array) -> Array:
        none = jnp.zeros(0, x0.dtype)
        forward = flow_map(lambda q: (system, part * period), options, none, 1.0)
        return jnp.max(abs(forward(x0, jnp.zeros_like(part)) - x0))

    gaps = jax.lax.map(gap, parts)
    # At rest it closes after any time, including zero, which is not a multiple.
    largest = jnp.max(gaps)
    return gaps / jnp.where(largest == 0, gaps, largest)
