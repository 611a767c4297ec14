"""What holds a mass ends at a tick or a contact: a brake that opens, a door, an edge."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf

G = 9.81
STEPPERS = [diffrax.Dopri8(), jf.Taylor(8)]


class Valve(jf.System):
    """A spool v' = p − F side whose friction F = 2 ends at a tick, from which on the load p grows
    from zero: p' = r, r' = 1. Nothing acts on it at the tick, nor does the load change there."""

    at: jax.Array

    @property
    def clocks(self):
        return (jf.Clock(100.0, self.at),)

    def vector_field(self, t, x, side):
        late = t >= self.at
        level, load = jnp.where(late, 0.0, 2.0), jnp.where(late, 1.0, 0.0)
        return jnp.stack([x[1] - level * side, x[2], load])

    def switching(self, t, x):
        return x[0]


@pytest.mark.parametrize("stepper", STEPPERS, ids=["Dopri8", "Taylor"])
@pytest.mark.slow
def test_a_brake_that_opens_without_a_load_lets_go(stepper):
    """v = s³/6 with s = t − a after the tick at a."""

    def end(at):
        return jf.solve(Valve(at), jnp.zeros(3), 0.0, 2.5, 0.05, stepper=stepper).x_final

    s = 2.5 - np.array([1.0, 0.97])
    values, slopes = jax.vmap(jax.value_and_grad(lambda at: end(at)[0]))(2.5 - jnp.asarray(s))
    np.testing.assert_allclose(values, s**3 / 6, rtol=1e-13)
    np.testing.assert_allclose(slopes, -(s**2) / 2, rtol=1e-13)


class Door(jf.System):
    """A ball on a door, h'' = −g, that opens at a tick: its reset then returns the state."""

    at: jax.Array
    slides = False

    @property
    def clocks(self):
        return (jf.Clock(100.0, self.at),)

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -G + 0 * t, 0 * t])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.where(x[2] > 0.5, x, x.at[1].multiply(-0.5))

    def tick(self, t, x, clock):
        return x.at[2].set(1.0)


@pytest.mark.slow
def test_a_ball_falls_through_a_door_that_opens():
    """From rest, and from a height from which it rests before: h = −g (t − a)²/2."""

    def end(at, h):
        sol = jf.solve(Door(at), jnp.array([h, 0.0, 0.0]), 0.0, 1.5, 0.05, max_events=64)
        return sol.x_final[:2]

    at, heights = jnp.array([1.0, 1.0, 0.93]), jnp.array([0.0, 0.1, 0.1])
    s = 1.5 - np.asarray(at)
    np.testing.assert_allclose(jax.vmap(end)(at, heights).T, [-G * s**2 / 2, -G * s], rtol=1e-13)
    slopes = jax.vmap(jax.jacfwd(end))(at, heights)
    np.testing.assert_allclose(slopes.T, [G * s, G + 0 * s], rtol=1e-12)


class Edge(jf.System):
    """A block (y, y', x, x') slides on a table, rubbing by μ times its reaction, over the edge at
    x = 1; the surface of the edge notes that the block is beyond it."""

    mu: jax.Array

    def vector_field(self, t, x, side, reaction):
        rubs = self.mu * reaction[0] * side[2]
        return jnp.stack([x[1], reaction[0] - G, x[3], -rubs, 0 * t])

    def switching(self, t, x):
        return jnp.stack([x[0], 1 - x[2], x[3]])

    def reset(self, t, x, surface):
        bounced = jnp.where(x[4] > 0.5, x, x.at[1].multiply(-0.5))
        return jnp.where(surface == 0, bounced, jnp.where(surface == 1, x.at[4].set(1.0), x))


@pytest.mark.release
def test_a_block_falls_over_the_edge_of_its_table():
    """x = 2t − μg t²/2 up to the edge, and a parabola after it."""

    def end(mu):
        return jf.solve(Edge(mu), jnp.array([0.0, 0, 0, 2, 0]), 0.0, 1.5, 0.05).x_final

    def fallen(mu):
        at = (2 - jnp.sqrt(4 - 2 * mu * G)) / (mu * G)
        s, speed = 1.5 - at, 2 - mu * G * at
        return jnp.stack([-G * s**2 / 2, -G * s, 1 + speed * s, speed, 1.0 + 0 * s])

    mu = jnp.array(0.1)
    found, expected = ((f(mu), jax.jacfwd(f)(mu)) for f in (end, fallen))
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-11, atol=1e-12)
