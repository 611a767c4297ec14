"""diffrax: `diffeqsolve` with an `Event`, one mode a call, in an outer loop that is compiled too.

In: a scene, frequencies, solver and tolerance. Out: sampled states. All lanes run under one `vmap`,
each with its own clock: a turn of the outer loop takes a lane to its next contact or to the end of
its period, whichever comes first, so that lanes with contacts hold up the others for a segment and
no longer. On several cores the lanes are dealt out to as many devices.
"""

import functools
import math

import numpy as np

from benchmarks import installed

NAME = "diffrax events"
SETTINGS = [dict(solver="Tsit5", rtol=r) for r in (1e-4, 1e-6, 1e-8, 1e-10)]
SHAPED = True


def missing():
    """Why it cannot run; empty where it can."""
    return installed.missing("diffrax")


def label(setting):
    """The setting in a few letters."""
    return f"{setting['solver']} {setting['rtol']:.0e}"


def method(setting):
    """Its method."""
    return setting["solver"]


def prepare(cores):
    """Float64, and a device for each core."""
    import jax

    jax.config.update("jax_enable_x64", True)
    if cores > 1:
        jax.config.update("jax_num_cpu_devices", cores)


def effort(quick):
    """The most lanes at a time; None: as many as asked for."""
    # From 64 lanes to 1,000 its rate grows by a fifth.
    return 32 if quick else 128


def _belt(constants):
    """(field, height, place, push, grip) for states of shape (2,); s is the side, 0 in a stick."""
    import jax.numpy as jnp

    f0, grip, damp, cubic, g1, g2, v = constants

    def push(omega, t, x):
        return f0 * jnp.cos(omega * t) - x[0] * (g1 + g2 * x[0] ** 2)

    def field(omega, t, x, s):
        u = x[1] - v
        slip = push(omega, t, x) + u * (damp - cubic * u * u) - s * grip
        return jnp.where(s == 0, jnp.array([v, 0.0]), jnp.array([x[1], slip]))

    return field, lambda x: x[1] - v, lambda x: x.at[1].set(v), push, grip


def _sd(constants):
    """The same five for the SD oscillator at alpha = 0, which crosses the way x2 points."""
    import jax.numpy as jnp

    f0, zeta = constants

    def field(omega, t, x, s):
        return jnp.array([x[1], f0 * jnp.cos(omega * t) - 2 * zeta * x[1] - x[0] + s])

    return field, lambda x: x[0], lambda x: x.at[0].set(0.0), lambda omega, t, x: x[1], 0.0


def _segment(parts, solver, rtol, omega, span, start, x, s):
    """From t in a period to the next contact or the period's end: (time, state, side, landed)."""
    import diffrax as dfx
    import jax.numpy as jnp
    import optimistix as optx

    field, height, place, push, grip = parts

    def margin(t, y, args, **_):
        stick = 1 - (push(omega, t, y) / (grip or 1.0)) ** 2
        return jnp.where(s == 0, stick, s * height(y))

    # direction=False: from positive to not positive; a lane on the surface starts at zero.
    # Newton's method, from the end of the step, runs off on slips whose push turns within the step.
    # flip="detect" raises in batches where only some lanes have an event; True is what we have.
    event = dfx.Event(margin, optx.Bisection(0.0, 1e-12, flip=True), direction=False)
    # On a stick every error estimate is zero: without dtmax a step would leap over the slip.
    longest = jnp.where(s == 0, span / 100, span / 20)
    steps = dfx.PIDController(rtol=rtol, atol=rtol, dtmax=longest)
    sol = dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: field(omega, t, y, s)),
        getattr(dfx, solver)(),
        start,
        span,
        jnp.minimum(span / 200, span - start),
        x,
        stepsize_controller=steps,
        event=event,
        adjoint=dfx.ForwardMode(),
        throw=False,
    )
    time, state = sol.ts[-1], sol.ys[-1]
    landed = dfx.is_event(sol.result)
    # A lane that fails for any other reason is not to pass for a good one.
    state = jnp.where(landed | (sol.result == dfx.RESULTS.successful), state, jnp.nan)
    placed = place(state)
    force = push(omega, time, placed)
    side = jnp.where((s != 0) & (jnp.abs(force) < grip), 0.0, jnp.where(force > 0, 1.0, -1.0))
    return time, jnp.where(landed, placed, state), jnp.where(landed, side, s), landed


@functools.cache
def program(kind, constants, x0, transient, samples, solver, rtol, cores):
    """The compiled function of (omegas, spans) for all lanes."""
    import jax
    import jax.numpy as jnp

    parts = _belt(constants) if kind == "belt" else _sd(constants)

    def lane(omega, span):
        def turn(carry):
            k, t, x, s, out = carry
            t, x, s, landed = _segment(parts, solver, rtol, omega, span, t, x, s)
            saved = out.at[jnp.where(landed, -1, k - transient)].set(x, mode="drop")
            saved = jnp.where(landed | (k < transient), out, saved)
            return k + ~landed, jnp.where(landed, t, 0.0), x, s, saved

        x = jnp.array(x0)
        start = (0, jnp.zeros(()), x, jnp.sign(parts[1](x)), jnp.zeros((samples, 2)))
        return jax.lax.while_loop(lambda c: c[0] < transient + samples, turn, start)[-1]

    lanes = jax.vmap(lane)
    if cores > 1:
        mesh = jax.sharding.Mesh(np.array(jax.devices()), ("lanes",))
        spec = jax.sharding.PartitionSpec("lanes")
        # Each device turns its own loop and waits for no other.
        lanes = jax.shard_map(lanes, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return jax.jit(lanes)


def sample(scene, omegas, transient, samples, setting, cores=1):
    """States at the end of the last `samples` periods, (lanes, samples, 2)."""
    spans = np.array([scene.period(omega) for omega in omegas])
    key = (scene.kind, scene.constants(), scene.x0, transient, samples)
    run = program(*key, setting["solver"], setting["rtol"], cores)
    # Lanes in a row of the sweep behave alike: dealt out in turn, the devices get equal shares.
    width = math.ceil(len(omegas) / cores) * cores
    order = np.resize(np.arange(len(omegas)), width).reshape(-1, cores).T.ravel()
    xs = np.asarray(run(np.asarray(omegas)[order], spans[order]))
    out = np.empty((len(omegas), samples, 2))
    out[order] = xs
    return out
