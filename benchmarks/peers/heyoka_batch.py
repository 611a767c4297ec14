"""heyoka: Taylor's method, several lanes in a vector, the modes of motion as a parameter.

In: a scene, frequencies, a tolerance. Out: sampled states. A lane's mode s is a parameter of its
equations: off the surface they are the field on side s and the event is s H = 0; at s = 0, in a
stick, the mass moves with the belt and the event is grip^2 - push^2 = 0. The event's callback sets
the mode and lets the integration go on, so that the lanes of a vector never wait for each other,
and samples are read from the steps' polynomials.
"""

import functools
import math

import numpy as np

from benchmarks import installed

from .processes import prepare as prepare, run

NAME = "heyoka"
SETTINGS = [dict(tol=t) for t in (1e-6, 1e-8, 1e-10, 1e-12, 1e-14)]
SHAPED = False
# Lanes of a vector: eight take a fifth less time than four, and a sixth of one by one.
BATCH = 8
# In a stick the series of the state ends after its second term and asks for no step at all; that
# of the push does not: steps are at most this part of a period.
PART = 1 / 16
# A mass that slips starts so much faster or slower than the belt.
ASIDE = 4e-15


def missing():
    """Why it cannot run; empty where it can."""
    return installed.missing("heyoka")


def label(setting):
    """The setting in a few letters."""
    return f"Taylor {setting['tol']:.0e}"


def method(setting):
    """Its method."""
    return "Taylor"


def effort(quick):
    """The most lanes at a time; None: as many as asked for."""
    return 128 if quick else None


def _belt(constants, own):
    """The belt's equations, the event's function, what a contact leads to, and a state's side.

    `own` will hold views of the integrator's states, parameters and times: asking it for them at
    each contact takes longer than the rest of the callback.
    """
    import heyoka as hy

    f0, grip, damp, cubic, g1, g2, v = constants
    x1, x2 = hy.make_vars("x1", "x2")
    s, omega = hy.par[0], hy.par[1]
    u = x2 - v
    push = f0 * hy.cos(omega * hy.time) - x1 * (g1 + g2 * x1 * x1)
    moves = s * s
    field = moves * (push + u * (damp - cubic * u * u)) - s * grip
    margin = s * u + (1 - moves) * (grip * grip - push * push)

    def contact(ta, sign, lane):
        state, pars, time = own
        x = state[0, lane]
        force = f0 * math.cos(pars[1, lane] * time[lane]) - x * (g1 + g2 * x * x)
        if pars[0, lane] != 0 and abs(force) < grip:
            pars[0, lane], state[1, lane] = 0.0, v
            return True
        # A stick that ends does end, whatever rounding says of a push that equals the grip. There
        # the margin starts as a double root, which heyoka's isolation of roots does not end on.
        side = math.copysign(1.0, force)
        state[1, lane] = v + (side * ASIDE if pars[0, lane] == 0 else 0.0)
        pars[0, lane] = side
        return True

    return [(x1, x2), (x2, field)], margin, contact, lambda x: math.copysign(1.0, x[1] - v)


def _sd(constants, own):
    """The same four of the SD oscillator at alpha = 0, which crosses the way that x2 points."""
    import heyoka as hy

    f0, zeta = constants
    x1, x2 = hy.make_vars("x1", "x2")
    s, omega = hy.par[0], hy.par[1]
    field = f0 * hy.cos(omega * hy.time) - 2 * zeta * x2 - x1 + s

    def contact(ta, sign, lane):
        state, pars, _ = own
        state[0, lane] = 0.0
        pars[0, lane] = math.copysign(1.0, state[1, lane])
        return True

    return [(x1, x2), (x2, field)], s * x1, contact, lambda x: math.copysign(1.0, x[0])


@functools.cache
def integrator(kind, constants, tol):
    """The compiled integrator of one scene and tolerance, and the side of a state."""
    import heyoka as hy

    own = []
    equations, margin, contact, side = (_belt if kind == "belt" else _sd)(constants, own)
    event = hy.t_event_batch(margin, callback=contact, direction=hy.event_direction.negative)
    zeros = np.zeros((2, BATCH))
    options = dict(tol=tol, t_events=[event], compact_mode=False, fast_math=True)
    ta = hy.taylor_adaptive_batch(equations, zeros, pars=zeros + 1, force_avx512=True, **options)
    own[:] = ta.state, ta.pars, ta.time
    return ta, side


def _lanes(scene, omegas, transient, samples, tol):
    """Sampled states of `BATCH` lanes, (lanes, samples, 2)."""
    import heyoka as hy

    ta, side = integrator(scene.kind, scene.constants(), tol)
    spans = np.array([scene.period(omega) for omega in omegas])
    ta.set_time(0.0)
    ta.state[:] = np.reshape(scene.x0, (2, 1))
    ta.pars[:] = [np.full(BATCH, side(scene.x0)), omegas]
    ta.reset_cooldowns()
    # A grid starts where the integrator is.
    grid = np.array([0, *range(transient + 1, transient + samples + 1)])[:, None] * spans
    limit = spans * PART if scene.kind == "belt" else np.full(BATCH, np.inf)
    found = ta.propagate_grid(grid, max_delta_t=limit)
    xs = np.moveaxis((found[-1] if isinstance(found, tuple) else found)[1:], 2, 0)
    good = [result[0] == hy.taylor_outcome.time_limit for result in ta.propagate_res]
    return np.where(np.reshape(good, (-1, 1, 1)), xs, np.nan)


def sample(scene, omegas, transient, samples, setting, cores=1):
    """States at the end of the last `samples` periods, (lanes, samples, 2)."""
    asked = len(omegas)
    filled = -(-asked // BATCH) * BATCH
    omegas = np.asarray(omegas, dtype=float)[np.minimum(np.arange(filled), asked - 1)]
    jobs = [(scene, some, transient, samples, setting["tol"]) for some in omegas.reshape(-1, BATCH)]
    return np.concatenate(run(_lanes, jobs, cores))[:asked]
