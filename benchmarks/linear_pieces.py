"""Exact motions whose every mode is linear, however stiff: sums of exponentials in many digits.

Numbers and modes enter; the state at the end and the times of the contacts leave. A `Mode` is z' =
A z + b + Re(c e^{iωt}), with a guard that is positive while it lasts; `follow` takes a state
through modes to a time. Nothing of the library is used.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import mpmath as mp

DIGITS = 40


class Mode(NamedTuple):
    """The field, lists of numbers, and `guard(t, z)`."""

    a: list
    b: list
    c: list
    guard: Callable


def flow(mode: Mode, omega, t0, z0):
    """z(t) of one mode from z0 at t0."""
    n, a = len(z0), mp.matrix(mode.a)
    if mp.det(a) == 0:
        # A stick or a flight, without a wave: A² = 0, and z is a polynomial.
        first = a * mp.matrix(z0) + mp.matrix(mode.b)
        second = a * mp.matrix(mode.b) / 2
        return lambda t: list(mp.matrix(z0) + (t - t0) * first + (t - t0) ** 2 * second), 0
    wave = mp.lu_solve(1j * omega * mp.eye(n) - a, mp.matrix(mode.c))
    rest = mp.lu_solve(a, -mp.matrix(mode.b))
    rates, vectors = mp.eig(a)
    start = [z0[i] - rest[i] - mp.re(wave[i] * mp.expj(omega * t0)) for i in range(n)]
    parts = mp.lu_solve(vectors, mp.matrix(start))

    def at(t):
        grown = [p * mp.exp(r * (t - t0)) for p, r in zip(parts, rates, strict=True)]
        turn = mp.expj(omega * t)
        own = [mp.fsum(vectors[i, k] * grown[k] for k in range(n)) for i in range(n)]
        return [rest[i] + mp.re(wave[i] * turn) + mp.re(own[i]) for i in range(n)]

    return at, max(abs(r) for r in rates)


def follow(modes: dict[Any, Mode], after: Callable, mode, z0, t1, omega=0, pace=0.05):
    """(state at t1, times of the contacts); `after(mode, t, z)` is the mode that follows.

    Guards are sampled every `pace`, and geometrically from the start of a piece, then bisected.
    """
    with mp.workdps(DIGITS):
        t, z, t1, omega = mp.mpf(0), [mp.mpf(v) for v in z0], mp.mpf(t1), mp.mpf(omega)
        contacts = []
        while True:
            at, rate = flow(modes[mode], omega, t, z)
            step = min(pace, 0.5 / abs(rate)) if rate else pace
            guard = modes[mode].guard
            taus = [step * mp.mpf(2) ** -k for k in range(24, 0, -1)]
            while taus[-1] < min(pace, t1 - t):
                taus.append(taus[-1] * mp.mpf("1.25"))
            while taus[-1] < t1 - t:
                taus.append(taus[-1] + pace)
            taus[-1] = min(taus[-1], t1 - t)
            lo, hi = mp.mpf(0), None
            for tau in taus:
                if tau <= t1 - t and guard(t + tau, at(t + tau)) < 0:
                    hi = tau
                    break
                lo = tau
            if hi is None:
                return [float(v) for v in at(t1)], contacts
            for _ in range(110):
                middle = (lo + hi) / 2
                lo, hi = (lo, middle) if guard(t + middle, at(t + middle)) < 0 else (middle, hi)
            t, z = t + hi, at(t + hi)
            contacts.append(float(t))
            mode = after(mode, t, z)
