"""Which functions are told to be affine in some of their arguments."""

import jax.numpy as jnp
import pytest
from jax.scipy.linalg import solve_triangular

from jaxfil.xla.trace import Traced

MATRIX = jnp.arange(9.0).reshape(3, 3)
AFFINE = {
    "product with a matrix": lambda x, s: MATRIX @ s - x,
    "scattered": lambda x, s: x.at[0].add(s[1]).at[2].set(s[0]),
    "chosen by the state": lambda x, s: jnp.where(x > 0, x, 2 * s) / (1 + x * x),
    "moved and summed": lambda x, s: jnp.roll(s, 1) * jnp.sin(x) + jnp.sum(s) - jnp.cumsum(s),
    "solved for": lambda x, s: jnp.linalg.solve(MATRIX + 3 * jnp.eye(3), x - s) + x,
    "an inverse": lambda x, s: jnp.linalg.inv(MATRIX + x * jnp.eye(3)) @ s,
    "solved for with a triangle": lambda x, s: solve_triangular(jnp.eye(3), s, lower=True),
    "of none": lambda x, s: x**3,
}
CURVED = {
    "a product of two": lambda x, s: x * s[0] + s[1] * s[2],
    "a choice by a side": lambda x, s: jnp.where(s > 0, x, 2 * x),
    "a quotient": lambda x, s: x / (2 + s),
    "a power": lambda x, s: s**2,
    "an absolute value": lambda x, s: abs(s) * x,
    "cut off": lambda x, s: x * s.astype(int).astype(x.dtype),
    "a matrix of a solution": lambda x, s: jnp.linalg.solve(jnp.diag(2 + s), MATRIX[0]),
    "an exponential": lambda x, s: jnp.exp(s),
}


def affine(function):
    one = jnp.ones(())
    traced = Traced(lambda x, *s: function(x, jnp.stack(s)), jnp.ones(3), one, one, one)
    return traced.is_affine(False, True, True, True)


@pytest.mark.parametrize("function", AFFINE.values(), ids=AFFINE.keys())
def test_affine(function):
    assert affine(function)


@pytest.mark.parametrize("function", CURVED.values(), ids=CURVED.keys())
def test_not_affine(function):
    assert not affine(function)
