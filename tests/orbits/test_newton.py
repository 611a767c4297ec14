"""Newton's iteration on known numbers, in Python, is that of traced ones."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from jaxfil.model.outcomes import RESULTS
from jaxfil.orbits.newton import Evaluation, Stages, root_of

ONES = jnp.ones(2)


def circle_and_line(z):
    """x² + y² = 4 and y = x."""
    residual = jnp.stack([z @ z - 4, z[1] - z[0]])
    jacobian = jnp.stack([2 * z, jnp.array([-1.0, 1.0])])
    return Evaluation(residual, jacobian, ONES, ONES, RESULTS.successful, z[0])


def singular(z):
    return Evaluation(ONES, jnp.ones((2, 2)), ONES, ONES, RESULTS.successful, z[0])


def infinite(z):
    infinity = jnp.full(2, jnp.inf)
    return Evaluation(infinity, jnp.diag(infinity), ONES, ONES, RESULTS.successful, z[0])


@pytest.mark.parametrize(
    "evaluate, result",
    [
        (circle_and_line, RESULTS.successful),
        (singular, RESULTS.newton_singular),
        (infinite, RESULTS.nonfinite),
    ],
)
def test_known_numbers_take_the_same_way(evaluate, result):
    start = jnp.array([3.0, 0.5])
    same = lambda z: z  # noqa: E731
    stages = Stages(same, same, lambda z, done: evaluate(done))
    traced = jax.jit(lambda z: root_of(stages, z, 20, known=False))(start)
    known = root_of(stages, start, 20, known=True)
    assert known.result == traced.result == result
    assert known.num_steps == traced.num_steps
    assert_allclose(known.z, traced.z, rtol=1e-14)
    if result == RESULTS.successful:
        assert_allclose(known.z, [2**0.5, 2**0.5], rtol=1e-14)
        assert known.at.aux == known.z[0]
