"""The belt with a cubic spring as a map of its stick, by SciPy's integrator with events."""

import numpy as np
from scipy.integrate import solve_ivp

MU_G, DAMPING, STIFF = 0.6 * 9.81, 0.05 * 9.81, 10000.0


def stick_map(omega, t0, x1, f0=10.0, rtol=1e-12, pushes=None):
    """x1 one period after (x1, belt speed) at t0, if it sticks at both ends: SciPy, with an event
    for every contact. Where the push on the mass exceeds the friction it slips. The push at each
    contact is appended to `pushes`."""

    def push(t, x):
        return f0 * np.cos(omega * t) - STIFF * x**3

    def field(t, y, side):
        if side == 0:
            return [1.0, 0.0]
        return [y[1], push(t, y[0]) - DAMPING * (y[1] - 1) - side * MU_G]

    def release(t, y, side):
        return MU_G - abs(push(t, y[0]))

    def contact(t, y, side):
        return side * (y[1] - 1) if t > start else 1.0

    release.terminal = contact.terminal = True
    release.direction = contact.direction = -1
    start, y, side, end = t0, np.asarray([x1, 1.0]), 0, t0 + 2 * np.pi / omega
    while start < end:
        run = solve_ivp(
            field,
            (start, end),
            y,
            "DOP853",
            events=contact if side else release,
            args=(side,),
            rtol=rtol,
            atol=1e-13,
            max_step=0.02,
        )
        start, y = run.t[-1], run.y[:, -1]
        if run.status == 1:
            force = push(start, y[0])
            y[1] = 1.0
            if pushes is not None:
                pushes.append(force)
            held = side != 0 and abs(force) < MU_G
            side = 0 if held else int(np.sign(force))
    assert side == 0
    return y[0]


def slope(omega, t0, x1, f0=10.0, h=2e-4):
    """The multiplier, by central differences of the one-dimensional map."""
    values = [stick_map(omega, t0, x1 + k * h, f0) for k in (-2, -1, 1, 2)]
    return np.dot([1, -8, 8, -1], values) / (12 * h)
