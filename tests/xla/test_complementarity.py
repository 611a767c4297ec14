"""Variational inequalities on a box, against solutions by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfil.xla.complementarity import solve_on_box

# A pile of four blocks of unit mass. The reaction between two of them carries all that lie above.
PILE = 2 * np.eye(4) - np.eye(4, k=1) - np.eye(4, k=-1)
PILE[0, 0] = 1.0


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_reactions_are_found_in_any_units(dtype):
    eps = np.finfo(dtype).eps
    unit = np.array([1.0, 1e-18, 1e18], dtype)
    q = -np.array([1.0, 0, 0, 0], dtype) * unit[:, None]
    low, high = np.zeros(4, dtype), np.full(4, np.inf, dtype)
    solve = jax.vmap(lambda q: solve_on_box(q, jnp.asarray(PILE, dtype), low, high))
    z, found = solve(jnp.asarray(q))
    assert found.all() and z.dtype == dtype
    np.testing.assert_allclose(z / unit[:, None], [[4, 3, 2, 1]] * 3, rtol=64 * eps)


def test_a_solution_within_rounding_of_a_bound_is_at_it():
    bound = 0.5 + 1e-15
    z, found = solve_on_box(
        -jnp.array([3.0, 0.5]), jnp.eye(2), jnp.zeros(2), jnp.array([9.0, bound])
    )
    assert found and z.tolist() == [3.0, bound]


def test_three_blocks_that_nothing_pushes_on_each_other():
    # The weights of the last two, and the reactions between all, are zero to within rounding.
    matrix = [
        [1 / 10, 0, 0, -1 / 4, 0],
        [0, 1 / 5, 0, 3 / 4, -2 / 3],
        [0, 0, 1 / 8, 0, 1 / 3],
        [-1 / 10, 1 / 5, 0, 1, -2 / 3],
        [0, -1 / 5, 1 / 8, -3 / 4, 1],
    ]
    q = jnp.array([-1 / 30, 0, 0, 1 / 30, 0])
    low, high = jnp.array([-1.0, -1, -1, 0, 0]), jnp.array([1, 1, 1, jnp.inf, jnp.inf])
    z, found = solve_on_box(q, jnp.array(matrix), low, high)
    assert found
    np.testing.assert_allclose(z, [1 / 3, 0, 0, 0, 0], atol=1e-14)
