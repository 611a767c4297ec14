"""A reset is the same however it is written: each of JAX's ways to change one number of a state."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

import jaxfil as jf

WAYS = {
    "set": lambda x, k: x.at[k].set(-0.8 * x[k]),
    "multiply": lambda x, k: x.at[k].mul(-0.8),
    "divide": lambda x, k: x.at[k].divide(-1.25),
    "subtract": lambda x, k: x.at[k].subtract(1.8 * x[k]),
    "at least": lambda x, k: x.at[k].max(-0.8 * x[k]),
    "apply": lambda x, k: x.at[k].apply(lambda v: -0.8 * v),
}


class Balls(jf.System):
    """Two balls above a table, which bounce at different times."""

    way: str = "set"

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t), x[3], -jnp.ones_like(t)])

    def switching(self, t, x):
        return x[::2]

    def reset(self, t, x, surface):
        return WAYS[self.way](x, 2 * surface + 1)


class OneBall(jf.System):
    """The first of them, whose place in the state is known."""

    way: str = "set"

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t)])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return WAYS[self.way](x, 1)


def bounced(height, t, e=0.8):
    """The height and velocity of a ball from rest at a height, after one bounce."""
    fall = jnp.sqrt(2 * height)
    flight = t - fall
    return jnp.stack([e * fall * flight - flight**2 / 2, e * fall - flight])


@pytest.mark.slow
@pytest.mark.parametrize(
    "way",
    [
        way if way in ("set", "apply") else pytest.param(way, marks=pytest.mark.release)
        for way in WAYS
    ],
)
def test_a_reset_at_a_known_place(way):
    def end(x0):
        return jf.solve(OneBall(way), x0, 0.0, 2.0, 0.1).x_final

    heights = jnp.array([1.0, 0.9])
    x0 = jnp.stack([heights, 0 * heights], 1)
    assert_allclose(jax.vmap(end)(x0), jax.vmap(bounced, (0, None))(heights, 2.0), rtol=1e-12)
    exact = jax.jacfwd(bounced)(heights[0], 2.0)
    assert_allclose(jax.jacfwd(end)(x0[0])[:, 0], exact, rtol=1e-11)


# Ways are told apart at a known place already.
@pytest.mark.slow
@pytest.mark.parametrize(
    "way",
    [
        way if way in ("set", "apply") else pytest.param(way, marks=pytest.mark.release)
        for way in WAYS
    ],
)
def test_a_reset_at_the_place_of_its_surface(way):
    sol = jf.solve(Balls(way), jnp.array([1.0, 0.0, 0.9, 0.0]), 0.0, 2.0, 0.1)
    both = jnp.concatenate([bounced(1.0, 2.0), bounced(0.9, 2.0)])
    assert_allclose(sol.x_final, both, rtol=1e-12)


class Plate(jf.System):
    """A bullet that loses the energy 4 in a plate at x = 1. The reset is undefined for the state
    after it."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.zeros_like(t)])

    def switching(self, t, x):
        return x[0] - 1

    def reset(self, t, x, surface):
        return jnp.stack([x[0], jnp.sqrt(x[1] ** 2 - 8)])


class Rubbing(jf.System):
    """A ball (z, z', vx, vy) with restitution 1/2 and Coulomb friction in impacts, by a formula
    without a derivative where the ball falls straight down."""

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t), 0 * t, 0 * t])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        slip = x[2:]
        keep = jnp.maximum(1 - 0.45 * jnp.abs(x[1]) / jnp.sqrt(slip @ slip), 0.0)
        return jnp.concatenate([x[:1], -0.5 * x[1:2], keep * slip])


@pytest.mark.parametrize(
    ("system", "x0", "t1", "end"),
    [
        (Plate(), [0.0, 3.0], 1.0, [5 / 3, 1.0]),
        (Rubbing(), [1.0, 0.0, 0.0, 0.0], 2.0, [*bounced(1.0, 2.0, 0.5), 0.0, 0.0]),
    ],
)
@pytest.mark.slow
def test_a_reset_is_asked_only_at_its_contacts(system, x0, t1, end):
    sol = jf.solve(system, jnp.array(x0), 0.0, t1, 0.07)
    assert_allclose(sol.x_final, jnp.stack(end), rtol=0, atol=1e-13)


class Rough(jf.System):
    """A ball in space, z, z', and its slip, above tables at different heights; friction in an
    impact ends the slip in the first one. `root` is the length of the slip as it is written."""

    root: str = "norm"
    num_tables: int = 1
    e: jax.Array | float = 0.5

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -jnp.ones_like(t), 0 * t, 0 * t])

    def switching(self, t, x):
        return x[0] + jnp.arange(1.0 * self.num_tables)

    def reset(self, t, x, surface):
        square = jnp.sum(x[2:] ** 2)
        slip = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        if self.root == "norm":
            slip = jnp.linalg.norm(x[2:])
        keep = jnp.maximum(1 - 3 * jnp.abs(x[1]) / (slip + 1e-12), 0.0)
        return jnp.concatenate([x[:1], -self.e * x[1:2], keep * x[2:]])


@pytest.mark.parametrize("root", ["norm", "where"])
@pytest.mark.parametrize("num_tables", [1, 2, 5])
@pytest.mark.slow
def test_a_rest_needs_the_derivative_of_its_reset(root, num_tables):
    # It falls for a time 1 from 1/2, and bounces for 2e/(1 − e) more; or it starts at rest.
    def run(e, z, x, t1):
        x0 = jnp.stack([z, 0 * z, x, x])
        return jf.solve(Rough(root, num_tables, e), x0, 0.0, t1, 0.05, throw=False)

    e, z = jnp.array([0.0, 0.5, 0.5, 0.5]), jnp.array([0.5, 0.5, 0.5, 0.0])
    sol = jax.vmap(run)(e, z, jnp.array([0.3, 0.3, 0.0, 0.0]), jnp.array([4.0, 4.0, 1.5, 1.0]))
    names = jf.RESULTS.names(sol.result).tolist()
    # At t = 1.5 it still bounces.
    assert_allclose(sol.x_final[2], [0.125, 0.0, 0.0, 0.0], rtol=0, atol=1e-14)
    assert names[2] == "successful"
    if root == "norm":
        # Where several surfaces may spiral into a corner, bounces that die out are followed longer.
        assert names[1] == ("reset_undecided" if num_tables == 1 else "zeno")
        assert names[::3] == ["reset_undecided", "mode_undecided"]
    else:
        assert names == ["successful"] * 4
        assert_allclose(sol.x_final[jnp.array([0, 1, 3])], 0, rtol=0, atol=1e-12)
        assert (sol.mode_final[jnp.array([0, 1, 3]), 0] == 2).all()
