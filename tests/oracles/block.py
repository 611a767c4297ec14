"""A block on a spring beside a wall: measurements with noise, and its motion in closed form.

It slides with dry friction F beside a wall at x = −d that throws it back by e: between turns and
impacts it moves on circles about −F or F. Values of F and e enter; positions at the times `TS`
leave, in closed form, by SciPy's `solve_ivp`, and with noise.
"""

import jax.numpy as jnp
import numpy as np
import scipy.integrate

import jaxfil as jf

NAMES = "friction", "restitution"
TRUE = np.array([0.12, 0.7])
X0, WALL = (2.0, 0.0), 0.9
TS = np.linspace(0.2, 9.0, 45)
NOISE = 1e-3
# Motions with as many impacts as the best fit's, one more, one fewer, and none.
GUESSES = np.array([[0.1, 0.8], [0.05, 0.9], [0.2, 0.5], [0.6, 0.9]])


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
