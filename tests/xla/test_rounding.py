"""The rounding of functions, computed from their operations, against exact arithmetic."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from jaxfil.xla.rounding import rounding_of

EPS = np.finfo(float).eps

# A function in JAX and in exact arithmetic, and arguments in which its terms nearly cancel.
FUNCTIONS = {
    "offset": (lambda x, a: (x + a) - (a + 0.25), lambda x, a: x - 0.25),
    "phase": (lambda x, a: x - 0.2 * jnp.sin(x + a), lambda x, a: x - 0.2 * mpmath.sin(x + a)),
    "powers": (lambda x, a: (x + a) ** 3 - a**3, lambda x, a: (x + a) ** 3 - a**3),
    "root": (
        lambda x, a: jnp.sqrt(a * a + x) - a,
        lambda x, a: mpmath.sqrt(a * a + x) - a,
    ),
    "quotient": (lambda x, a: (a + x) / a - 1, lambda x, a: x / a),
    "exponential": (
        lambda x, a: jnp.exp(x) * a - jnp.log(a) * a,
        lambda x, a: mpmath.exp(x) * a - mpmath.log(a) * a,
    ),
    "remainder": (
        lambda x, a: jnp.mod(x - a, 0.3) - 0.1,
        lambda x, a: (
            (x - a) - mpmath.floor((x - a) / mpmath.mpf(0.3)) * mpmath.mpf(0.3) - mpmath.mpf(0.1)
        ),
    ),
    "linear system": (
        lambda x, a: (
            jnp.linalg.solve(jnp.array([[1, 0.25], [0.25, 1]]), jnp.stack([x + a, a]))[0] * 0.9375
            - 0.75 * a
        ),
        lambda x, a: x,
    ),
    "product of vectors": (
        lambda x, a: jnp.array([1.0, -1.0]) @ jnp.stack([(x + a) - a, (2 * x + a) - a]),
        lambda x, a: -x,
    ),
    "sum": (
        lambda x, a: jnp.sum(jnp.stack([x * a, -x * a, x + a, -a])),
        lambda x, a: x,
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_rounding_exceeds_its_bound_and_few_are_far_below(name):
    function, exact = FUNCTIONS[name]
    draw = np.random.default_rng(0)
    xs, shifts = (
        draw.uniform(0.1, 1.0, 300),
        draw.uniform(1.0, 2.0, 300) * 10.0 ** draw.integers(0, 5, 300),
    )
    bound = rounding_of(function, 0.5, 10.0)
    bounds = np.asarray(jax.vmap(bound)(xs, shifts))
    with mpmath.workdps(60):
        pairs = zip(np.asarray(jax.vmap(function)(xs, shifts)), xs, shifts, strict=True)
        found = [mpmath.mpf(float(v)) - exact(mpmath.mpf(x), mpmath.mpf(a)) for v, x, a in pairs]
    errors, values = abs(np.array(found, float)), abs(np.asarray(jax.vmap(function)(xs, shifts)))
    # The bound leaves out the rounding of the result itself.
    assert (errors <= EPS * (bounds + values)).all()
    assert np.max(errors / (EPS * bounds)) > 0.02


def test_what_is_made_of_arguments_at_once_has_no_rounding_of_its_own():
    assert rounding_of(lambda x, a: x - a, 1.0, 2.0) is None
    assert rounding_of(lambda x: x[jnp.array([1, 0])][::-1], jnp.ones(2)) is None
    assert rounding_of(lambda x: jnp.where(x > 0, x, -x) > 1, 1.0) is None


def test_bounds_go_where_their_values_go():
    bound = rounding_of(lambda x: jnp.where(x > 0, jnp.stack([x + 9.0, x, x])[::-1] - 1, 0.0), 1.0)
    np.testing.assert_array_equal(bound(1.0), [0, 0, 10])
    np.testing.assert_array_equal(bound(-1.0), [0, 0, 0])


def plain(x, a):
    y = (x + a) - a
    for _ in range(3):
        y = 0.5 * jnp.sin(y + a)
    return y - x


@jax.custom_jvp
def moved(x, a):
    return (x + a) - a


moved.defjvp(lambda x, dx: (moved(*x), dx[0]))
# The same function in other words. Branches that are not taken have a large rounding.
WAYS = {
    "branch": lambda x, a: jax.lax.cond(x > 0, plain, lambda x, a: (x + 1e9 * a) * 1.0, x, a),
    "other branch": lambda x, a: jax.lax.switch(7, [lambda x, a: 1e9 * a + x - x, plain], x, a),
    "checkpoint": jax.checkpoint(plain),
    "own rule": lambda x, a: looped(moved(x, a), x, a),
    "scan": lambda x, a: looped((x + a) - a, x, a),
    "while": lambda x, a: (
        jax.lax.while_loop(
            lambda c: c[0] < 3,
            lambda c: (c[0] + 1, 0.5 * jnp.sin(c[1] + a)),
            (0, (x + a) - a),
        )[1]
        - x
    ),
    "rows": lambda x, a: (
        jax.lax.scan(lambda y, shift: (0.5 * jnp.sin(y + shift), y), (x + a) - a, jnp.full(3, a))[0]
        - x
    ),
}


def looped(y, x, a):
    return jax.lax.fori_loop(0, 3, lambda _, y: 0.5 * jnp.sin(y + a), y) - x


@pytest.mark.parametrize("way", WAYS)
def test_rounding_is_followed_into_programs_inside_of_operations(way):
    exact, found = (rounding_of(f, 0.3, 1e4)(0.3, 1e4) for f in (plain, WAYS[way]))
    # The last operation of a loop may be counted.
    np.testing.assert_allclose(found, exact, rtol=1e-3)


def test_functions_with_rules_of_their_own_pass_bounds_on():
    # A rule for derivatives, as those of jax.nn have, a loop and a choice.
    def function(x):
        y = jax.nn.softplus(x + 9.0)
        y = jax.lax.fori_loop(0, 3, lambda _, v: 2.0 * v, y)
        return jax.lax.cond(x > 0, lambda v: v - 1.0, lambda v: v, jax.nn.relu(y))

    bound = rounding_of(function, 1.0)
    slope = jax.grad(function)(1.0)
    # The softplus and three products of it round, each by the share of it that reaches y = 80.
    assert slope * 10.0 <= bound(1.0) <= slope * 10.0 + 4 * 80.1
