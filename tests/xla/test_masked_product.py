"""Derivatives of which a cotangent of zero takes nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxfil.xla.trace import Traced
from jaxfil.xla.valid_derivative import only_if_valid

X = jnp.asarray([0.3, -0.7])


def roots(x):
    """Real in the branch taken alone, and joined by products that pass on what is not."""
    real = jnp.where(x > 0, jnp.sqrt(x) * x[1] * jnp.sin(jnp.log(x)), jnp.sqrt(-x) * x[0] ** 3)
    return jnp.sum(real / (1 + x**2))


def safe(x):
    """The same; a number in both branches."""
    over, under = jnp.where(x > 0, x, 1.0), jnp.where(x > 0, 1.0, -x)
    real = jnp.where(
        x > 0, jnp.sqrt(over) * x[1] * jnp.sin(jnp.log(over)), jnp.sqrt(under) * x[0] ** 3
    )
    return jnp.sum(real / (1 + x**2))


def test_plain_reverse_mode_gives_nan():
    assert np.isnan(jax.grad(Traced(roots, X))(X)).any()


@pytest.mark.slow
@pytest.mark.parametrize("outer", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.release)])
def test_reverse_mode_is_forward_mode(outer):
    traced = Traced(roots, X, transposed=True)
    assert_allclose(traced(X), roots(X), rtol=1e-15)
    for d in (jax.jacfwd, jax.grad, lambda f: outer(jax.grad(f)), lambda f: outer(jax.jacfwd(f))):
        assert_allclose(d(traced)(X), d(safe)(X), rtol=1e-13)
        batch = jax.jit(jax.vmap(d(traced)))(jnp.stack([X, X]))
        assert_allclose(batch, jnp.stack([d(safe)(X)] * 2), rtol=1e-13)


def test_a_cotangent_that_happens_to_be_zero_keeps_its_derivative():
    # Of (√x - 1)²/2 at x = 1, where the first derivative is zero, the second is 1/4.
    traced = Traced(lambda x: (jnp.sqrt(x) - 1) ** 2 / 2, jnp.ones(()), transposed=True)
    for d in (jax.jacfwd, jax.jacrev):
        assert_allclose(d(jax.grad(traced))(1.0), 0.25, rtol=1e-14)


def test_a_function_without_singular_operations_is_left_alone():
    def program(transposed):
        traced = Traced(lambda x: x * jnp.tanh(x), X, transposed=transposed)
        return jax.jit(jax.vjp(traced, X)[1]).lower(X).as_text()

    assert program(True) == program(False)


def overflowing(a, x):
    """A number whose derivatives are not finite where it is not, and whether it is."""
    y = jnp.exp(a * x) * a * x**2
    return jnp.isfinite(y), y


def test_an_invalid_result_takes_nothing_from_what_it_shares():
    x = jnp.asarray([0.5, 1e4, np.nan])

    def total(a):
        y = jax.vmap(lambda x: only_if_valid(overflowing, a, x))(x)
        return jnp.where(jnp.isfinite(y), y, 0.0).sum()

    def right(a):
        return jnp.exp(a * 0.5) * a * 0.25

    for d in (jax.jacfwd, jax.grad, lambda f: jax.jacfwd(jax.grad(f)), jax.hessian):
        assert_allclose(jax.jit(d(total))(0.7), d(right)(0.7), rtol=1e-14)
