"""`python -m benchmarks.orbits`: a thousand periodic orbits in one call, and SciPy's on a sample.

The symmetric orbit of the SD oscillator at frequencies from 0.6 to 0.9, each from a guess off by a
fifth. jaxfil: one batched `periodic_orbit`. SciPy: for each of a few, `fsolve` on the period map,
which is `solve_ivp` (DOP853) restarted at every contact; `fsolve` takes its Jacobian by finite
differences. Errors are those of x0 against the closed form. Prints a table; writes nothing.
"""

import argparse
import dataclasses
import time

import numpy as np

from benchmarks.peers import scipy_events
from benchmarks.scenes import SCENES
from benchmarks.table import Column, table

SCENE = SCENES["sd"]
LOW, HIGH = 0.6, 0.9
COLUMNS = (
    Column("who"),
    Column("orbits", ">"),
    Column("ms per orbit", ">.3f"),
    Column("worst error", ">.1e"),
)


def exact(omega):
    """x(0) of the symmetric orbit, x(t + T/2) = -x(t).

    After an upward zero x = 1 + e^(-ζt)(A cos dt + B sin dt) + Re(R e^(i(Ωt + φ))). The forced part
    is odd under half a period, so the rest must be: linear equations for A and B. x = 0 gives φ.
    """
    f0, zeta = SCENE.constants()
    response = f0 / (1 - omega**2 + 2j * zeta * omega)
    root, half = -zeta + 1j * np.sqrt(1 - zeta**2), np.pi / omega

    def free(t):
        # The motion from (1, 0) and from (0, 1), by the two complex exponents.
        p, q = root, root.conjugate()
        ep, eq = np.exp(p * t), np.exp(q * t)
        matrix = np.asarray([[p * eq - q * ep, ep - eq], [p * q * (eq - ep), p * ep - q * eq]])
        return (matrix / (p - q)).real

    start = np.linalg.solve(free(half) + np.eye(2), [-2.0, 0.0])
    angle = -np.arccos(-(1 + start[0]) / abs(response))
    # The forcing has phase 0 this long before the zero, or after it.
    phase = (angle - np.angle(response)) % (2 * np.pi)
    t = 2 * half - phase / omega
    sign, t = (-1, t - half) if t >= half else (1, t)
    x = np.asarray([1.0, 0.0]) + free(t) @ start
    turned = abs(response) * np.exp(1j * (omega * t + angle))
    return sign * (x + np.asarray([turned.real, -omega * turned.imag]))


def jaxfil_orbits(omegas, guesses, steps):
    """x0 of all orbits, seconds of the first call and of a later one, and which were found."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    import jaxfil as jf

    @eqx.filter_jit
    @eqx.filter_vmap
    def find(omega, x0):
        system = jf.systems.SDOscillator(omega=omega)
        return jf.periodic_orbit(system, x0, steps=steps, max_events=8, throw=False)

    seconds = []
    for shift in (0.0, 1e-6):
        start = time.perf_counter()
        found = find(jnp.asarray(omegas), jnp.asarray(guesses + shift))
        jax.block_until_ready(found.x0)
        seconds.append(time.perf_counter() - start)
    return np.asarray(found.x0), seconds, np.asarray(found.result == jf.RESULTS.successful)


def scipy_orbit(omega, guess, rtol):
    """x0 by `fsolve`."""
    from scipy.optimize import fsolve

    def gap(x0):
        scene = dataclasses.replace(SCENE, x0=tuple(x0))
        return scipy_events.sample(scene, [omega], 0, 1, dict(rtol=rtol))[0, 0] - x0

    return fsolve(gap, guess, xtol=1e-11)


def cells(who, seconds, count, errors):
    """One line of the table, in the order of `COLUMNS`."""
    return [who, count, 1e3 * seconds / count, np.max(errors) if len(errors) else "-"]


def main():
    """Find the orbits both ways; print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.orbits", description=__doc__)
    parser.add_argument("--orbits", type=int, default=1000, help="in one call (default 1000)")
    parser.add_argument("--sample", type=int, default=10, help="for SciPy (default 10)")
    parser.add_argument("--steps", type=int, default=40, help="per period (default 40)")
    parser.add_argument("--rtol", type=float, default=1e-10, help="SciPy's (default 1e-10)")
    args = parser.parse_args()
    omegas = np.linspace(LOW, HIGH, args.orbits)
    wanted = np.stack([exact(w) for w in omegas])
    guesses = 1.2 * wanted
    x0, (first, later), good = jaxfil_orbits(omegas, guesses, args.steps)
    errors = np.abs(x0 - wanted).max(axis=1)
    rows = [cells(f"jaxfil, {args.steps} steps", later, args.orbits, errors[good])]
    some = np.linspace(0, args.orbits - 1, args.sample).astype(int)
    start = time.perf_counter()
    found = np.stack([scipy_orbit(omegas[i], guesses[i], args.rtol) for i in some])
    took = time.perf_counter() - start
    apart = np.abs(found - wanted[some]).max(axis=1)
    rows.append(cells(f"SciPy fsolve, rtol {args.rtol:.0e}", took, len(some), apart))
    note = f"jaxfil found {good.sum()} of {args.orbits}; its first call took {first:.1f} s."
    print(table(COLUMNS, rows, note=note))


if __name__ == "__main__":
    main()
