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
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.shooting import flow_map
from jaxfil.xla.known import array_of

# Larger multiples result only from a guess as far off, which is not expected.
_MOST = 12
# An orbit closes if its states differ by less than this fraction; with other steps they differ by
# the error of the steps. Newton's method decides.
_CLOSE = 1e-4


def times_round(orbit: Orbit) -> int:
    """The largest number of equal parts of the period after each of which the orbit closes."""
    contacts = switches(orbit.events)
    if contacts.size:
        assert orbit.events is not None
        known = jax.tree.map(lambda v: np.asarray(v)[contacts], orbit.events)
        closes = [_repeats(known, float(orbit.period), k) for k in range(1, _MOST + 1)]
    else:
        parts = array_of(1 / np.arange(1.0, _MOST + 1), orbit.x0.dtype)
        gaps = np.asarray(_gaps(orbit, parts))
        closes = gaps < _CLOSE
    return int(np.max(np.flatnonzero(closes), initial=0)) + 1


def _repeats(events: Events, period: float, k: int) -> bool:
    """Whether contacts repeat after each k-th of the period."""
    ts, xs = np.asarray(events.ts), np.asarray(events.xs)
    count = ts.size
    if count % k:
        return False
    shift = count // k
    later = np.append(ts, ts + period)[shift : shift + count]
    same = np.all(abs(later - ts - period / k) < _CLOSE * period)
    size = np.max(abs(xs), axis=0)
    return bool(same and np.all(abs(np.roll(xs, -shift, axis=0) - xs) <= _CLOSE * size))


@eqx.filter_jit
def _gaps(orbit: Orbit, parts: Array) -> Array:
    """The distance of the orbit from closing after each fraction of the period, relative to the
    largest distance."""

    def gap(part: Array) -> Array:
        forward = flow_map(
            lambda q: (orbit.system, part * orbit.period),
            orbit.options,
            jnp.zeros(0, orbit.x0.dtype),
            1.0,
        )
        return jnp.max(abs(forward(orbit.x0, jnp.zeros_like(part)) - orbit.x0))

    gaps = jax.lax.map(gap, parts)
    # At rest it closes after any time, including zero, which is not a multiple.
    largest = jnp.max(gaps)
    return gaps / jnp.where(largest == 0, gaps, largest)
