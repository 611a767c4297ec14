"""Exact motions of an undamped forced oscillator with a relay, in closed form per piece.

    x'' + x = A cos(ωt) + s·P,   s = sgn x (snap-through), or s = −sgn x' (dry friction)

Numbers enter; the state at the end and the number of contacts leave. Each piece is
P s + V cos(ωt) + a cos τ + b sin τ, V = A/(1 − ω²), in extended precision; its end is the first
zero of x, of x', or of the hold of a stick, sampled and bisected. Nothing of the library is used.
"""

import mpmath
import numpy as np

REAL = np.longdouble
TWO_PI = REAL("6.283185307179586476925286766559")
PER_PERIOD = 60  # samples of a period, of the forcing or of the oscillator


def phase(omega, t):
    """ωt mod 2π of two floats, exactly."""
    with mpmath.workdps(60):
        return REAL(
            str(mpmath.fmod(mpmath.mpf(float(omega)) * mpmath.mpf(float(t)), 2 * mpmath.pi))
        )


def first_fall(guard, delta, length):
    """Where `guard` first falls below zero in (0, length]; None if it does not."""
    start = REAL(0)
    grid = delta * np.concatenate([np.geomspace(1e-5, 0.5, 24), np.arange(1, 300)]).astype(REAL)
    while start < length:
        taus = np.minimum(start + grid, length)
        below = np.flatnonzero(guard(taus) < 0)
        if below.size:
            hi = taus[below[0]]
            lo = taus[below[0] - 1] if below[0] else start
            for _ in range(70):
                middle = (lo + hi) / 2
                lo, hi = (lo, middle) if guard(middle) < 0 else (middle, hi)
            return hi
        start = taus[-1]
    return None


def motion(law, pull, omega, x0, t1, t0=0.0, force=1.0):
    """(x, x') at t1 and the number of contacts; `law` is "snap" or "friction"."""
    pull, omega, force = REAL(pull), REAL(omega), REAL(force)
    x, v = REAL(x0[0]), REAL(x0[1])
    phi, left, count = phase(omega, t0), REAL(t1) - REAL(t0), 0
    gain = force / (1 - omega * omega)
    delta = min(TWO_PI, TWO_PI / omega if force else TWO_PI) / PER_PERIOD
    snap = law == "snap"
    side = np.sign(x if snap else v) or _side(x, phi, pull, force, snap)
    while True:
        if side == 0:
            v = REAL(0)
            guard = _hold(x, phi, omega, force, pull)
        else:
            flow = _flow(x, v, phi, omega, gain, side * pull * (1 if snap else -1))
            guard = _height(flow, side, 0 if snap else 1)
        at = first_fall(guard, delta, left)
        if side != 0:
            x, v = flow(left if at is None else at)
        if at is None:
            return np.array([x, v], float), count
        phi, left, count = (phi + omega * at) % TWO_PI, left - at, count + 1
        if snap:
            side = -side
        elif side == 0:
            side = np.sign(force * np.cos(phi) - x)
        else:
            side = _side(x, phi, pull, force, snap)


def _flow(x, v, phi, omega, gain, centre):
    """The motion from (x, v) at phase phi: a function of the time since."""
    a = x - centre - gain * np.cos(phi)
    b = v + gain * omega * np.sin(phi)

    def flow(tau):
        cos, sin, angle = np.cos(tau), np.sin(tau), phi + omega * tau
        position = centre + gain * np.cos(angle) + a * cos + b * sin
        return position, -gain * omega * np.sin(angle) - a * sin + b * cos

    return flow


def _hold(x, phi, omega, force, pull):
    """What friction has left in a stick at x."""
    return lambda tau: pull - abs(force * np.cos(phi + omega * tau) - x)


def _height(flow, side, component):
    """A function of the time since: positive while the side lasts."""
    return lambda tau: side * flow(tau)[component]


def _side(x, phi, pull, force, snap):
    """Where a state on the surface goes: to a side, or 0 where it sticks."""
    rest = force * np.cos(phi) - x
    return REAL(0) if not snap and abs(rest) <= pull else np.sign(rest)
