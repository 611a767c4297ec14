"""Exponents of many lanes: systems' values and initial states enter, spectra leave."""

from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf

# Lanes of one call; calls run on all cores.
CHUNK = 64


def spectra(make, values, x0, *, periods, transient, steps=40, parts=1):
    """`jf.lyapunov_spectrum` of `make(value)` from x0, (n,) or (p, n), in chunks on all cores.
    Vectors are orthonormalised `parts` times a forcing period."""
    states = np.broadcast_to(x0, (len(values), np.shape(x0)[-1]))

    def lane(value, x0):
        system = make(value)
        return jf.lyapunov_spectrum(
            system,
            x0,
            periods=periods * parts,
            transient=transient * parts,
            steps=steps // parts,
            interval=system.period / parts,
        )

    size = min(CHUNK, len(values))
    run = eqx.filter_jit(lambda v, x: jax.vmap(lane)(v, x))

    def piece(start):
        pick = np.minimum(np.arange(start, start + size), len(values) - 1)
        return jax.block_until_ready(run(jnp.asarray(values[pick]), jnp.asarray(states[pick])))

    starts = range(0, len(values), size)
    done = [piece(0)]  # compiled here, and not on every core
    with ThreadPoolExecutor() as pool:
        done += pool.map(piece, starts[1:])
    return jax.tree.map(lambda *a: np.concatenate(a)[: len(values)], *done)


def change_on_doubling(make, values, x0, steps, periods=2):
    """The largest change of the state after some periods when the steps are doubled: whether they
    resolve the layer of a smoothed system."""

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(0, None))
    def end(value, steps):
        system = make(value)
        span, dt = periods * system.period, system.period / steps
        return jf.solve(system, x0, 0.0, span, dt, max_events=None, throw=False).x_final

    coarse, fine = (end(jnp.asarray(values), jnp.asarray(float(n))) for n in (steps, 2 * steps))
    return float(jnp.max(abs(coarse - fine)))


def mean_of(exponents):
    """The mean of independent estimates and its standard error."""
    return float(np.mean(exponents)), float(np.std(exponents) / np.sqrt(len(exponents) - 1))
