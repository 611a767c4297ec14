"""A train that takes up its slack: impacts that run to and fro between bodies that touch, beside
friction that holds what they have not reached."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf

MASS, FRICTION, SLACK, PULL = slice(0, 3), slice(3, 6), slice(6, 8), 8


class Train(jf.System):
    """A locomotive and two wagons with rolling friction, couplings with slack, plastic when they
    are taut, and buffers. A light one has friction on the last wagon alone, and no buffers."""

    p: jax.Array
    light: bool = eqx.field(static=True)

    def vector_field(self, t, x, side):
        pull = self.p[PULL] * jnp.array([1.0, 0, 0])
        rubs = jnp.array([0.0, 0, 1]) * side[0] if self.light else side[:3]
        return jnp.concatenate([x[3:], (pull - self.p[FRICTION] * rubs) / self.p[MASS]])

    def switching(self, t, x):
        apart = x[:2] - x[1:3]
        if self.light:
            return jnp.concatenate([x[5:], self.p[SLACK] - apart])
        return jnp.concatenate([x[3:], self.p[SLACK] - apart, apart])

    def reset(self, t, x, surface):
        rubbing = 1 if self.light else 3
        i, body = (surface - rubbing) % 2, jnp.arange(3, dtype=surface.dtype)
        pair = (body == i) | (body == i + 1)
        mass = jnp.where(pair, self.p[MASS], 0.0)
        v = jnp.where(pair, jnp.sum(mass * x[3:]) / jnp.sum(mass), x[3:])
        return jnp.where(surface < rubbing, x, jnp.concatenate([x[:3], v]))


def end_of_train(p, t1):
    """The state at t1 from standstill with closed buffers, body by body: all that moves has one
    velocity, and momentum is conserved."""
    x, v, mass, friction, t = np.zeros(3), 0.0, p[0], p[3], 0.0
    for k in range(1, 4):
        a = (p[PULL] - friction) / mass
        gap = p[SLACK][k - 1] - (x[k - 1] - x[k]) if k < 3 else np.inf
        step = min(2 * gap / (v + np.sqrt(v * v + 2 * a * gap)) if k < 3 else np.inf, t1 - t)
        x[:k] += v * step + a * step * step / 2
        v, t = v + a * step, t + step
        if k < 3:
            v, mass, friction = v * mass / (mass + p[k]), mass + p[k], friction + p[3 + k]
    return np.concatenate([x, np.full(3, v)])


@pytest.mark.release
@pytest.mark.parametrize("light", [True, False])
def test_a_train_takes_up_its_slack(light):
    ps = np.array(
        [[3, 1, 2, 0.3, 0.2, 0.25, 0.1, 0.15, 2], [1, 2, 1.5, 0.1, 0.3, 0.2, 0.2, 0.05, 1.5]]
    )
    if light:
        ps[:, 3:5] = 0.0

    def end(p):
        train = Train(p, light)
        sol = jf.solve(train, jnp.zeros(6), 0.0, 2.0, 0.1, max_events=None, throw=False)
        return sol.x_final, (sol.x_final, sol.result)

    slopes, (ends, results) = jax.jit(jax.vmap(jax.jacfwd(end, has_aux=True)))(jnp.asarray(ps))
    assert np.all(np.asarray(results == jf.RESULTS.successful))
    h, of = 1e-6, [k for k in range(9) if not (light and k in (3, 4))]
    for p, found, slope in zip(ps, ends, slopes, strict=True):
        assert_allclose(found, end_of_train(p, 2.0), rtol=0, atol=1e-12)
        beside = [(end_of_train(p + d, 2.0) - end_of_train(p - d, 2.0)) / (2 * h)
                  for d in h * np.eye(9)[of]]  # fmt: skip
        assert_allclose(slope[:, of], np.stack(beside, axis=1), rtol=0, atol=1e-8)
