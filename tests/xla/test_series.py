"""Power series of programs, against derivatives of all orders by automatic differentiation."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxfil.xla.moves import by_slices
from jaxfil.xla.series import Expansion, Series
from jaxfil.xla.series_program import array_of, expanded
from jaxfil.xla.series_rules import NoSeries
from tests.results import with_derivatives

ORDER = 6
# The argument as a polynomial in time, of which each function is the series.
ARGUMENT = (0.4, 0.3, -0.2, 0.1, 0.05)
NUMBERS = np.linspace(-1, 1, 40)
MATRIX = np.arange(9.0).reshape(3, 3) / 7 - 0.3


def chosen(t, x):
    branch = jax.lax.cond(x > 0, lambda v: v**3, lambda v: v, x)
    return jnp.where(x > 0.3, x * x, -x) + branch + jnp.sign(x) * x + jax.nn.relu(x)


def placed(t, x):
    return jnp.stack([x, t]).at[0].multiply(x).sum()


FUNCTIONS = {
    "products": lambda t, x: (2 * x) * x * (3 * x) - t * x + x * (1 + x * x),
    "quotients": lambda t, x: x / (1 + x * x) + t / (2 + x) + 3 / (1 + t) + x / 3,
    "integer powers": lambda t, x: (1 + x) ** 5 + (1 + x) ** -3 + x**2 + (1.2 + x) ** 9 + x**0,
    "real powers": lambda t, x: (1 + x) ** 2.5 + (1.1 + x) ** x + jax.lax.rsqrt(1 + x),
    "square root": lambda t, x: jnp.sqrt(1 + x),
    "exponentials": lambda t, x: jnp.exp(-x) + jnp.exp2(x) + jnp.expm1(x),
    "logarithms": lambda t, x: jnp.log(1 + x * x) + jnp.log1p(x),
    "sine of a state": lambda t, x: jnp.sin(x) * jnp.cos(2 * x),
    "sine of a phase": lambda t, x: jnp.sin(3 * t + 0.2) * x + jnp.cos(3 * t + 0.2) + jnp.sin(t),
    "sine of a square of time": lambda t, x: jnp.sin(t * t + 1.0),
    "tangents": lambda t, x: jnp.tan(x) + jnp.tanh(x) + jnp.arctan(x) + jnp.arctan2(x, 1 + t),
    "hyperbolic": lambda t, x: jnp.sinh(x) + jnp.cosh(2 * x) + jax.nn.sigmoid(x),
    "error function": lambda t, x: jax.scipy.special.erf(x),
    "inverses": lambda t, x: jnp.arcsin(x / 2) + jnp.arccos(x / 2) + jnp.arcsinh(x),
    "hyperbolic inverses": lambda t, x: jnp.arctanh(x / 2) + jnp.arccosh(2 + x),
    "extremes": lambda t, x: abs(-x) + jnp.maximum(x, t) + jnp.minimum(x, 2.0) + jnp.clip(x, 0, 4),
    "choices": chosen,
    "integers": lambda t, x: x * (jnp.round(5 * x).astype(int) // 2).astype(float),
    "remainder": lambda t, x: jnp.mod(t + 0.3, 1.7) * x,
    "small arrays": lambda t, x: jnp.sum(MATRIX @ jnp.stack([x, x * x, jnp.sin(t)])),
    "complex": lambda t, x: abs((x + 1j * t) ** 2 + 0.5) + jnp.imag(1j * x),
    "stacked": lambda t, x: jnp.sum(jnp.stack([x * NUMBERS, t * NUMBERS]) ** 2),
    "padded": lambda t, x: jnp.sum(jnp.pad(x * NUMBERS, (1, 2), constant_values=t) ** 2),
    "tiled": lambda t, x: jnp.sum(jnp.tile(x * NUMBERS, 2) ** 2),
    "places within": lambda t, x: jax.lax.cond(
        t >= 0, jax.checkpoint(placed), lambda t, x: t, t, x
    ),
    "places": lambda t, x: jnp.stack([x, t]).at[0].add(t * x).prod(),
    "large arrays": lambda t, x: jnp.sum(jnp.sin(jnp.arange(40.0) * x) * jnp.linspace(0, 1, 40)),
    "products of vectors": lambda t, x: jnp.dot(jnp.full(40, x), jnp.arange(40.0) * t * x),
}


def derivatives(function):
    """f⁽ᵏ⁾(0)/k! of the function of time alone, from one program."""

    def of_time(s):
        return function(s, sum(c * s**k for k, c in enumerate(ARGUMENT))), None

    found, _ = jax.jit(with_derivatives(of_time, ORDER - 1))(0.0)
    return np.array([float(v) / math.factorial(k) for k, v in enumerate(found)])


def series_of(function, argument=ARGUMENT):
    """Its coefficients, from one program; None where the structure says that they are zero."""
    program = by_slices(jax.make_jaxpr(function)(0.0, 0.0))

    @jax.jit
    def coefficients(slope, argument):
        expansion = Expansion({})
        t = expansion.linear(jnp.zeros_like(slope), slope)
        x = expansion.series(lambda k: argument[k] if k < len(argument) else None)
        (y,) = expanded(expansion, program, [t, x])
        found = array_of(expansion, y)
        return [found[k] for k in range(ORDER)]

    return coefficients(1.0, argument)


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_coefficients_are_derivatives(name):
    values = [0.0 if v is None else float(v) for v in series_of(FUNCTIONS[name])]
    exact = derivatives(FUNCTIONS[name])
    # Sums of a few dozen terms, none larger than the largest coefficient by a factor of ten.
    scale = 10 * np.max(abs(exact))
    assert_allclose(values, exact, rtol=0, atol=64 * np.finfo(float).eps * scale)


KINKS = {
    "absolute": (lambda t, x: abs(x), lambda t, x: x, lambda t, x: -x),
    "the larger": (lambda t, x: jnp.maximum(0.0, x) * x, lambda t, x: x * x, lambda t, x: 0 * x),
    "the smaller": (lambda t, x: jnp.minimum(x, 3 * x), lambda t, x: x, lambda t, x: 3 * x),
    "above": (lambda t, x: jnp.where(x > 0, x, t * x), lambda t, x: x, lambda t, x: t * x),
    "not above": (lambda t, x: jnp.where(x <= 0, -x, t * x), lambda t, x: t * x, lambda t, x: -x),
    "clipped": (lambda t, x: jnp.clip(x, 0.0, 1.0), lambda t, x: x, lambda t, x: 0 * x),
    "a flag as a number": (
        lambda t, x: (x > 0).astype(float) * x,
        lambda t, x: x,
        lambda t, x: 0 * x,
    ),
    "flags joined": (
        lambda t, x: jnp.where((x > 0) & ~(x > 5), x, t),
        lambda t, x: x,
        lambda t, x: t,
    ),
    "a choice of numbers": (
        lambda t, x: (1 + jnp.where(x > 0, 2.0, 1.0)) * x,
        lambda t, x: 3 * x,
        lambda t, x: 2 * x,
    ),
    "a branch": (
        lambda t, x: jax.lax.cond(x > 0, lambda v: 3 * v, lambda v: v, x),
        lambda t, x: 3 * x,
        lambda t, x: x,
    ),
    "a sign": (lambda t, x: jnp.sign(x) * x, lambda t, x: x, lambda t, x: -x),
    "rounded down": (lambda t, x: jnp.floor(x) * x, lambda t, x: 0 * x, lambda t, x: -x),
    "rounded": (
        lambda t, x: jnp.round(x + 0.5) * x,
        lambda t, x: x,
        lambda t, x: 0 * x,
    ),
    "a remainder": (lambda t, x: jnp.mod(x, 1.0), lambda t, x: x, lambda t, x: 1 + x),
    "elsewhere": (lambda t, x: jnp.where(x == 0, 5.0, x), lambda t, x: x, lambda t, x: x),
    "not here": (lambda t, x: jnp.where(x != 0, x, 5.0), lambda t, x: x, lambda t, x: x),
}


@pytest.mark.parametrize("name", KINKS)
def test_at_a_kink_the_side_ahead_is_taken(name):
    function, above, below = KINKS[name]
    for ahead in ((0.0, 0.3, -0.2), (0.0, 0.0, 0.2, -0.1)):
        for sign, side in ((1.0, above), (-1.0, below)):
            argument = tuple(sign * v for v in ahead)
            found, right = series_of(function, argument), series_of(side, argument)
            np.testing.assert_array_equal(
                *([0.0 if v is None else float(v) for v in each] for each in (found, right))
            )


@pytest.mark.parametrize("power", [9, 2.0, 5.0])
def test_powers_of_zero_are_finite(power):
    argument = (0.0, 0.3, -0.2)
    found = [0.0 if v is None else float(v) for v in series_of(lambda t, x: x**power, argument)]
    exact = np.polynomial.polynomial.polypow(argument, int(power))[:ORDER]
    assert_allclose(found, np.pad(exact, (0, ORDER - len(exact))), rtol=1e-14)


@pytest.mark.parametrize("argument", [(0.0, 0.3, -0.2, 0.1), (0.0, 0.0, 0.7, 0.2), (0.4, 0.3)])
def test_powers_by_parameters_and_arrays_are_finite_at_zero(argument):
    def powers(t, x):
        return jnp.sum(jnp.stack([x, x, x]) ** jnp.arange(1.0, 4.0))

    summed = np.zeros(ORDER)
    for power in range(4):
        own = np.polynomial.polynomial.polypow(argument, power)[:ORDER]
        own = np.pad(own, (0, ORDER - len(own)))
        summed += own * (power > 0)
        whole = np.pad(argument, (0, ORDER - len(argument)))
        assert_allclose(parametrised(whole, float(power)), own, rtol=0, atol=1e-15)
    found = [0.0 if v is None else float(v) for v in series_of(powers, argument)]
    assert_allclose(found, summed, rtol=0, atol=1e-15)


@jax.jit
def parametrised(argument, power):
    """The coefficients of a power whose exponent is traced."""
    expansion = Expansion({})
    program = jax.make_jaxpr(lambda x, c: x**c)(0.0, 0.0)
    x = expansion.series(lambda k: argument[k])
    (y,) = expanded(expansion, program, [x, power])
    return jnp.stack([jnp.asarray(y[k]) for k in range(ORDER)])


# Coefficients of which some are zero by their value, and not by structure.
ZEROS = [[0.0, 0.3, -0.2, 0.1, 0, 0], [0.0, 0.0, 0.7, 0.2, 0, 0], [0.0] * 6, [0.0] * 5 + [0.4]]


def products_with(a):
    """The matrix of the products of series with the series a."""
    return sum(v * np.eye(ORDER, k=-k) for k, v in enumerate(a))


def test_powers_by_parameters_have_their_derivatives_at_zero():
    whole = [(np.array(a), c) for a in ZEROS for c in (1.0, 2.0, 3.0, 4.0)]
    arguments, powers = map(np.array, zip(*whole, strict=True))
    both = jax.vmap(lambda a, c: (parametrised(a, c), jax.jacfwd(parametrised)(a, c)))
    values, slopes = jax.jit(both)(arguments, powers)
    for a, c, value, slope in zip(arguments, powers, values, slopes, strict=True):
        below = np.linalg.matrix_power(products_with(a), int(c) - 1)
        assert_allclose(value, below @ a, rtol=0, atol=1e-15)
        assert_allclose(slope, c * below, rtol=0, atol=1e-15)


def test_the_derivative_by_an_exponent_is_unknown_where_the_base_leaves_zero():
    # Of s^c it is s^c ln s, which has no series. The derivatives by others are not touched by it.
    bases, powers = np.array(ZEROS), jnp.array([2.0, 3.0, 2.0, 1.0])

    @jax.jit
    @jax.vmap
    def slopes(a, c):
        return jax.jacfwd(parametrised, (0, 1))(a, c), jax.jacrev(parametrised)(a, c)

    (by_base, by_power), back = slopes(bases, powers)
    leaves = np.any(bases != 0, axis=1)
    assert_array_equal(np.isnan(by_power).any(axis=1), leaves)
    assert_array_equal(by_power[~leaves], 0.0)
    for a, c, forward, reverse in zip(bases, powers, by_base, back, strict=True):
        exact = float(c) * np.linalg.matrix_power(products_with(a), int(c) - 1)
        assert_allclose(forward, exact, rtol=0, atol=1e-15)
        assert_allclose(reverse, exact, rtol=0, atol=1e-15)


def test_a_root_has_its_derivatives_where_coefficients_are_zero():
    @jax.jit
    @jax.vmap
    @jax.jacfwd
    def slopes(argument):
        expansion = Expansion({})
        x = expansion.series(lambda k: argument[k])
        (y,) = expanded(expansion, jax.make_jaxpr(jnp.sqrt)(0.0), [x])
        return jnp.stack([y[k] for k in range(ORDER)])

    arguments = np.array(
        [[4.0, 0, 0, 0, 0, 0], [1.0, 0, 0.6, 0, 0, 0.2], [1.0, 0.6, 0.09, 0, 0, 0]]
    )
    # Of y² = a follows 2 y dy = da. The last is the square of 1 + 0.3 s.
    roots = [[2.0, 0, 0, 0, 0, 0], [1.0, 0, 0.3, 0, -0.045, 0.1], [1.0, 0.3, 0, 0, 0, 0]]
    exact = [np.linalg.inv(2 * products_with(y)) for y in roots]
    assert_allclose(slopes(arguments), exact, rtol=0, atol=1e-14)


def test_a_root_and_a_power_that_is_not_whole_of_what_stays_zero_are_zero():
    argument = (0.0, 0.0, 0.0)
    for function in (jnp.sqrt, lambda x: x**1.5):
        found = series_of(lambda t, x, f=function: f(x), argument)
        assert_array_equal([0.0 if v is None else float(v) for v in found], 0.0)
        found = series_of(lambda t, x, f=function: f(x), (0.0, 0.5))
        assert not np.isfinite(float(found[1]))


def test_zeros_by_structure_are_not_computed():
    constant = series_of(lambda t, x: jnp.sin(jnp.asarray(2.0)) + 1.0)
    assert constant[1] is None and constant[5] is None
    linear = series_of(lambda t, x: 3.0 * t - 1.0)
    assert float(linear[1]) == 3.0 and linear[2] is None


def test_products_of_multiples_are_multiples_of_a_square():
    made = []

    def counted(function):
        program = jax.make_jaxpr(function)(0.0, 0.0)
        expansion = Expansion({})
        t = expansion.linear(jnp.asarray(0.0), jnp.asarray(1.0))
        x = expansion.series(lambda k: jnp.asarray(ARGUMENT[k]))
        expanded(expansion, program, [t, x])
        made.append(sum(isinstance(v, Series) and v.is_kept for v in expansion.made))

    counted(lambda t, x: x * x)
    counted(lambda t, x: (2 * x) * (3 * x) + x * x)
    assert made[0] == made[1]


@pytest.mark.parametrize(
    "name, function",
    [
        ("scan", lambda t, x: jax.lax.fori_loop(0, 3, lambda _, v: v * x, x)),
        ("sign", lambda t, x: jnp.real(jnp.sign(x + 1j * t))),
        ("sort", lambda t, x: jnp.sort(jnp.stack([x, t]))[0]),
    ],
)
def test_an_operation_without_a_series_is_named(name, function):
    with pytest.raises(NoSeries, match=f"`{name}`"):
        series_of(function)
