"""The exact motions that others are compared with, against closed forms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.oracles import relay_motion, wall_motion
from tests.oracles.relay_modes import Relays, inverse
from tests.oracles.wall_motion import Walls


def test_an_exact_motion_goes_on_from_a_spiral_into_a_point():
    # From (0, 1) each leg of the spiral lasts a third of the last, and all of them 1/2.
    zero, one = np.zeros((2, 2)), np.eye(2)
    system = Relays(zero, np.zeros(2), np.array([[-1, -2], [2, -1]]), zero, one, np.zeros(2))
    motion = relay_motion.propagate(system, [1e-30, 1.0], 2.0, 200, through=True)
    assert motion.outcome == "successful" and motion.mode == (0, 0)
    assert_allclose(float(motion.spans[0][1]), 0.5, rtol=1e-14)
    assert_allclose(motion.x.astype(float), 0, rtol=0, atol=1e-17)
    many = relay_motion.propagate(system, [1e-30, 1.0], 2.0, 10)
    assert many.outcome == "many" and len(many.ts) == 10


@pytest.mark.parametrize("m", [1, 2, 3])
def test_inverse(m):
    matrix = np.random.default_rng(m).normal(size=(m, m))
    assert_allclose(inverse(matrix.astype(np.longdouble)).astype(float), np.linalg.inv(matrix))


@pytest.mark.parametrize("e", [0.0, 0.5, 0.9])
def test_an_exact_ball_comes_to_rest(e):
    a = np.zeros((4, 4))
    a[0, 1] = 1
    system = Walls(a, np.array([0, -2.0, 0, 0]), np.array([0.5]), np.array([e]))
    motion = wall_motion.propagate(system, [1.5, 0, 0, 0], 1, 30.0, 1000)
    assert motion.outcome == "successful" and motion.mode == (2,)
    assert_allclose(float(motion.ts[0]), 1.0, rtol=1e-15)
    assert_allclose(float(motion.spans[0][1]), (1 + e) / (1 - e), rtol=1e-12)
    assert_allclose(motion.x.astype(float), [0.5, 0, 0, 0], rtol=0, atol=1e-18)


def test_an_exact_mass_leaves_its_wall_when_it_is_pulled():
    # q'' = load, load = -cos t: pressed until t = π/2, then q = ∫∫ -cos from there.
    a = np.zeros((4, 4))
    a[0, 1] = a[1, 2] = a[2, 3] = 1
    a[3, 2] = -1
    system = Walls(a, np.zeros(4), np.zeros(1), np.zeros(1))
    motion = wall_motion.propagate(system, [0.01, 0, -1, 0], 1, 3.0, 1000)
    assert motion.kinds[-1] == "slip" and motion.mode == (1,)
    assert_allclose(float(motion.ts[-1]), np.pi / 2, rtol=1e-15)
    assert_allclose(float(motion.x[0]), np.cos(3.0) + (3.0 - np.pi / 2), rtol=1e-13)
