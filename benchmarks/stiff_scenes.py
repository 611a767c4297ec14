"""Three stiff scenes of `benchmarks.stiff`, their exact answers, and lanes of them.

Stiffnesses enter; systems, states at the end from sums of exponentials, and solutions leave.
"""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp

import jaxfil as jf
from benchmarks.linear_pieces import Mode, follow
from tests.oracles.stiff_systems import FRICTION, DampedRelay

X0, T1 = (0.5, 2.0), 12.0


class TwoRates(jf.System):
    """x' = −k(x − cos t) above zero, −(x − cos t) below: a stiff side and a soft one."""

    k: jax.Array

    def vector_field(self, t, x, side):
        return -jnp.where(side > 0, self.k, 1.0) * (x - jnp.cos(t))

    def switching(self, t, x):
        return x[0]


@ft.cache
def relay_exact(damping, v):
    """(x, x') at T1, by pieces in y = x − vt and w."""

    def push(t, z):
        return 2 * mp.cos(mp.mpf(1.3) * t) - z[0]

    pull, v = mp.mpf(FRICTION), mp.mpf(v)
    # On the damped side −d(x' − v): the damper's pull on the belt is a constant.
    modes = {
        1: Mode([[0, 1], [-1, -damping]], [0, damping * v - pull], [0, 2], lambda t, z: z[1] - v),
        -1: Mode([[0, 1], [-1, 0]], [0, pull], [0, 2], lambda t, z: v - z[1]),
        0: Mode([[0, 0], [0, 0]], [v, 0], [0, 0], lambda t, z: pull - abs(push(t, z))),
    }

    def after(mode, t, z):
        force = push(t, z)
        held = mode != 0 and abs(force) < pull
        return 0 if held else (1 if force > 0 else -1)

    return follow(modes, after, 1, X0, T1, 1.3)


@ft.cache
def rates_exact(k):
    """x at T1 from 2."""
    modes = {
        s: Mode([[-rate]], [0], [rate], lambda t, z, s=s: s * z[0]) for s, rate in ((1, k), (-1, 1))
    }
    return follow(modes, lambda mode, t, z: -mode, 1, [2.0], T1, 1.0)


@ft.cache
def floor_exact(k, c, t1):
    """(y, y') at t1 from (1, 0)."""
    modes = {
        1: Mode([[0, 1], [0, 0]], [0, -1], [0, 0], lambda t, z: z[0]),
        -1: Mode([[0, 1], [-k, -c]], [0, -1], [0, 0], lambda t, z: -z[0]),
    }
    return follow(modes, lambda mode, t, z: -mode, 1, [1.0, 0.0], t1)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), None, 0, None, 0, None))
def lanes(system, x0, t1, stepper, dt, max_events):
    """Solutions of all lanes, side by side."""
    return jf.solve(system, x0, 0.0, t1, dt, stepper=stepper, max_events=max_events, throw=False)


def solve(systems, x0, t1, dt, stepper, max_events=None):
    """Lanes of `systems`: outcomes, states at the end, contacts."""
    dt = jnp.asarray(dt, float)
    t1 = jnp.broadcast_to(jnp.asarray(t1, float), dt.shape)
    return lanes(systems, jnp.asarray(x0, float), t1, stepper, dt, max_events)


def relays(dampings, v):
    """A lane of `DampedRelay` for each damping."""
    dampings = jnp.asarray(dampings, float)
    return DampedRelay(dampings, jnp.broadcast_to(jnp.asarray(v, float), dampings.shape))
