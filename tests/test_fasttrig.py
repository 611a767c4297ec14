"""The vectorising sine and cosine against NumPy's, and the rewrite that puts them in."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfil import fasttrig
from jaxfil.trace import Traced

PAIRS = [(fasttrig.sin, np.sin), (fasttrig.cos, np.cos)]


@pytest.mark.parametrize("fast, exact", PAIRS)
def test_two_ulp_of_one_up_to_a_hundred_thousand(fast, exact):
    x = np.concatenate([np.linspace(-20, 20, 40001), np.linspace(-1e5, 1e5, 200001)])
    assert np.max(np.abs(np.asarray(fast(jnp.asarray(x))) - exact(x))) <= 2 * np.finfo(float).eps


@pytest.mark.parametrize("fast, exact", PAIRS)
def test_error_of_rounding_the_argument_beyond(fast, exact):
    x = np.geomspace(1e5, 1e12, 10001)
    error = np.abs(np.asarray(fast(jnp.asarray(x))) - exact(x))
    assert np.all(error <= np.finfo(float).eps * x)


@pytest.mark.parametrize("fast, exact", PAIRS)
def test_zeros_keep_their_relative_accuracy(fast, exact):
    shift = 0.5 if exact is np.cos else 0.0
    x = np.pi * (np.arange(1, 200) + shift)
    np.testing.assert_allclose(np.asarray(fast(jnp.asarray(x))), exact(x), rtol=1e-15, atol=1e-31)


@pytest.mark.parametrize("fast, exact", PAIRS)
def test_nan_and_inf_give_nan(fast, exact):
    assert np.all(np.isnan(np.asarray(fast(jnp.asarray([np.nan, np.inf, -np.inf])))))


def test_derivatives():
    x = jnp.float64(0.7)
    np.testing.assert_allclose(jax.grad(fasttrig.sin)(x), np.cos(0.7), rtol=1e-15)
    np.testing.assert_allclose(jax.grad(jax.grad(fasttrig.cos))(x), -np.cos(0.7), rtol=1e-15)


def test_the_rewrite_takes_out_every_sine():
    @jax.jit
    def inner(x):
        return jnp.sin(x)

    def function(a, x):
        return a * jnp.cos(x) + inner(x), jnp.where(x > 0, x, jnp.exp(x))

    a, x = jnp.float64(2.0), jnp.linspace(-1.0, 1.0, 5)
    fast = Traced(function, a, x)
    text = str(jax.make_jaxpr(jax.jit(fast))(a, x).jaxpr)
    assert " cos " not in text and " sin " not in text
    for got, expected in zip(fast(a, x), function(a, x), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-15)


def test_dependencies_are_told_component_by_component():
    def function(x, side):
        return jnp.stack([x[1], x[0] * side, jnp.sin(x[0])])

    def components(x, side):
        out = function(x, side)
        return out[0], out[1], out[2]

    traced = Traced(components, jnp.zeros(2), jnp.float64(1.0))
    assert traced.depends(False, True) == (False, True, False)
    assert traced.depends(True, False) == (True, True, True)
