"""A mass on a belt that hits a wall: a reset that carries the state across the friction's surface.

Belt speed 1, friction 1, wall at x = w, restitution 1/2, no spring: every flight is a parabola.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf


class BeltAndWall(jf.System):
    """x'' = −sgn(x' − 1), x ≤ w. With `coupling` both surfaces enter one formula, to no effect."""

    wall: jax.Array
    coupling: jax.Array | None = None

    def vector_field(self, t, x, side):
        push = -side[0] if self.coupling is None else -side[0] * (1 + self.coupling * side[1])
        return jnp.stack([x[1], push])

    def switching(self, t, x):
        return jnp.stack([x[1] - 1, self.wall - x[0]])

    def reset(self, t, x, surface):
        return jnp.where(surface == 1, jnp.stack([x[0], -x[1] / 2]), x)


def kinds_of(sol):
    return [jf.EventKind(int(k)).name for k in sol.events.kinds[: sol.num_events]]


@pytest.mark.release
@pytest.mark.parametrize(
    "coupling",
    [None, pytest.param(jnp.zeros(()), marks=pytest.mark.release)],
    ids=["separate", "one formula"],
)
def test_a_stuck_mass_is_carried_into_the_wall(coupling):
    # Stuck at speed 1 until t = 2, back at -1/2, dragged forward: again at t = 3 with 1/2.
    system = BeltAndWall(jnp.float64(2.0), coupling)
    sol = jf.solve(system, jnp.array([0.0, 1.0]), 0.0, 3.2, 0.11)
    np.testing.assert_allclose(sol.events.ts[:3], [2.0, 2.0, 3.0], rtol=1e-13)
    assert kinds_of(sol) == ["impact", "slip", "impact"]
    np.testing.assert_allclose(sol.x_final, [2 - 0.25 * 0.2 + 0.02, -0.05], rtol=0, atol=1e-13)


@pytest.mark.release
@pytest.mark.parametrize("coupling", [None, jnp.zeros(())], ids=["separate", "one formula"])
def test_an_impact_turns_the_friction_round(coupling):
    # Faster than the belt, 2 − t, it hits the wall at 2 − √2 with √2, and comes back slower.
    system = BeltAndWall(jnp.float64(1.0), coupling)
    sol = jf.solve(system, jnp.array([0.0, 2.0]), 0.0, 1.2, 0.1)
    hit, back = 2 - np.sqrt(2), -np.sqrt(0.5)
    np.testing.assert_allclose(sol.events.ts[0], hit, rtol=1e-13)
    assert kinds_of(sol) == ["impact", "carry"]
    s = 1.2 - hit
    np.testing.assert_allclose(
        sol.x_final, [1 + back * s + s * s / 2, back + s], rtol=0, atol=1e-13
    )


@pytest.mark.slow
def test_only_what_a_reset_moves_is_an_impact():
    # It is dragged to the belt's speed and sticks there: a surface on which the reset does nothing.
    system = BeltAndWall(jnp.float64(50.0))
    sol = jf.solve(system, jnp.array([0.1, 0.3]), 0.0, 3.0, 0.13)
    assert int(sol.num_events) == 1
    assert int(sol.events.kinds[0]) == jf.EventKind.stick.value


@pytest.mark.release
def test_the_derivative_goes_through_the_impact():
    def end(wall):
        return jf.solve(BeltAndWall(wall), jnp.array([0.0, 2.0]), 0.0, 1.2, 0.1).x_final

    slope = jax.jacfwd(end)(jnp.float64(1.0))
    h = 1e-6
    change = (end(jnp.float64(1 + h)) - end(jnp.float64(1 - h))) / (2 * h)
    np.testing.assert_allclose(slope, change, rtol=1e-8)
