"""The relay with a damped side, x'' = 2 cos 1.3t − x − F s − d max(x', 0), by diffrax and SciPy.

Damping, friction, an initial state, a span and a tolerance enter; the state at the end leaves. One
mode at a time, s = ±1 or 0 in a stick, each until its event, in a loop.
"""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np

OMEGA = 1.3
# On the damped side x' is of the size of 1/d: an error of that size would be a contact.
SMALL = 1e-6


def _push(t, x, xp):
    """The force that friction has to hold."""
    return 2 * xp.cos(OMEGA * t) - x[0]


def _next_side(t, x, side, friction, xp):
    """The mode after a contact."""
    force = float(_push(t, x, xp))
    return 0.0 if side != 0 and abs(force) < friction else float(np.sign(force))


@ft.cache
def _segment(rtol):
    """diffrax's Kvaerno5 to the end of one mode, compiled for a tolerance."""
    import diffrax as dfx
    import optimistix as optx

    def field(t, x, args):
        s, damping, friction = args
        slip = _push(t, x, jnp) - friction * s - damping * jnp.where(s > 0, x[1], 0.0)
        return jnp.where(s == 0, 0.0, jnp.stack([x[1], slip]))

    def margin(t, y, args, **_):
        s, _, friction = args
        return jnp.where(s == 0, friction**2 - _push(t, y, jnp) ** 2, s * y[1])

    @jax.jit
    def segment(t, t1, x, args):
        sol = dfx.diffeqsolve(
            dfx.ODETerm(field),
            dfx.Kvaerno5(),
            t,
            t1,
            1e-6,
            x,
            args,
            # A stick has no error and would be leapt over.
            stepsize_controller=dfx.PIDController(rtol=rtol, atol=SMALL * rtol, dtmax=0.1),
            event=dfx.Event(margin, optx.Bisection(0.0, 1e-13, flip=True), direction=False),
            adjoint=dfx.ForwardMode(),
            max_steps=100_000,
            throw=False,
        )
        return sol.ts[-1], sol.ys[-1], dfx.is_event(sol.result), dfx.is_okay(sol.result)

    return segment


def kvaerno_events(damping, friction, x0, t1, rtol):
    """diffrax's Kvaerno5 with an `Event`, mode by mode."""
    t, x, side = jnp.zeros(()), jnp.asarray(x0), 1.0
    for _ in range(100):
        args = jnp.asarray([side, damping, friction])
        t, x, hit, fine = _segment(rtol)(t, jnp.asarray(t1), x, args)
        if not fine:
            return jnp.full(2, jnp.nan)
        if not hit:
            return x
        x = x.at[1].set(0.0)
        side = _next_side(float(t), np.asarray(x), side, friction, np)
    return jnp.full(2, jnp.nan)


@ft.cache
def _smooth(rtol):
    """diffrax's Kvaerno5 on a smoothed system, compiled for a tolerance."""
    import diffrax as dfx

    @jax.jit
    def run(system, x0, t1):
        sol = dfx.diffeqsolve(
            dfx.ODETerm(lambda t, x, system: system.vector_field(t, x, jnp.ones(()))),
            dfx.Kvaerno5(),
            0.0,
            t1,
            1e-6,
            x0,
            system,
            stepsize_controller=dfx.PIDController(rtol=rtol, atol=rtol),
            adjoint=dfx.ForwardMode(),
            max_steps=100_000,
            throw=False,
        )
        return jnp.where(dfx.is_okay(sol.result), sol.ys[-1], jnp.nan)

    return run


def kvaerno_smooth(system, x0, t1, rtol):
    """diffrax's Kvaerno5 on a smoothed system, adaptive."""
    return _smooth(rtol)(system, jnp.asarray(x0), t1)


def radau_events(damping, friction, x0, t1, rtol):
    """SciPy's Radau with terminal events, mode by mode."""
    from scipy.integrate import solve_ivp

    t, x, side = 0.0, np.asarray(x0, float), 1.0
    for _ in range(100):

        def field(t, x, s=side):
            slip = _push(t, x, np) - friction * s - damping * (x[1] if s > 0 else 0.0)
            return [0.0, 0.0] if s == 0 else [x[1], slip]

        def jacobian(t, x, s=side):
            slip = [-1.0, -damping if s > 0 else 0.0]
            return np.zeros((2, 2)) if s == 0 else np.array([[0.0, 1.0], slip])

        def margin(t, y, s=side):
            return friction**2 - _push(t, y, np) ** 2 if s == 0 else s * y[1]

        margin.terminal, margin.direction = True, -1
        sol = solve_ivp(
            field,
            (t, t1),
            x,
            "Radau",
            events=margin,
            rtol=rtol,
            atol=SMALL * rtol,
            jac=jacobian,
            max_step=0.1,
        )
        t, x = sol.t[-1], sol.y[:, -1].copy()
        if sol.status != 1:
            return x if sol.status == 0 else np.full(2, np.nan)
        x[1] = 0.0
        side = _next_side(t, x, side, friction, np)
    return np.full(2, np.nan)
