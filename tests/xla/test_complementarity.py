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
