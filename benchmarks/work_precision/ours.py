"""jaxfil: `jf.solve` under `jit`, one lane or a batch.

A problem, a stepper and a step length enter; the state at the end leaves. The scenes are those of
`jaxfil.systems`: nothing of the other programs' formulas is used.
"""

import functools as ft

from benchmarks.work_precision.program import LANES, Curve, Run, spread

NAME = "jaxfil"
# Relative tolerances, of which the absolute ones are a thousandth.
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
# How often a problem's longest step is halved.
HALVINGS = {
    "Dopri8": range(6),
    "Taylor8": range(1, 7),
    "Taylor12": range(6),
    "Taylor16": range(6),
    "Tsit5": range(1, 7),
    "RK4": range(2, 8),
}


def missing():
    """Nothing: what is measured is here."""
    return ""


def scenes():
    """{name: (system, the longest step)}."""
    import jaxfil as jf

    systems = jf.systems
    belt = ft.partial(systems.BeltFriction, gamma1=10.0, gamma2=0.0)
    return {
        "sd": (systems.SDOscillator(omega=0.7), 2.0),
        "belt_1": (belt(omega=2.44), 0.8),
        "belt_2": (systems.BeltFriction(omega=4.7), 0.06),
        "belt_2_chaos": (systems.BeltFriction(omega=4.6), 0.06),
        "rotating": (systems.RotatingOscillator(), 0.2),
        "moving_belt": (systems.MovingBelt(), 2.0),
        "slip_stick": (systems.SlipStick(), 1.0),
        "impact": (systems.ImpactOscillator(amplitude=0.5, omega=1.2), 2.0),
    }


def curves(problem):
    """The curves that are measured on a problem."""
    import diffrax

    import jaxfil as jf

    system, longest = scenes()[problem.name]
    steppers = {"Dopri8": diffrax.Dopri8(), "Tsit5": diffrax.Tsit5(), "RK4": jf.RK4()}
    steppers |= {f"Taylor{order}": jf.Taylor(order) for order in (8, 12, 16)}
    alone = [(name, 1) for name in steppers]
    for method, lanes in (*alone, ("Dopri8", LANES), ("Taylor12", LANES)):
        run = _compiled(system, problem, steppers[method], lanes)
        steps = [longest / 2**k for k in HALVINGS[method]]
        yield Curve(NAME, method, steps, ft.partial(_build, run), lanes, unit="dt")
    for method, lanes in (("Dopri8", 1), ("Tsit5", 1), ("Taylor12", 1), ("Dopri8", LANES)):
        build = ft.partial(_adaptive, system, problem, steppers[method], lanes)
        yield Curve(NAME, f"{method}, tolerance", TOLERANCES, build, lanes)


def _adaptive(system, problem, stepper, lanes, rtol):
    """A function of no arguments for one tolerance, which is compiled for it."""
    import jaxfil as jf

    return _compiled(system, problem, stepper, lanes, jf.Adaptive(rtol, 1e-3 * rtol))


def _build(run, dt):
    """A function of no arguments for one setting."""
    import jax.numpy as jnp

    return ft.partial(run, jnp.asarray(dt))


def _compiled(system, problem, stepper, lanes, tolerance=None):
    """A function of the step length, or with a tolerance of nothing, compiled at its first call."""
    import jax
    import jax.numpy as jnp

    import jaxfil as jf

    def lane(x0, dt=tolerance):
        # Run times are compared, and compiling is not: of one lane too the program is written out.
        sol = jf.solve(
            system,
            x0,
            0.0,
            problem.t1,
            dt,
            stepper=stepper,
            max_events=None,
            throw=False,
            compact=False,
        )
        x = jnp.where(sol.result == jf.RESULTS.successful, sol.x_final, jnp.nan)
        return Run(x, sol.num_events, sol.stats["num_iterations"])

    axes = 0 if tolerance else (0, None)
    many = lane if lanes == 1 else jax.vmap(lane, axes)
    return ft.partial(jax.jit(many), jnp.asarray(spread(problem.x0, lanes)))
