"""diffrax on the smoothed problem: sgn H replaced by tanh(H/width), adaptive, no events.

A problem, a solver, a width and a tolerance enter; the state at the end leaves. However small the
tolerance, the error stops at that of the width.
"""

import functools as ft

from benchmarks import installed
from benchmarks.work_precision.program import Curve, Run

NAME = "smoothed"
# An explicit method's step is bound by the width where the state slides; an implicit one is dear.
WIDTHS = {"Tsit5": (1e-2, 1e-3, 1e-4), "Kvaerno5": (1e-4, 1e-5)}
TOLERANCES = {"Tsit5": (1e-4, 1e-6, 1e-8, 1e-10), "Kvaerno5": (1e-4, 1e-6, 1e-8)}


def missing():
    """Why it cannot run; empty where it can."""
    return installed.missing("diffrax")


def curves(problem):
    """The curves that are measured on a problem."""
    if problem.impacts:
        return
    for solver, widths in WIDTHS.items():
        run = _compiled(problem, solver)
        for width in widths:
            build = ft.partial(_build, run, width)
            yield Curve(NAME, f"{solver}, width {width:.0e}", TOLERANCES[solver], build)


def _build(run, width, rtol):
    """A function of no arguments for one setting."""
    import jax.numpy as jnp

    return ft.partial(run, jnp.asarray(width), jnp.asarray(rtol))


def _compiled(problem, solver):
    """A function of width and tolerance, compiled at its first call."""
    import diffrax as dfx
    import jax
    import jax.numpy as jnp

    def rate(t, x, width):
        side = jnp.tanh(problem.height(t, x, jnp) / width)
        return jnp.stack(problem.field(t, x, side, jnp))

    def run(width, rtol):
        sol = dfx.diffeqsolve(
            dfx.ODETerm(rate),
            getattr(dfx, solver)(),
            0.0,
            problem.t1,
            1e-3,
            jnp.asarray(problem.x0),
            width,
            stepsize_controller=dfx.PIDController(rtol=rtol, atol=rtol),
            adjoint=dfx.ForwardMode(),
            max_steps=10_000_000,
            throw=False,
        )
        fine = dfx.is_okay(sol.result)
        return Run(jnp.where(fine, sol.ys[-1], jnp.nan), 0, sol.stats["num_steps"])

    return jax.jit(run)
