"""diffrax: `diffeqsolve` with an `Event`, one call for each stay in a mode, in a compiled loop.

A problem, a solver and a tolerance enter; the state at the end leaves, of one lane, or of the
first of a batch whose initial states differ a little.
"""

import functools as ft

from benchmarks import installed
from benchmarks.work_precision.program import LANES, MOST_CONTACTS, Curve, Run, spread

NAME = "diffrax"
SETTINGS = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)


def missing():
    """Why it cannot run; empty where it can."""
    return installed.missing("diffrax")


def curves(problem):
    """The curves that are measured on a problem."""
    for solver, lanes in (("Tsit5", 1), ("Dopri8", 1), ("Tsit5", LANES)):
        run = _compiled(problem, solver, lanes)
        yield Curve(NAME, solver, SETTINGS, ft.partial(_build, run), lanes)


def _build(run, rtol):
    """A function of no arguments for one setting."""
    import jax.numpy as jnp

    return ft.partial(run, jnp.asarray(rtol))


def _compiled(problem, solver, lanes):
    """A function of the tolerance, compiled at its first call."""
    import jax
    import jax.numpy as jnp

    lane = ft.partial(follow, problem, solver)
    many = lane if lanes == 1 else jax.vmap(lane, (0, None))
    return ft.partial(jax.jit(many), jnp.asarray(spread(problem.x0, lanes)))


def by_mode(problem, mode, ask):
    """`ask(mode)` of a mode that is known only while running."""
    import jax

    modes = (-1, 1) if problem.slide is None else (-1, 0, 1)
    index = (mode + 1) // 2 if problem.slide is None else mode + 1
    return jax.lax.switch(index, [ft.partial(ask, m) for m in modes])


def follow(problem, solver, x0, rtol):
    """From contact to contact until t1: state, contacts, steps."""
    import jax
    import jax.numpy as jnp

    def unfinished(carry):
        t, _, _, contacts, _, fine = carry
        return (t < problem.t1) & (contacts < MOST_CONTACTS) & fine

    def stay(carry):
        t, x, mode, contacts, steps, _ = carry
        sol, landed, fine = _segment(problem, solver, rtol, t, x, mode)
        t, x = sol.ts[-1], sol.ys[-1]
        placed = jnp.stack(problem.place(t, x, jnp))
        push = problem.push(t, placed, jnp)
        stuck = (mode != 0) & (abs(push) < problem.grip)
        after = jnp.where(stuck, 0, jnp.where(push > 0, 1, -1))
        return (
            jnp.where(landed, t, problem.t1),
            jnp.where(landed, placed, x),
            jnp.where(landed, after, mode),
            contacts + landed.astype(contacts.dtype),
            steps + sol.stats["num_steps"],
            fine,
        )

    mode = jnp.where(problem.height(0.0, x0, jnp) > 0, 1, -1)
    start = (jnp.zeros(()), x0, mode, jnp.zeros((), int), jnp.zeros((), int), jnp.asarray(True))
    _, x, _, contacts, steps, fine = jax.lax.while_loop(unfinished, stay, start)
    return Run(jnp.where(fine, x, jnp.nan), contacts, steps)


def _segment(problem, solver, rtol, start, x, mode):
    """One mode to its end or to t1: solution, whether a contact ended it, whether it went well."""
    import diffrax as dfx
    import jax.numpy as jnp
    import optimistix as optx

    def rate(t, x, args):
        return by_mode(problem, mode, lambda m: jnp.stack(problem.rate(m, t, x, jnp)))

    def guard(t, y, args, **_):
        return by_mode(problem, mode, lambda m: problem.guard(m, t, y, jnp))

    # direction=False: from positive to not positive; a lane on the surface starts at zero.
    event = dfx.Event(guard, optx.Bisection(0.0, 1e-13, flip=True), direction=False)
    longest = jnp.where(mode == 0, problem.pace, problem.t1)
    sol = dfx.diffeqsolve(
        dfx.ODETerm(rate),
        getattr(dfx, solver)(),
        start,
        problem.t1,
        jnp.minimum(problem.pace / 4, problem.t1 - start),
        x,
        stepsize_controller=dfx.PIDController(rtol=rtol, atol=rtol, dtmax=longest),
        event=event,
        adjoint=dfx.ForwardMode(),
        max_steps=100_000,
        throw=False,
    )
    landed = dfx.is_event(sol.result)
    return sol, landed, landed | dfx.is_okay(sol.result)
