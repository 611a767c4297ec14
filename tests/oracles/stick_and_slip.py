"""The belt with a linear spring in closed form: sticks with the belt, slips once a period."""

import numpy as np
from scipy.optimize import brentq

FRICTION, DAMPING, STIFFNESS, FORCE = 0.6 * 9.81, 0.05 * 9.81, 10.0, 10.0


def slip_flight(omega, t, x):
    """Position, velocity and acceleration after a slip at (t, x) to below the speed 1 of the belt:

    x'' + c x' + k x = f0 cos ωt + c + μ g
    """
    response = FORCE / (STIFFNESS - omega**2 + 1j * DAMPING * omega)
    rest = (DAMPING + FRICTION) / STIFFNESS
    decay = -DAMPING / 2 + 1j * np.sqrt(STIFFNESS - DAMPING**2 / 4)
    forced = [(1j * omega) ** n * response * np.exp(1j * omega * t) for n in range(3)]
    free = np.linalg.solve(
        [[1, 0], [decay.real, -decay.imag]],
        [x - rest - forced[0].real, 1 - forced[1].real],
    )
    free = complex(free[0], free[1])

    def at(since):
        turned = np.exp(1j * omega * since)
        return [
            (v * turned + decay**n * free * np.exp(decay * since)).real + (rest if n == 0 else 0)
            for n, v in enumerate(forced)
        ]

    return at


def crossing(function, stop, count):
    """The first time at which a function, negative at first, is zero."""
    times = np.linspace(0, stop, count)[1:]
    values = function(times)
    i = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))[0]
    return brentq(function, times[i], times[i + 1], xtol=1e-15)


def least_gap(omega, t=0.0, x=1.5, periods=30):
    """What the belt is faster by on the periodic motion where the mass, in its slip, is fastest."""
    for _ in range(periods):

        def release(since, t=t, x=x):
            force = FORCE * np.cos(omega * (t + since))
            return STIFFNESS * (x + since) - force - FRICTION

        stuck = crossing(release, 2 * np.pi / omega, 400)
        t, x = t + stuck, x + stuck
        at = slip_flight(omega, t, x)
        slip = crossing(lambda since, at=at: at(since)[1] - 1, 4 * np.pi / omega, 4000)
        t, x = t + slip, at(slip)[0]
    # The velocity falls, rises to its largest value, falls and rises to that of the belt.
    falls = crossing(lambda since: at(since)[2], slip, 2000)
    top = falls + crossing(lambda since: -at(falls + since)[2], slip - falls, 2000)
    return 1 - at(top)[1]
