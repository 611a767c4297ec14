"""Reverse mode by the forward Jacobian, against closed forms and forward mode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxfil.xla.forward_jacobian import plainly, with_derivatives
from jaxfil.xla.program import opened


def by_forward_jacobian(function):
    """A function of arrays, with a reverse mode, and no kernel of it."""

    def call(*args):
        program, values, tree = opened(function, args)
        return jax.tree.unflatten(tree, with_derivatives(program, plainly)(*values))

    return call


@by_forward_jacobian
def power(x, k):
    """x to the k, and a number that does not move, by a loop that reverse mode refuses."""
    return jax.lax.while_loop(lambda s: s[0] < k, lambda s: (s[0] + 1, s[1] * x), (0, 0 * x + 1))


def cube(x):
    return power(x, 3)[1]


X = jnp.asarray([2.0, 3.0])


@pytest.mark.parametrize("first", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("second", [jax.jacfwd, jax.jacrev])
def test_derivatives_in_both_modes_to_the_second(first, second):
    want = jnp.zeros((2, 2, 2)).at[jnp.arange(2), jnp.arange(2), jnp.arange(2)].set(6 * X)
    assert_allclose(jax.jit(first(cube))(X), jnp.diag(3 * X**2), rtol=1e-15)
    assert_allclose(jax.jit(second(first(cube)))(X), want, rtol=1e-15)


def test_gradients_by_the_direction_of_a_derivative():
    along = lambda d: jax.jvp(cube, (2.0,), (d,))[1]  # noqa: E731
    assert_allclose(jax.grad(along)(1.0), 3 * 2.0**2, rtol=1e-15)


def test_third_derivatives_in_reverse_mode():
    assert_allclose(jax.grad(jax.grad(jax.grad(cube)))(2.0), 6.0, rtol=1e-15)


def test_batches_of_gradients_and_gradients_of_batches():
    assert_allclose(jax.vmap(jax.grad(cube))(X), 3 * X**2, rtol=1e-15)
    shared = jax.grad(lambda a: jax.vmap(lambda x: cube(a * x))(X).sum())(2.0)
    assert_allclose(shared, 3 * 2.0**2 * (X**3).sum(), rtol=1e-15)
    apart = jax.grad(lambda x: jax.vmap(jax.vmap(cube), 1)(x.reshape(1, 2)).sum())(X)
    assert_allclose(apart, 3 * X**2, rtol=1e-15)
    hessian = jax.hessian(lambda a: jax.vmap(lambda x: cube(a * x))(X).sum())(2.0)
    assert_allclose(hessian, 6 * 2.0 * (X**3).sum(), rtol=1e-15)


def test_what_is_closed_over_has_its_derivative():
    def closed(a):
        return by_forward_jacobian(lambda x: jax.lax.fori_loop(0, 3, lambda _, y: a * y, x))(5.0)

    assert_allclose(jax.grad(closed)(2.0), 5.0 * 3 * 2.0**2, rtol=1e-15)


def test_what_nobody_asks_for_is_not_in_a_gradient():
    @by_forward_jacobian
    def both(x):
        return x**2, jnp.sqrt(x - 2.0)  # whose derivative is infinite

    assert_allclose(jax.grad(lambda x: both(x)[0])(2.0), 4.0, rtol=1e-15)


def test_what_is_left_out_of_a_gradient_takes_nothing_from_it():
    """A number beside it, and lanes, whose derivatives are infinite or NaN."""

    @by_forward_jacobian
    def both(x):
        return jnp.stack([x**2, jnp.sqrt(x - 2.0)])

    assert_allclose(jax.grad(lambda x: both(x)[0])(2.0), 4.0, rtol=1e-15)
    assert_allclose(jax.jacfwd(jax.grad(lambda x: both(x)[0]))(2.0), 2.0, rtol=1e-15)

    def good(a):
        roots = jax.vmap(lambda x: both(a * x)[1])(jnp.asarray([1.0, 2.0, 6.0]))
        return jnp.where(roots > 0, roots, 0.0).sum()

    assert_allclose(jax.grad(good)(1.0), 1.5, rtol=1e-15)
    assert_allclose(jax.jacfwd(jax.grad(good))(1.0), -36 / 32, rtol=1e-15)


def test_linear_maps_are_transposed():
    _, pull = jax.vjp(cube, X)
    _, push = jax.linearize(cube, X)
    (back,) = jax.linear_transpose(push, X)(jnp.ones(2))
    assert_allclose(back, pull(jnp.ones(2))[0], rtol=1e-15)
    assert_allclose(back, 3 * X**2, rtol=1e-15)


def test_what_is_computed_again_has_its_gradient():
    again = jax.checkpoint(lambda x: jnp.sin(cube(x)))
    for wrapped in (again, jax.jit(again), jax.jit(lambda x: jax.lax.map(again, x[None])[0])):
        got = jax.jit(jax.grad(wrapped))(2.0) if wrapped is not again else jax.grad(again)(2.0)
        assert_allclose(got, 12 * np.cos(8.0), rtol=1e-14)
    still = jax.checkpoint(lambda a, x: jnp.sin(a * cube(x)))
    assert_allclose(jax.jit(jax.grad(still))(1.0, 2.0), 8 * np.cos(8.0), rtol=1e-14)


def test_a_gradient_through_a_loop_over_runs():
    def twice(x):
        return jax.lax.scan(lambda y, _: (0.5 * cube(y), cube(y)), x, length=2)[0]

    assert_allclose(jax.grad(twice)(2.0), 1.5 * 16 * 6, rtol=1e-15)
    assert_allclose(jax.jacfwd(jax.grad(twice))(2.0), 9 * 8 * 2.0**7 / 16, rtol=1e-14)


def test_integers_alone_do_not_move():
    double = by_forward_jacobian(lambda k: (2 * k, k / 2))
    zero = np.zeros((), jax.dtypes.float0)
    out, rates = jax.jit(lambda k: jax.jvp(double, (k,), (zero,)))(3)
    assert_allclose(out, (6, 1.5))
    assert rates[0].dtype == jax.dtypes.float0 and rates[1] == 0.0


def test_what_a_program_tells_is_told():
    told = []

    @by_forward_jacobian
    def telling(x):
        jax.debug.callback(lambda x: told.append(float(x)), x)
        return x**2

    jax.jit(lambda x: (telling(x), 1)[1])(1.0)
    jax.jit(lambda x: jax.jvp(telling, (x,), (1.0,)))(2.0)
    jax.effects_barrier()
    assert told == [1.0, 2.0]
