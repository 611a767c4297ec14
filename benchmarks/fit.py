"""`python -m benchmarks.fit`: friction and restitution of a block from noisy measurements.

A block on a spring slides with dry friction F beside a wall at x = −d that throws it back by e:
between turns and impacts it moves on circles about −F or F. Nothing enters; `results/fit.txt`
leaves: what `jf.fit` finds from four guesses, and SciPy's `least_squares` over `solve_ivp` with
located contacts, each against the best fit of the motion in closed form, with processor times.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.optimize

import jaxfil as jf
from benchmarks import RESULTS
from benchmarks.table import Column, table

NAMES = "friction", "restitution"
TRUE = np.array([0.12, 0.7])
X0, WALL = (2.0, 0.0), 0.9
TS = np.linspace(0.2, 9.0, 45)
NOISE = 1e-3
# Motions with as many impacts as the best fit's, one more, one fewer, and none.
GUESSES = np.array([[0.1, 0.8], [0.05, 0.9], [0.2, 0.5], [0.6, 0.9]])
COLUMNS = (
    Column("program"),
    Column("guess"),
    Column("friction", "<.12f"),
    Column("restitution", "<.12f"),
    Column("off the best fit", ">.1e"),
    Column("sum of squares", ">.3e"),
    Column("first s", ">.2f"),
    Column("then s", ">.3f"),
)
TITLE = "Friction and restitution from 45 measurements with noise of 1e-3 (0.12 and 0.7 in truth)"
NOTE = """\
off the best fit: largest distance from that of the motion in closed form by least_squares at 1e-15.
Times are processor times, of all four guesses for jaxfil, which searches from all of them in one
call, and compiles in the first. solve_ivp: DOP853 at rtol = 1e-9, stopped at every turn and impact;
least_squares takes its derivatives by differences, as it does by itself. A guess with an impact too
few ends in another best fit, which has an impact too few as well: in both programs. Where there is
no impact at all nothing says what the restitution is, and it stays what it was."""


class Block(jf.System):
    """The block; both of its surfaces."""

    friction: float
    restitution: float
    wall: float = WALL

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - self.friction * side[0]])

    def switching(self, t, x):
        return jnp.stack([x[1], x[0] + self.wall])

    def reset(self, t, x, surface):
        return jnp.stack([x[0], jnp.where(surface == 1, -self.restitution * x[1], x[1])])


def seen(t, x):
    """What is measured."""
    return x[0]


def motion(values, ts=TS):
    """x at the times, piece by piece."""
    friction, restitution = values
    t, (x, v), side, found = 0.0, X0, -1.0, np.full_like(ts, np.nan)
    while np.isnan(found).any():
        c = -friction * side
        radius, phase = np.hypot(x - c, v), np.arctan2(-v, x - c)  # x = c + radius cos(τ + phase)
        turn = (np.pi - phase if side < 0 else -phase) % (2 * np.pi) or np.pi
        meets = side < 0 and radius > WALL + c
        hit = np.arccos((-WALL - c) / radius) - phase if meets else np.inf
        span = min(turn, hit)
        now = (ts >= t) & (ts <= t + span)
        found[now] = c + radius * np.cos(ts[now] - t + phase)
        t, x, v = t + span, c + radius * np.cos(span + phase), -radius * np.sin(span + phase)
        if hit < turn:
            x, v, side = -WALL, -restitution * v, 1.0
        else:
            v, side = 0.0, -side
            if abs(x) <= friction:  # it sticks
                found[ts > t] = x
    return found


def data():
    """Measurements of the true motion."""
    return motion(TRUE) + NOISE * np.random.default_rng(0).normal(size=TS.size)


def stepped(values, ts=TS):
    """The same by `solve_ivp`, stopped at every turn and impact."""
    friction, restitution = values
    t, x, side, found = 0.0, np.asarray(X0), -1.0, np.full_like(ts, np.nan)

    def turn(t, x):
        return x[1] if t > start else -side

    def hit(t, x):
        return x[0] + WALL

    turn.terminal = hit.terminal = True
    hit.direction = -1.0
    while np.isnan(found).any():
        start = t
        turn.direction = -side
        field = lambda t, x, side=side: [x[1], -x[0] - friction * side]  # noqa: E731
        run = scipy.integrate.solve_ivp(
            field,
            (t, max(ts[-1] + 1e-9, t + 1e-9)),
            x,
            method="DOP853",
            rtol=1e-9,
            atol=1e-12,
            events=(turn, hit),
            dense_output=True,
        )
        now = (ts >= t) & (ts <= run.t[-1])
        found[now] = run.sol(ts[now])[0]
        t, x = run.t[-1], run.y[:, -1]
        if run.t_events[1].size:
            x, side = np.array([-WALL, -restitution * x[1]]), 1.0
        else:
            x, side = np.array([x[0], 0.0]), -side
            if abs(x[0]) <= friction:
                found[ts > t] = x[0]
    return found


def timed(call):
    """What a call gives, and its processor time."""
    start = time.process_time()
    found = jax.block_until_ready(call())
    return found, time.process_time() - start


def measure():
    """The rows of the table."""
    measured = data()
    best = scipy.optimize.least_squares(
        lambda v: motion(v) - measured, TRUE, x_scale=TRUE, xtol=1e-15, ftol=1e-15
    ).x

    def fit():
        start = Block(0.1, 0.8)
        given = {"observe": seen, "guesses": GUESSES, "throw": False}
        return jf.fit(start, NAMES, TS, measured, jnp.asarray(X0), 0.05, **given)

    (found, first), (_, then) = timed(fit), timed(fit)
    for i, guess in enumerate(GUESSES):
        values = np.asarray(found.all_values[i])
        times = (first, then) if i == 0 else (None, None)
        off = np.max(abs(values - best))
        yield "jaxfil", str(guess), *values, off, 2 * float(found.costs[i]), *times
    for guess in GUESSES:
        ended, seconds = timed(
            lambda guess=guess: scipy.optimize.least_squares(lambda v: stepped(v) - measured, guess)
        )
        off = np.max(abs(ended.x - best))
        yield "SciPy", str(guess), *ended.x, off, 2 * ended.cost, None, seconds


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    text = table(COLUMNS, measure(), TITLE, NOTE)
    print(text)
    (RESULTS / "fit.txt").write_text(f"{text}\n")
