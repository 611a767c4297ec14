"""What a user looks at while a run is under way: `jax.debug.print` and `jax.debug.callback` in the
functions of a system show the numbers that these are given, and change nothing of the motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import jaxfil as jf

SEEN = []
X0 = jnp.array([3.0, 0.1])


class Watched(jf.System):
    """A mass on dry friction under a force, whose functions show what they are given."""

    friction: jax.Array
    looks: bool = True

    def vector_field(self, t, x, side):
        # A gather among the operations, so that they are rewritten too: see `jaxfil.xla.moves`.
        v = x[jnp.array([1])][0]
        if self.looks:
            jax.debug.callback(lambda *seen: SEEN.append(seen), t, x, side)
            jax.debug.print("at t = {t}", t=t)
        return jnp.stack([v, jnp.cos(t) - x[0] - self.friction * side])

    def switching(self, t, x):
        if self.looks:
            jax.debug.callback(lambda v: SEEN.append((v,)), x[1])
        return x[1]


def end(friction, x0=X0, looks=True, **options):
    options = {"stepper": jf.RK4(), "max_events": 8} | options
    return jf.solve(Watched(friction, looks), x0, 0.0, 0.5, 0.25, **options).xs[-1]


@pytest.fixture(autouse=True)
def nothing_seen():
    SEEN.clear()


@pytest.mark.slow
@pytest.mark.parametrize("compact", [True, False])
def test_a_system_shows_what_it_is_given(compact, capfd):
    friction = jnp.array(0.4)
    found = end(friction, compact=compact)
    jax.effects_barrier()
    assert_array_equal(found, end(friction, looks=False, compact=compact))
    t, x, side = next(seen for seen in SEEN if len(seen) == 3)
    assert t.shape == () and x.shape == (2,) and side in (-1.0, 1.0)
    assert 0.0 <= float(t) <= 0.5 and np.all(abs(x - X0) < 0.5)
    assert any(len(seen) == 1 for seen in SEEN)
    assert "at t = 0.25" in capfd.readouterr().out


def test_it_shows_each_lane_of_a_batch():
    ends = jax.vmap(lambda x: end(jnp.array(0.4), x))(X0 + jnp.arange(3.0)[:, None])
    jax.effects_barrier()
    lanes = {round(float(seen[1][0])) for seen in SEEN if len(seen) == 3}
    assert ends.shape == (3, 2) and {3, 4, 5} <= lanes


@pytest.mark.slow
def test_it_shows_them_while_derivatives_are_taken():
    def height(friction, looks):
        return end(friction, looks=looks)[0]

    found = jax.value_and_grad(height)(jnp.array(0.4), True)
    jax.effects_barrier()
    assert_array_equal(found, jax.value_and_grad(height)(jnp.array(0.4), False))
    assert SEEN
