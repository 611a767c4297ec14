"""Functions evaluated element by element, against themselves on arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxfil.xla.trace import Traced
from tests.xla.operations import names

A = np.random.default_rng(0).normal(size=(3, 3))
T, X = 0.7, (0.3, -1.2, 2.0)


def chain(t, x):
    """Springs between neighbours, each driven with a phase of its own."""
    q = jnp.stack(x)
    ends = jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)])
    pull = ends[2:] - 2 * q + ends[:-2]
    driven = pull + jnp.cos(2 * t + jnp.arange(3.0))
    return tuple(jnp.where(q > 0, driven, driven**2)[i] for i in range(3))


def matrix(t, x):
    """Products of matrices, transposes and sums."""
    q = jnp.stack(x)
    squares = jnp.outer(q, q).T + A
    y = A @ q + jnp.sum(squares, axis=0) / jnp.maximum(q @ q, 0.1)
    return tuple(y[::-1][i] for i in range(3))


def large(t, x):
    """An array that has too many numbers to be taken apart, and one that is padded."""
    q = jnp.stack(x)
    wide = jnp.broadcast_to(q, (40, 3)) * jnp.arange(40.0)[:, None]
    y = wide.sum(0) + jnp.pad(q, 1)[:3] * jnp.cumsum(q)
    return tuple(y[i] for i in range(3))


@pytest.mark.slow
@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("function", [chain, matrix, large])
def test_values_and_derivatives_are_those_of_arrays(function, fast):
    traced = Traced(function, T, X, fast=fast)
    assert_allclose(traced(T, X), function(T, X), rtol=1e-14)
    assert_allclose(jax.jit(traced)(T, X), function(T, X), rtol=1e-14)
    for differentiate in (jax.jacfwd, jax.jacrev):
        got, want = (
            differentiate(lambda x, f=f: jnp.stack(f(T, x)))(X) for f in (traced, function)
        )
        assert_allclose(got, want, rtol=1e-13)
    many = tuple(jnp.linspace(v, v + 1, 5) for v in X)
    got, want = (jax.vmap(lambda x, f=f: jnp.stack(f(T, x)))(many) for f in (traced, function))
    assert_allclose(got, want, rtol=1e-14)


def test_what_is_early_is_known_element_by_element():
    traced = Traced(chain, T, X, when=(1, 2))
    known = traced.ahead(T)
    assert [v.shape for v in known] == [()] * 3
    assert_allclose(traced(T, X, known=known), chain(T, X), rtol=1e-14)


def test_what_is_early_is_known_in_the_order_of_a_call_with_masks():
    def function(t, x):
        return tuple(jnp.cos(2 * t + jnp.arange(3.0)) * jnp.sqrt(jnp.stack(x)[:3]))

    traced = Traced(function, T, X, when=(1, 2), transposed=True)
    assert_allclose(traced(T, X, known=traced.ahead(T)), function(T, X), rtol=1e-14)


def test_what_is_early_in_a_small_program_is_known_array_by_array():
    def function(t, x):
        return jnp.cos(t) * x[0] + jnp.sin(t + jnp.arange(5.0)) @ jnp.arange(5.0) * x[1]

    traced = Traced(function, T, X, when=(1, 2), fast=False)
    (known,) = traced.ahead(T)
    assert_allclose(known, jnp.sin(T + jnp.arange(5.0)), rtol=1e-15)
    assert_allclose(traced(T, X, known=[known]), function(T, X), rtol=1e-14)
    # Another array would be taken too.
    assert_allclose(traced(T, X, known=[0 * known]), jnp.cos(T) * X[0], rtol=1e-15)


@pytest.mark.parametrize("function", [chain, matrix])
def test_no_array_is_left(function):
    # XLA would compute it again for each number that is taken out of it. (Constants are arrays.)
    found = set(names(jax.make_jaxpr(Traced(function, T, X))(T, X).jaxpr))
    arrays = {"concatenate", "dot_general", "reduce_sum", "rev", "stack", "transpose"}
    assert found.isdisjoint(arrays), found & arrays


@pytest.mark.parametrize(
    "move",
    [
        lambda a: jax.lax.broadcast_in_dim(a, (2, 3, 4), (1, 2)),
        lambda a: jax.lax.broadcast_in_dim(a[:, :1], (3, 5), (0, 1)),
        lambda a: jnp.concatenate([a, 2 * a], axis=1),
        lambda a: jax.lax.reshape(a, (2, 6), (1, 0)),
        lambda a: jax.lax.rev(a, (1,)),
        lambda a: a[::2, 1:3],
        lambda a: a[1:2].squeeze(0),
        lambda a: jnp.stack([a, -a], axis=1),
        lambda a: a.T,
    ],
)
def test_what_moves_elements_moves_them_as_jax_does(move):
    a = np.arange(12.0).reshape(3, 4)
    traced = Traced(lambda *v: tuple(move(jnp.stack(v).reshape(3, 4)).ravel()), *a.ravel())
    np.testing.assert_array_equal(traced(*a.ravel()), move(jnp.asarray(a)).ravel())


def test_tracing_compiles_nothing(caplog):
    jax.clear_caches()
    with jax.log_compiles():
        Traced(chain, T, X).depends(False, (True, False, False))
        assert "Compiling" not in caplog.text
        jnp.arange(3.0) + 1  # what is compiled is told
        assert "Compiling" in caplog.text


def test_a_program_that_is_not_to_be_fast_does_not_grow_with_its_arrays():
    def relays(a, t, x):
        return a @ x + 0.5 * t * jnp.sign(x) + jnp.cos(t + jnp.arange(float(x.size)))

    def length(n, fast):
        args = jnp.eye(n), jnp.asarray(T), jnp.arange(1.0, n + 1)
        traced = Traced(relays, *args, fast=fast)
        assert_allclose(traced(*args), relays(*args), rtol=1e-14)
        (whole,) = jax.make_jaxpr(traced)(*args).eqns
        return len(whole.params["jaxpr"].eqns)

    assert length(2, False) == length(8, False) < length(2, True) < length(3, True)
