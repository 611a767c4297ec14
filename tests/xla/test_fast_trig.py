"""The vectorising sine, cosine and arctangent against NumPy's, and the rewrite to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfil as jf
from jaxfil.xla import fast_trig
from jaxfil.xla.trace import EARLY, FIRST, LATE, Traced
from tests.xla.operations import names

PAIRS = [(fast_trig.sin, np.sin), (fast_trig.cos, np.cos)]


BOTH = pytest.mark.parametrize("fast, exact", PAIRS)
# How far the range reduction is exact.
DTYPES = pytest.mark.parametrize("dtype, far", [(np.float32, 1e4), (np.float64, 1e5)])


def error(fast, exact, x):
    """Against NumPy in twice the precision, where there is one."""
    return np.abs(np.asarray(fast(jnp.asarray(x))) - exact(x.astype(float)))


@BOTH
@DTYPES
def test_two_ulp_of_one_up_to_many_turns(fast, exact, dtype, far):
    x = np.concatenate([np.linspace(-20, 20, 40001), np.linspace(-far, far, 200001)]).astype(dtype)
    assert fast(jnp.asarray(x)).dtype == dtype
    assert np.max(error(fast, exact, x)) <= 2 * np.finfo(dtype).eps


@BOTH
@DTYPES
def test_error_of_rounding_the_argument_beyond(fast, exact, dtype, far):
    x = np.geomspace(far, 1e7 * far, 10001).astype(dtype)
    assert np.all(error(fast, exact, x) <= np.finfo(dtype).eps * x)


@BOTH
@DTYPES
def test_zeros_keep_their_relative_accuracy(fast, exact, dtype, far):
    shift = 0.5 if exact is np.cos else 0.0
    turns = np.arange(1, 200) + shift
    x = (np.pi * turns).astype(dtype)
    # What the parts of pi leave out of it and rounding of its last part, or NumPy's own rounding.
    rest = 1.2e-14 * turns if dtype == np.float32 else 1e-31
    allowed = 4.5 * np.finfo(dtype).eps * np.abs(exact(x.astype(float))) + rest
    assert np.all(error(fast, exact, x) <= allowed)


@BOTH
@DTYPES
def test_nan_and_inf_give_nan(fast, exact, dtype, far):
    assert np.all(np.isnan(np.asarray(fast(jnp.asarray([np.nan, np.inf, -np.inf], dtype)))))


def test_derivatives():
    x = jnp.float64(0.7)
    np.testing.assert_allclose(jax.grad(fast_trig.sin)(x), np.cos(0.7), rtol=1e-15)
    np.testing.assert_allclose(jax.grad(jax.grad(fast_trig.cos))(x), -np.cos(0.7), rtol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("shape", [(), (49,), (4000,)])
def test_arctangent(dtype, shape):
    # XLA's own of jaxlib 0.10.2 is wrong for 50 numbers and more (jax-ml/jax issue 39352).
    rng = np.random.default_rng(0)
    x = np.asarray(rng.choice([-1, 1], shape) * 10 ** rng.uniform(-6, 6, shape), dtype)
    eps = np.finfo(dtype).eps
    np.testing.assert_allclose(fast_trig.arctan(jnp.asarray(x)), np.arctan(x), rtol=2 * eps)
    wide = jax.jit(fast_trig.arctan, compiler_options={"xla_cpu_prefer_vector_width": "512"})
    np.testing.assert_allclose(wide(jnp.asarray(x)), np.arctan(x), rtol=2 * eps)
    near = np.asarray(rng.uniform(-4, 4, shape), dtype)
    np.testing.assert_allclose(fast_trig.arctan(jnp.asarray(near)), np.arctan(near), rtol=2 * eps)


def test_arctangent_of_special_numbers():
    x = np.asarray([0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -1.0, 5e-324, 1e308])
    got = np.asarray(fast_trig.arctan(jnp.asarray(x)))
    np.testing.assert_allclose(got[:-2], np.arctan(x)[:-2], rtol=1e-15)
    np.testing.assert_allclose(got[-1], np.pi / 2, rtol=1e-15)
    assert np.array_equal(np.signbit(got[:2]), [False, True])
    np.testing.assert_allclose(jax.grad(fast_trig.arctan)(jnp.float64(0.7)), 1 / 1.49, rtol=1e-15)


@pytest.mark.parametrize(
    "dtype", [pytest.param(jnp.float32, marks=pytest.mark.release), jnp.float64]
)
def test_an_arctangent_in_a_users_field_is_right_over_many_lanes(dtype):
    def pull(t, x):
        return -jnp.arctan(3 * x)

    system = jf.piecewise(pull, pull, lambda t, x: x[0] + 1e3, period=1.0)
    x0 = jnp.linspace(0.5, 9.0, 64, dtype=dtype)[:, None]
    many = jax.vmap(lambda x: jf.solve(system, x, 0.0, 1.0, 0.05).xs[-1])(x0)
    one = [jf.solve(system, x, 0.0, 1.0, 0.05).xs[-1] for x in (x0[0], x0[40])]
    np.testing.assert_allclose(many[np.asarray([0, 40])], one, rtol=20 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_rewrite_takes_out_every_sine(dtype):
    @jax.jit
    def inner(x):
        return jnp.sin(x)

    def function(a, x):
        return a * jnp.cos(x) + inner(x), jnp.where(x > 0, x, jnp.exp(x))

    a, x = jnp.asarray(2.0, dtype), jnp.linspace(-1.0, 1.0, 5, dtype=dtype)
    fast = Traced(function, a, x)
    text = str(jax.make_jaxpr(jax.jit(fast))(a, x).jaxpr)
    assert " cos " not in text and " sin " not in text
    for got, expected in zip(fast(a, x), function(a, x), strict=True):
        np.testing.assert_allclose(got, expected, rtol=4.5 * np.finfo(dtype).eps)


def test_what_needs_time_alone_is_found_ahead_and_then_taken():
    def function(a, t, x):
        force = jax.jit(lambda t: jnp.cos(a * t))(t)
        return force * x + jnp.sin(x) + jnp.exp(a) + t * t

    a, t, x = jnp.float64(0.7), jnp.float64(3.0), jnp.float64(0.2)
    traced = Traced(function, a, t, x, when=(FIRST, EARLY, LATE))
    (found,) = traced.ahead(a, t)
    np.testing.assert_allclose(found, np.cos(2.1), rtol=1e-15)
    np.testing.assert_allclose(traced(a, t, x, known=[found]), function(a, t, x), rtol=1e-15)
    # Another number would be taken too.
    np.testing.assert_allclose(
        traced(a, t, x, known=[found + 1]), function(a, t, x) + x, rtol=1e-15
    )
    slope = jax.grad(lambda t: traced(a, t, x, known=traced.ahead(a, t)))(t)
    np.testing.assert_allclose(slope, -0.7 * np.sin(2.1) * 0.2 + 6.0, rtol=1e-15)


def test_nothing_is_ahead_of_a_field_without_forcing():
    traced = Traced(
        lambda t, x: jnp.sin(x) + t, jnp.float64(0.0), jnp.float64(0.0), when=(EARLY, LATE)
    )
    assert traced.ahead(jnp.float64(1.0)) == []


def test_dependencies_are_told_component_by_component():
    def function(x, side):
        return jnp.stack([x[1], x[0] * side, jnp.sin(x[0])])

    def components(x, side):
        out = function(x, side)
        return out[0], out[1], out[2]

    traced = Traced(components, jnp.zeros(2), jnp.float64(1.0))
    assert traced.depends(False, True) == (False, True, False)
    assert traced.depends(True, False) == (True, True, True)


def angles(x):
    return jnp.arctan(3.0 * x) + jnp.arctan2(x, 1.0)


@jax.custom_jvp
def own_rule(x):
    return angles(x)


own_rule.defjvp(lambda x, dx: (own_rule(*x), 3.0 * dx[0]))
INSIDE = {
    "branch": lambda x: jax.lax.cond(x[0] > 0, angles, lambda x: x, x),
    "checkpoint": jax.checkpoint(angles),
    "checkpoint in a loop": lambda x: jax.lax.fori_loop(
        0, 1, lambda _, x: jax.checkpoint(angles)(x), x
    ),
    "own rule": own_rule,
    "scan": lambda x: jax.lax.map(angles, x),
}


@pytest.mark.parametrize("way", INSIDE)
def test_no_arctangent_of_xla_is_left_inside_of_operations(way):
    x = jnp.linspace(0.1, 2.0, 3)
    traced = Traced(INSIDE[way], x)
    found = list(names(jax.make_jaxpr(traced)(x).jaxpr))
    # Of `angles`, that of two arguments is one of which the compiler does not know that x is 1.
    assert "atan" not in found
    assert found.count("select_n") >= found.count("atan2") == 1
    np.testing.assert_allclose(traced(x), np.arctan(3 * x) + np.arctan(x), rtol=4e-16)
