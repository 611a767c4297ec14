"""SciPy: `solve_ivp` with DOP853 and a terminal event, one call for each stay in a mode.

In: a scene, frequencies, a tolerance. Out: sampled states. A stick is a straight line, so its end
is scanned for and refined by Brent's method, and no integrator is asked. Pure Python, hence slow:
the benchmark gives it few lanes.
"""

import math

import numpy as np

from benchmarks import installed

from .processes import prepare as prepare, run

NAME = "SciPy events"
SETTINGS = [dict(rtol=r) for r in (1e-6, 1e-8, 1e-10, 1e-12)]
SHAPED = False

# Points of a period at which the push on a sticking mass is looked at.
SCAN = 400


def missing():
    """Why it cannot run; empty where it can."""
    return installed.missing("scipy", "SciPy")


def label(setting):
    """The setting in a few letters."""
    return f"DOP853 {setting['rtol']:.0e}"


def method(setting):
    """Its method."""
    return "DOP853"


def effort(quick):
    """The most lanes at a time; None: as many as asked for."""
    return 2 if quick else 4


def _belt(omega, constants):
    """(field, height, place, push, grip) of one belt lane; push(t, x) also takes arrays."""
    f0, grip, damp, cubic, g1, g2, v = constants

    def field(t, x, s):
        x1, x2 = x
        u = x2 - v
        force = f0 * math.cos(omega * t) - x1 * (g1 + g2 * x1 * x1)
        return x2, force + u * (damp - cubic * u * u) - s * grip

    def push(t, x):
        return f0 * np.cos(omega * t) - x[0] * (g1 + g2 * x[0] ** 2)

    return field, lambda x: x[1] - v, lambda x: np.array([x[0], v]), push, grip


def _sd(omega, constants):
    """The same five of one SD lane at alpha = 0, which crosses the way x2 points."""
    f0, zeta = constants

    def field(t, x, s):
        x1, x2 = x
        return x2, f0 * math.cos(omega * t) - 2 * zeta * x2 - x1 + s

    return field, lambda x: x[0], lambda x: np.array([0.0, x[1]]), lambda t, x: x[1], 0.0


def _free(field, height, s, t, x, saves, rtol):
    """Off the surface up to the first contact or the last save: (time, state, saved states)."""
    from scipy.integrate import solve_ivp

    def margin(time, state, side):
        # A lane that starts on the surface leaves it: that zero is no contact.
        return side * height(state) if time > t else 1.0

    margin.terminal, margin.direction = True, -1
    out = solve_ivp(
        field, (t, saves[-1]), x, "DOP853", saves, events=margin, args=(s,), rtol=rtol, atol=rtol
    )
    saved = np.reshape(out.y, (2, -1)).T
    if out.status == 1:
        return out.t_events[0][0], out.y_events[0][0], saved
    return saves[-1], saved[-1], saved


def _stick(push, grip, t, x, saves, span):
    """On the belt up to the slip or the last save: (time, state, saved states, slipped)."""
    from scipy.optimize import brentq

    def at(time):
        elapsed = np.asarray(time - t)
        return np.stack([x[0] + x[1] * elapsed, np.full(elapsed.shape, x[1])])

    def excess(time):
        return abs(push(time, at(time))) - grip

    start, end, slipped = t, saves[-1], False
    while start < saves[-1] and not slipped:
        ts = np.linspace(start, min(start + span, saves[-1]), SCAN + 1)
        beyond = np.flatnonzero(excess(ts[1:]) > 0)
        if slipped := len(beyond) > 0:
            # At the very start of the stick the push may equal the grip by rounding.
            low, high = ts[beyond[0]], ts[beyond[0] + 1]
            end = brentq(excess, low, high, xtol=1e-14) if excess(low) < 0 else low
        start = ts[-1]
    return end, at(end), at(saves[saves <= end]).T, slipped


def _lane(scene, omega, transient, samples, rtol):
    """The sampled states of one lane, (samples, 2)."""
    build = _belt if scene.kind == "belt" else _sd
    field, height, place, push, grip = build(omega, scene.constants())
    span = scene.period(omega)
    saves = span * np.arange(transient + 1, transient + samples + 1)
    t, x, found = 0.0, np.array(scene.x0), []
    s = math.copysign(1.0, height(x))
    while len(saves):
        if s == 0:
            t, x, saved, landed = _stick(push, grip, t, x, saves, span)
        else:
            t, x, saved = _free(field, height, s, t, x, saves, rtol)
            landed = t < scene.period(omega) * (transient + samples)
        found.extend(saved)
        saves = saves[len(saved) :]
        if landed:
            x = place(x)
            force = push(t, x)
            s = 0.0 if s != 0 and abs(force) < grip else math.copysign(1.0, force)
    return np.array(found)


def sample(scene, omegas, transient, samples, setting, cores=1):
    """States at the end of the last `samples` periods, (lanes, samples, 2)."""
    jobs = [(scene, float(w), transient, samples, setting["rtol"]) for w in omegas]
    return np.stack(run(_lane, jobs, cores))
