"""Which results of a traced function depend on which of its arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfil.xla.trace import Traced

X = jnp.array([0.7, -1.2, 0.4, 2.1])
SQUARE = jnp.array([[1.0, 0.6], [0.5, -1.0]])


def by_halves(x):
    """Products of matrices as large as their factors."""
    a, b = jnp.diag(x[:2]), jnp.diag(x[2:]) + x[3]
    return (a @ b).ravel()


MIXED = {
    "sort": jnp.sort,
    "cumulative product": jnp.cumprod,
    "cumulative maximum": jax.lax.cummax,
    "cumulative exponentials": jax.lax.cumlogsumexp,
    "conditional": lambda x: jax.lax.cond(x[0] < 9.0, lambda v: v[::-1], lambda v: v, x),
    "loop": lambda x: jax.lax.while_loop(lambda v: v[0] < 5, lambda v: v[::-1] + 3, x),
    "scan": lambda x: jax.lax.scan(lambda c, v: (c + v, c), 0.0, x)[1],
    "checkpoint": jax.checkpoint(lambda x: x[::-1] ** 2),
    "square matrices": by_halves,
    "triangle": lambda x: jnp.linalg.cholesky(x[:2].dot(x[:2]) * SQUARE.T @ SQUARE).ravel(),
    "activation": jax.nn.relu,
    "each by itself": lambda x: jnp.clip(jnp.hypot(x, 2.0), 0.5, 3.0) % 0.3,
    "a number for all": lambda x: x * x[1],
}


@pytest.mark.parametrize("name", MIXED)
def test_a_change_of_one_argument_changes_no_other_results(name):
    """Against the numbers themselves: of an operation that mixes the numbers of an array, as large
    as its result, each result once depended on its own alone."""

    def function(*x):
        return tuple(MIXED[name](jnp.stack(x)))

    traced = Traced(function, *X)
    for k in range(len(X)):
        said = traced.depends(*(i == k for i in range(len(X))))
        changed = [
            np.not_equal(a, b)
            for a, b in zip(function(*X), function(*X.at[k].add(0.3)), strict=True)
        ]
        assert np.all(np.asarray(said) >= np.asarray(changed)), k


@pytest.mark.parametrize("name", ["activation", "each by itself"])
def test_numbers_that_stay_apart_are_known_to_do_so(name):
    traced = Traced(lambda *x: tuple(MIXED[name](jnp.stack(x))), *X)
    assert traced.depends(False, True, False, False) == (False, True, False, False)


def test_numbers_that_are_zero_for_all_arguments_are_known():
    def function(x, p):
        kept = jnp.stack([x[0] * p, 0 * x[0], jnp.zeros_like(p), -(0 * p) + 0.0, x[2] * 0 / p])
        either = jnp.where(x[0] > 0, jnp.stack([x[1], 0.0]), jnp.append(p, 0 * p))
        return jnp.concatenate([kept, either, x.at[1].set(0.0), jnp.array([1.0])])

    found = Traced(function, X, 0.3).zeros()
    assert found.tolist() == [c == "0" for c in "x0000x0x0xxx"]
