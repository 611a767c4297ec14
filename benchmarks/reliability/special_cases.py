"""Cases that are more than one run: restarts, backward runs, derivatives, tables of a run.

Nothing enters; functions leave that return an outcome, an error, the outcome expected, and the
error allowed.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

import jaxfil as jf
from benchmarks.reliability import case_systems as S
from jaxfil.model.outcomes import outcome_names

G = 9.8
GOOD = "successful"


def solve(system, x0, t1, dt=0.1, t0=0.0, **options):
    """A run whose outcome is looked at."""
    return jf.solve(system, jnp.asarray(x0, float), t0, t1, dt, throw=False, **options)


def apart(x, y):
    """The largest deviation."""
    return float(np.abs(np.asarray(x) - np.asarray(y)).max())


def named(sol):
    """Its outcome."""
    return str(outcome_names(sol.result))


def restart(above=0.0):
    """A run that goes on from a recorded impact, or from a little before it."""
    ball = jf.systems.BouncingBall(g=G, restitution=0.5)
    whole = solve(ball, (10, 0), 2.0)
    there = whole.events.xs[0] + jnp.array([above, 0.0])
    later = solve(ball, there, 2.0, t0=whole.events.ts[0])
    return named(later), apart(later.x_final, whole.x_final), GOOD, 1e-12


def backward_impact():
    """Back in time over an impact: told at the impact."""
    ball = jf.systems.BouncingBall(g=G, restitution=0.5)
    back = solve(ball, solve(ball, (10, 0), 2.0).x_final, 0.0, t0=2.0)
    error = abs(float(back.t_final) - np.sqrt(20 / G))
    return named(back), error, "irreversible_reset", 1e-12


def backward_slide():
    """Back in time over a slide: every motion that has slid there may be meant; it ends at t = 1,
    a double root."""
    back = solve(S.FOLD, solve(S.FOLD, (0, 0.3), 1.5, 0.07).x_final, 0.0, 0.07, t0=1.5)
    return named(back), abs(float(back.t_final) - 1), "nonunique", 1e-7


def fall(p, e=0.7, t1=1.0):
    """A ball's end after one impact, by its first height and velocity."""
    s = jnp.sqrt(p[1] ** 2 + 2 * G * p[0])
    left = t1 - (p[1] + s) / G
    return jnp.stack([e * s * left - G * left**2 / 2, e * s - G * left])


def hessian():
    """Second derivatives over an impact."""
    ball, p = jf.systems.BouncingBall(g=G, restitution=0.7), jnp.array([1.0, 0.3])
    end = lambda p: jf.solve(ball, p, 0.0, 1.0, 0.1, throw=False).x_final  # noqa: E731
    error = apart(jax.jacfwd(jax.jacfwd(end))(p), jax.jacfwd(jax.jacfwd(fall))(p))
    return named(solve(ball, p, 1.0)), error, GOOD, 1e-9


def dense():
    """A dense solution at as many times as there are states: 2.6 cos t + 0.4 until it turns."""
    sol = solve(jf.systems.CoulombOscillator(), (3, 0), 3.0, saveat=diffrax.SaveAt(dense=True))
    ts = jnp.array([0.05, 2.95])
    want = np.stack([2.6 * np.cos(ts) + 0.4, -2.6 * np.sin(ts)], axis=-1)
    return named(sol), apart(sol.evaluate(ts), want), GOOD, 1e-12


def saving_time():
    """The derivative by a saving time that is a grid point is the field."""

    def saved(t):
        saveat = diffrax.SaveAt(ts=t[None])
        return solve(jf.systems.CoulombOscillator(), (3, 0), 3.0, saveat=saveat).xs[0]

    slope = jax.jacfwd(saved)(jnp.asarray(1.0))
    want = -2.6 * np.sin(1.0), -2.6 * np.cos(1.0)
    return GOOD, apart(slope, want), GOOD, 1e-10


def side_not_taken():
    """Reverse mode where the other side's field is not a number: (1 - t/2)² below x = 1."""
    system = S.Switched(
        lambda t, x, side, p: jnp.where(side > 0, p * jnp.sqrt(x - 1), -p * jnp.sqrt(1 - x) / 2),
        lambda t, x: x[0] - 1,
        jnp.asarray(1.0),
    )
    x0, adjoint = jnp.array([0.0]), diffrax.RecursiveCheckpointAdjoint()
    # √(1 - x) = 1 + t/4
    end = lambda x: jf.solve(system, x, 0.0, 1.0, 0.1, adjoint=adjoint).x_final[0]  # noqa: E731
    error = apart(jax.grad(end)(x0), 1.25) + apart(end(x0), 1 - 1.25**2)
    return GOOD, np.inf if np.isnan(error) else error, GOOD, 1e-9


def ramp(system):
    """A comparator with a ramp that falls to zero at every whole time: H jumps there."""
    sol = solve(system, (0.5,), 2.5, 0.1)
    x, t, ts = 0.5, 0.0, []
    for _ in range(3):
        crossed = brentq(lambda s, x=x: s - x * np.exp(-s), 0, 1, xtol=1e-15)
        x, ts = x * np.exp(-crossed), [*ts, t + crossed]
        left = min(1.0, 2.5 - t) - crossed
        if left > 0:
            x = 1 - (1 - x) * np.exp(-left)
        t, ts = t + 1, [*ts, t + 1]
    count = int(sol.num_events)
    wrong = count != sum(at < 2.5 for at in ts)
    error = np.inf if wrong else apart(sol.events.ts[:count], ts[:count])
    return named(sol), max(error, apart(sol.x_final, x)), GOOD, 1e-10


FIRST = [[-1.049, -0.552], [-0.499, 1.619], [1.948, -2.383], [0.941, -2.554]]
SECOND = [[-1.132, -0.664], [-0.543, 1.752], [2.138, -2.442], [0.910, -2.660]]


def weights(t):
    """Where the blend of the rates vanishes within [-1, 1]²."""
    rows = np.asarray(FIRST) + (np.asarray(SECOND) - FIRST) * min(t, 1.0)
    a, b = rows.sum(axis=0), rows[0] + rows[1] - rows[2] - rows[3]
    c, d = rows[0] - rows[1] + rows[2] - rows[3], rows[0] - rows[1] - rows[2] + rows[3]
    cross = lambda u, v: u[0] * v[1] - u[1] * v[0]  # noqa: E731
    # a + b w = -(c + d w) v: both components for one v.
    roots = np.roots([cross(b, d), cross(a, d) + cross(b, c), cross(a, c)]).real
    pairs = [(w, -((a + b * w) @ (c + d * w)) / ((c + d * w) @ (c + d * w))) for w in roots]
    (inside,) = [p for p in pairs if max(map(abs, p)) <= 1]
    return inside


def root_inside():
    """A slide on an intersection whose blend has a root outside of [-1, 1]² too."""
    sol = solve(S.blend([FIRST, SECOND]), np.zeros(4), 3.0)
    accuracy = {"points": [1.0], "epsabs": 1e-13, "epsrel": 1e-13}
    want = [quad(lambda t, i=i: weights(t)[i], 0, 3, **accuracy)[0] for i in (0, 1)]
    return named(sol), apart(sol.x_final, [0, 0, *want]), GOOD, 1e-11


def negative_period():
    """A sweep over a frequency through zero refuses the lane whose period is negative."""
    diagram = jf.bifurcation_diagram(
        jf.systems.SDOscillator(), "omega", jnp.array([0.7, -0.7]), jnp.array([0.3, 0.1]),
        transient=2, samples=1, steps=20, progress=False,
    )  # fmt: skip
    first, second = outcome_names(diagram.results)
    return str(second), 0.0 if first == GOOD else np.inf, "invalid_period", 0.0


CASES = (
    ("starts and restarts", "a recorded impact", restart),
    ("starts and restarts", "1e-15 above a recorded impact", lambda: restart(1e-15)),
    ("not unique", "backward over an impact", backward_impact),
    ("not unique", "backward over a slide", backward_slide),
    ("not unique", "the root inside, on an intersection", root_inside),
    ("derivatives and tables", "second derivatives over an impact", hessian),
    ("derivatives and tables", "a dense solution at an array of times", dense),
    ("derivatives and tables", "by a saving time on the grid", saving_time),
    ("derivatives and tables", "reverse mode, a side that is not a number", side_not_taken),
    ("steps and contacts", "a ramp that falls to zero", lambda: ramp(S.Ramp())),
    ("steps and contacts", "the same, slides = False", lambda: ramp(S.CrossedRamp())),
    ("steps and contacts", "a negative period", negative_period),
)
