"""What an expert writes with numba: one lane at a time, scalars in registers, contacts located.

In: a scene, frequencies, a method and its steps per period. Out: sampled states. Each step tries to
reach the next grid point. A margin, positive while the mode lasts (s H off the surface, grip^2 -
push^2 in a stick), is looked at over the step by its cubic; where it goes below zero the step is
done again up to the root, which keeps the method's order, and the mode is chosen anew there.
"""

import functools

import numpy as np

from benchmarks import installed

NAME = "numba scalar"
SETTINGS = [dict(method="rk4", steps=n) for n in (100, 200, 400, 800)]
SETTINGS += [dict(method="dopri5", steps=n) for n in (50, 100, 200, 400)]
SETTINGS += [dict(method="dop853", steps=n) for n in (20, 30, 40, 64, 100)]
SHAPED = False


def missing():
    """Why it cannot run; empty where it can."""
    return installed.missing("numba")


def label(setting):
    """The setting in a few letters."""
    return f"{setting['method']} {setting['steps']}"


def method(setting):
    """Its method."""
    return setting["method"]


def prepare(cores):
    """As many threads as cores."""
    import numba

    numba.set_num_threads(cores)


def effort(quick):
    """The most lanes at a time; None: as many as asked for."""
    return None


def _cubic_tools(njit):
    """Functions of the cubic through a margin g and its rate r (times the step) at both ends."""

    @njit
    def dip(g0, r0, g1, r1):
        """Where in (0, 1] the cubic is below zero: its minimum, else the end, else 2."""
        a2 = 3 * (g1 - g0) - 2 * r0 - r1
        a3 = 2 * (g0 - g1) + r0 + r1
        square = a2 * a2 - 3 * a3 * r0
        if square > 0.0:
            root = np.sqrt(square)
            top, bottom = (-r0, a2 + root) if a2 > 0.0 else (root - a2, 3 * a3)
            # theta = top / bottom inside (0, 1), without dividing by zero
            if bottom * top > 0.0 and abs(top) < abs(bottom):
                theta = top / bottom
                if g0 + theta * (r0 + theta * (a2 + theta * a3)) < 0.0:
                    return theta
        return 1.0 if g1 < 0.0 else 2.0

    @njit
    def first_root(g0, r0, g1, r1, high):
        """The cubic's root in (0, high), at whose end it is negative."""
        a2 = 3 * (g1 - g0) - 2 * r0 - r1
        a3 = 2 * (g0 - g1) + r0 + r1
        low, theta = 0.0, 0.5 * high
        for _ in range(40):
            # A lane that leaves the surface has g0 = 0: that root is divided out.
            value = r0 + theta * (a2 + theta * a3)
            slope = a2 + 2 * theta * a3
            if g0 > 0.0:
                slope = value + theta * slope
                value = g0 + theta * value
            if value < 0.0:
                high = theta
            else:
                low = theta
            guess = theta - value / slope if slope != 0.0 else low
            if not low < guess < high:
                guess = 0.5 * (low + high)
            if abs(guess - theta) < 1e-7:
                break
            theta = guess
        return guess

    return dip, first_root


def _event_tools(njit, kind, method):
    """`advance`, one step in the present mode; `locate`, the first contact in a step; `choose`."""
    from . import numba_fields as nf

    field, height, place, hold, slide = nf.FIELDS[kind]
    step = nf.compile_step(kind, method)
    dip, first_root = _cubic_tools(njit)

    @njit
    def advance(omega, t, h, x1, x2, d1, d2, s, p):
        """State, slope, margin and margin's rate after a step of length h."""
        if s == 0.0:
            y1 = slide(x1, h, p)
            push, rate, grip = hold(omega, t + h, y1, x2, p)
            return y1, x2, d1, d2, grip * grip - push * push, -2 * push * rate
        y1, y2, e1, e2 = step(omega, t, h, x1, x2, d1, d2, s, p)
        g, r = height(y1, y2, e1, e2, p)
        return y1, y2, e1, e2, s * g, s * r

    @njit
    def choose(omega, t, x1, x2, s, p):
        """Mode, slope, margin and rate for a lane on the surface that was in mode s."""
        x1, x2 = place(x1, x2, p)
        push, rate, grip = hold(omega, t, x1, x2, p)
        # A stick that ends does end, whatever rounding says of a push that equals the grip.
        if s != 0.0 and abs(push) < grip:
            return 0.0, x1, x2, x2, 0.0, grip * grip - push * push, -2 * push * rate
        s = 1.0 if push > 0.0 else -1.0
        d1, d2 = field(p[0] * np.cos(omega * t), x1, x2, s, p)
        _, r = height(x1, x2, d1, d2, p)
        return s, x1, x2, d1, d2, 0.0, max(s * r, 0.0)

    @njit
    def locate(omega, t, h, x1, x2, d1, d2, s, p, g0, r0, g1, r1):
        """(length, landed, state): up to the first contact, or up to a minimum that stays clear."""
        theta = dip(g0, r0 * h, g1, r1 * h)
        if theta > 1.0:
            return h, False, x1, x2
        high = theta * h
        if theta < 1.0:
            y1, y2, e1, e2, g, r = advance(omega, t, high, x1, x2, d1, d2, s, p)
            if g >= 0.0:
                return high, False, y1, y2
        low, tau = 0.0, first_root(g0, r0 * h, g1, r1 * h, theta) * h
        for _ in range(60):
            y1, y2, e1, e2, g, r = advance(omega, t, tau, x1, x2, d1, d2, s, p)
            if g < 0.0:
                high = tau
            else:
                low = tau
            move = -g / r if r < 0.0 else h
            # The last correction is Euler's: its error is half the acceleration times move^2.
            if abs(move) < 1e-7 * h or high - low < 1e-14 * h:
                break
            guess = tau + move
            tau = guess if low < guess < high else 0.5 * (low + high)
        if abs(move) < 1e-7 * h:
            tau, y1, y2 = tau + move, y1 + move * e1, y2 + move * e2
        return tau, True, y1, y2

    return advance, choose, locate


@functools.cache
def loop_tools(kind, method):
    """`begin` at t = 0, and `go` from one grid point to another, for one lane."""
    import numba

    from . import numba_fields as nf

    njit = numba.njit(fastmath=True)
    advance, choose, locate = _event_tools(njit, kind, method)
    field, height = nf.FIELDS[kind][:2]

    @njit
    def begin(omega, x1, x2, p):
        """Mode, state, slope, margin and rate at t = 0."""
        g, r = height(x1, x2, x2, 0.0, p)
        if g == 0.0:
            return choose(omega, 0.0, x1, x2, 1.0, p)
        s = 1.0 if g > 0.0 else -1.0
        d1, d2 = field(p[0], x1, x2, s, p)
        g, r = height(x1, x2, d1, d2, p)
        return s, x1, x2, d1, d2, s * g, s * r

    @njit
    def go(omega, h, k, stop, s, x1, x2, d1, d2, g, r, p):
        """From grid point k of a period to grid point `stop`."""
        t, budget = k * h, 100 * (stop - k) + 1000
        while k < stop and budget > 0:
            budget -= 1
            dt = (k + 1) * h - t
            y1, y2, e1, e2, gy, ry = advance(omega, t, dt, x1, x2, d1, d2, s, p)
            # The cubic's Bezier points: where none is negative, neither is the cubic.
            third = dt * (1 / 3)
            if gy < 0.0 or g + third * r < 0.0 or gy - third * ry < 0.0:
                length, landed, z1, z2 = locate(omega, t, dt, x1, x2, d1, d2, s, p, g, r, gy, ry)
                if landed:
                    t += length
                    s, x1, x2, d1, d2, g, r = choose(omega, t, z1, z2, s, p)
                    continue
                if length < dt:
                    y1, y2, e1, e2, gy, ry = advance(omega, t, length, x1, x2, d1, d2, s, p)
                    t += length
                    x1, x2, d1, d2, g, r = y1, y2, e1, e2, gy, ry
                    continue
            k += 1
            t = k * h
            x1, x2, d1, d2, r = y1, y2, e1, e2, ry
            # A step too short to leave the surface by more than rounding has not left it.
            g = 0.0 if g == 0.0 and dt < 1e-6 * h else gy
        if budget == 0:
            x1 = x2 = 1e300
        return s, x1, x2, d1, d2, g, r

    return begin, go


@functools.cache
def kernel(kind, method):
    """The compiled function of all lanes for one scene and method."""
    import numba

    begin, go = loop_tools(kind, method)

    @numba.njit(fastmath=True, parallel=True)
    def lanes(omegas, spans, steps, start, p, transient, samples, out):
        for i in numba.prange(len(omegas)):
            omega, span = omegas[i], spans[i]
            s, x1, x2, d1, d2, g, r = begin(omega, start[0], start[1], p)
            for j in range(transient + samples):
                # Time starts anew in each period, so that no digits are lost.
                h = span / steps
                s, x1, x2, d1, d2, g, r = go(omega, h, 0, steps, s, x1, x2, d1, d2, g, r, p)
                if j >= transient:
                    out[i, j - transient, 0] = x1
                    out[i, j - transient, 1] = x2

    return lanes


def sample(scene, omegas, transient, samples, setting, cores=1):
    """States at the end of the last `samples` periods, (lanes, samples, 2)."""
    import numba

    omegas = np.ascontiguousarray(omegas, dtype=float)
    spans = np.array([scene.period(omega) for omega in omegas])
    out = np.empty((len(omegas), samples, 2))
    run = kernel(scene.kind, setting["method"])
    # Lanes that stick cost more than lanes that do not: small chunks share them out.
    with numba.parallel_chunksize(max(1, len(omegas) // 64)):
        run(omegas, spans, setting["steps"], scene.x0, scene.constants(), transient, samples, out)
    return out
