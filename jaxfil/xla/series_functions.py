"""Power series of functions: the recurrence of each operation.

Most of the rules are of one kind, in which y = f(u) has y' = g u' with a g that depends on u and y,
so that k y_k = Σ i u_i g_{k−i}.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient

from jaxfil.xla.fast_trig import arctan2
from jaxfil.xla.known import is_known
from jaxfil.xla.masked_product import masked_product
from jaxfil.xla.select import select
from jaxfil.xla.series import (
    Expansion,
    Series,
    add,
    convolution,
    difference,
    first_of,
    kept,
    linear_function,
    minus,
    product,
    quotient,
    scaled,
    square,
    sum_of,
    times,
)

# The largest exponent of type float that is computed by products.
_WHOLE = 64
# The largest exponent, of those that are not known, of a base that is zero and does not stay zero.
_FEW = 4


def _rate(expansion: Expansion, a: Series) -> Series:
    """The series with coefficients k a_k."""
    # The series of s a'(s). Its coefficients have the index of a, unlike the ones of a'.
    key = ("rate", a)
    return expansion.once(key, lambda: expansion.series(lambda k: scaled(float(k), a[k])))


def _from_rate(expansion: Expansion, first: Callable, a: Series, g: Callable) -> Series:
    """y with y_0 = `first()` and y' = a' g, for the series g returned by `g(y)`."""
    # g may be a function of y, which is created first.
    moves, holder = _rate(expansion, a), []

    def make(k: int) -> Any:
        if k == 0:
            return first()
        # Σ i a_i g_{k−i} over i ≥ 1, so that g is needed only up to order k − 1.
        return scaled(1.0 / k, convolution(moves, holder[0], k, first=1))

    out = expansion.series(make)
    holder.append(g(out))
    # y itself is stored only if g is y, as for exp, or is computed from it.
    kept(moves, holder[0])
    return out


def _of_name(name: str, g: Callable) -> Callable:
    """The rule of a function y = name(u) with y' = u' g(u, y)."""

    def rule(expansion: Expansion, eqn: Any, a: Series) -> Series:
        def first() -> Any:
            return expansion.first(name, first_of(a))

        return _from_rate(expansion, first, a, lambda y: g(expansion, a, y))

    return rule


def _sine_and_cosine(expansion: Expansion, a: Series) -> tuple[Series, Series]:
    return expansion.once(("sine", a), lambda: _made_sine_and_cosine(expansion, a))


def _made_sine_and_cosine(expansion: Expansion, a: Series) -> tuple[Series, Series]:
    def first(name: str) -> Any:
        return expansion.first(name, first_of(a))

    # A linear argument needs no recurrence: coefficient k is ± the sine or cosine of its start
    # times rate^k/k!.
    if a.degree == 1:
        # A sine and a cosine at the start serve all orders. Being of degree 0, they are stored.
        start_sine = expansion.series(lambda _: first("sin"), 0)
        start_cosine = expansion.series(lambda _: first("cos"), 0)

        def power(k: int) -> Any:
            return jnp.ones_like(a[1]) if k == 0 else powers[k - 1] * (a[1] * (1.0 / k))

        powers = expansion.series(power)
        kept(powers)
        # They need no state. `taylor` computes several orders of the states at once unless other
        # series are needed order by order, as these are not.
        powers.is_of_time = True
        turn = (start_sine, start_cosine)

        def turned(k: int, shift: int) -> Any:
            # The derivatives of sin are sin, cos, −sin, −cos, with period four. cos is sin shifted
            # by one.
            value = turn[(k + shift) % 2][0]
            if k == 0:
                return value
            return (-1.0 if (k + shift) % 4 >= 2 else 1.0) * (value * powers[k])

        return (
            expansion.series(lambda k: turned(k, 0)),
            expansion.series(lambda k: turned(k, 1)),
        )
    return _pair(expansion, a, "sin", "cos", -1.0)


def _hyperbolic(expansion: Expansion, a: Series) -> tuple[Series, Series]:
    return expansion.once(("hyperbolic", a), lambda: _pair(expansion, a, "sinh", "cosh", 1.0))


def _pair(
    expansion: Expansion, a: Series, odd: str, even: str, sign: float
) -> tuple[Series, Series]:
    """Two functions of a, of which the rate of the first is the second, and of the second `sign`
    times the first."""
    moves, pair = _rate(expansion, a), []

    def coefficient(k: int, name: str, factor: float, other: int) -> Any:
        if k == 0:
            return expansion.first(name, first_of(a))
        return scaled(factor / k, convolution(moves, pair[other], k, first=1))

    pair.append(expansion.series(lambda k: coefficient(k, odd, 1.0, 1)))
    pair.append(expansion.series(lambda k: coefficient(k, even, sign, 0)))
    kept(moves, *pair)
    return pair[0], pair[1]


def _exponential(expansion: Expansion, a: Series) -> Series:
    return expansion.once(
        ("exponential", a),
        lambda: _from_rate(expansion, lambda: expansion.first("exp", first_of(a)), a, lambda y: y),
    )


def _logarithm(expansion: Expansion, a: Series, first: Callable, shift: float = 0.0) -> Series:
    """y with y' = a'/(a + shift)."""
    # For log1p the rounding of 1 + a is harmless here, since it affects only the rates. Coefficient
    # 0, where it would be amplified near 0, is that function itself.
    below = _shifted(expansion, a, shift)
    inverse = quotient(expansion, expansion.constant(1.0), below)
    return _from_rate(expansion, first, a, lambda y: inverse)


def _shifted(expansion: Expansion, a: Series, number: Any) -> Series:
    if isinstance(number, float) and number == 0:
        return a
    return sum_of(expansion, [a, expansion.constant(number)])


def _real_power(expansion: Expansion, a: Series, exponent: Series) -> Series:
    """a^c for a constant c: k a_0 y_k = Σ_{i ≥ 1} (i (c + 1) − k) a_i y_{k−i}."""
    # From a y' = c a' y. It divides by a_0, even if y is regular at 0, as for an integer c.
    inverse = expansion.series(lambda _: _inverse_or_one(first_of(a)), 0)
    # Products have the derivatives by all coefficients, also by the ones that are zero.
    powers = [] if _is_broken(exponent) else range(_FEW + 1)
    products = [_of_whole(expansion, a, n) for n in powers]

    def make(k: int) -> Any:
        c = exponent[0]
        if k == 0:
            return expansion.first("pow", first_of(a), jnp.asarray(c))
        terms = [times((i * (c + 1) - k) * (1.0 / k), times(a[i], y[k - i])) for i in _upto(k)]
        out = times(add(terms), inverse[0])
        return None if out is None else select(a[0] != 0, out, of_zero(k, c))

    def of_zero(k: int, c: Any) -> Any:
        none = jnp.zeros_like(first_of(a))
        # Any other power has no series here, unless its base stays zero.
        unknown = none if a[k] is None else select(a[k] != 0, jnp.nan, none)
        out = unknown
        for n, v in enumerate(products):
            own = none if v[k] is None else v[k]
            out = select(c == n, own + _without_slope(unknown, c), out)
        return out

    y = expansion.series(make)
    kept(a, y)
    return y


def _inverse_or_one(v: Any) -> Any:
    """1/v, or 1 where v is 0, so that a derivative that is not selected is finite."""
    return 1.0 / select(v != 0, v, jnp.ones_like(v))


def _without_slope(unknown: Any, c: Any) -> Any:
    """0, with the derivative by an exponent c that is `unknown`: s^c ln s has no series."""
    apart = jnp.broadcast_to(c - stop_gradient(c), jnp.shape(unknown))
    return masked_product(unknown, apart.astype(jnp.result_type(unknown)))


def _is_broken(exponent: Series) -> bool:
    """Whether an exponent is known not to be whole."""
    c = exponent.known.get(0)
    return c is not None and is_known(c) and bool(np.all(np.asarray(c) % 1 != 0))


def _upto(k: int) -> range:
    return range(1, k + 1)


def _integer_power(expansion: Expansion, eqn: Any, a: Series) -> Series:
    return _of_whole(expansion, a, eqn.params["y"])


def _of_whole(expansion: Expansion, a: Series, n: int) -> Series:
    """a^n. Products are finite at a_0 = 0 too, where the recurrence of a real power divides by
    zero."""
    out = expansion.constant(1.0) if n == 0 else _whole_power(expansion, a, abs(n))
    return out if n >= 0 else quotient(expansion, expansion.constant(1.0), out)


def _whole_power(expansion: Expansion, a: Series, n: int) -> Series:
    if n == 1:
        return a
    # By repeated squares, since a square costs half of a product.
    root = square(expansion, _whole_power(expansion, a, n // 2))
    return root if n % 2 == 0 else product(expansion, a, root)


def _power(expansion: Expansion, eqn: Any, a: Series, b: Series) -> Series:
    if b.degree == 0:
        whole = _whole_number(b)
        return _real_power(expansion, a, b) if whole is None else _of_whole(expansion, a, whole)
    # exp(b log a). With an exponent that varies this is defined for a > 0 only.
    first = expansion.series(lambda _: jnp.log(first_of(a)), 0)
    log = _logarithm(expansion, a, lambda: first[0])
    return _exponential(expansion, product(expansion, b, log))


def _whole_number(b: Series) -> int | None:
    """The whole number that a constant is, or None, also for one that is a parameter."""
    value = b.known.get(0)
    if value is None or not is_known(value) or np.ndim(value):
        return None
    number = float(value)
    return int(number) if number.is_integer() and abs(number) <= _WHOLE else None


def _square_root(expansion: Expansion, eqn: Any, a: Series) -> Series:
    """√a: 2 y_0 y_k = a_k − Σ y_i y_{k−i} over 0 < i < k."""
    inverse = expansion.series(lambda _: 0.5 * _inverse_or_one(y[0]), 0)

    def make(k: int) -> Any:
        if k == 0:
            return expansion.first("sqrt", first_of(a))
        # As in `square`, equal products are computed once. The terms with y_0 are on the other
        # side.
        pairs = add([times(y[i], y[k - i]) for i in range(1, (k + 1) // 2)])
        middle = times(y[k // 2], y[k // 2]) if k % 2 == 0 else None
        rest = minus(a[k], add([scaled(2.0, pairs), middle]))
        if rest is None:
            return None
        # The root of zero stays zero as long as its square does, and has no series otherwise.
        return rest * select(y[0] != 0, inverse[0], select(rest != 0, jnp.inf, 0.0))

    y = expansion.series(make)
    kept(y)
    return y


def _arctan2(expansion: Expansion, eqn: Any, y: Series, x: Series) -> Series:
    """The angle of (x, y), whose rate is (x y' − y x')/(x² + y²)."""
    size = sum_of(expansion, [square(expansion, x), square(expansion, y)])
    # Both quotients share the reciprocal of x² + y² (see `quotient`).
    by_y = quotient(expansion, x, size)
    by_x = quotient(expansion, y, size)
    of_y, of_x = _rate(expansion, y), _rate(expansion, x)
    kept(of_y, of_x, by_y, by_x)

    def make(k: int) -> Any:
        if k == 0:
            return arctan2(first_of(y), first_of(x))
        rise, fall = convolution(of_y, by_y, k, first=1), convolution(of_x, by_x, k, first=1)
        return scaled(1.0 / k, minus(rise, fall))

    return expansion.series(make)


def _one_plus_square(expansion: Expansion, a: Series, sign: float = 1.0) -> Series:
    squared = square(expansion, a)
    return expansion.series(lambda k: add([_one(k), scaled(sign, squared[k])]))


def _one_over(expansion: Expansion, a: Series) -> Series:
    return quotient(expansion, expansion.constant(1.0), a)


def _one_over_root(expansion: Expansion, a: Series) -> Series:
    return _real_power(expansion, a, expansion.constant(-0.5))


def _logistic_slope(expansion: Expansion, _: Series, y: Series) -> Series:
    return product(expansion, y, expansion.series(lambda k: minus(_one(k), y[k])))


def _one(k: int) -> Any:
    return 1.0 if k == 0 else None


def _error_slope(expansion: Expansion, a: Series, _: Series) -> Series:
    negative = linear_function(expansion, lambda v: -v, square(expansion, a))
    return linear_function(
        expansion, lambda v: (2 / np.pi**0.5) * v, _exponential(expansion, negative)
    )


def _exp_minus_one(expansion: Expansion, eqn: Any, a: Series) -> Series:
    # Only coefficient 0 differs from exp. There expm1 does not cancel near 0.
    whole = _exponential(expansion, a)
    return expansion.series(lambda k: jnp.expm1(first_of(a)) if k == 0 else whole[k])


def _exp_of_two(expansion: Expansion, eqn: Any, a: Series) -> Series:
    return _exponential(expansion, linear_function(expansion, lambda v: float(np.log(2)) * v, a))


# Griewank and Walther, Evaluating Derivatives, 2008, derive such recurrences in chapter 13.
FUNCTIONS: dict[str, Callable] = {
    "acos": _of_name(
        "acos",
        lambda e, a, y: linear_function(
            e, lambda v: -v, _one_over_root(e, _one_plus_square(e, a, -1.0))
        ),
    ),
    "acosh": _of_name(
        "acosh",
        lambda e, a, y: _one_over_root(e, _shifted(e, square(e, a), -1.0)),
    ),
    "add": lambda e, eqn, *terms: sum_of(e, terms),
    "add_any": lambda e, eqn, *terms: sum_of(e, terms),
    "asin": _of_name("asin", lambda e, a, y: _one_over_root(e, _one_plus_square(e, a, -1.0))),
    "asinh": _of_name("asinh", lambda e, a, y: _one_over_root(e, _one_plus_square(e, a))),
    "atan": _of_name("atan", lambda e, a, y: _one_over(e, _one_plus_square(e, a))),
    "atan2": _arctan2,
    "atanh": _of_name("atanh", lambda e, a, y: _one_over(e, _one_plus_square(e, a, -1.0))),
    "cos": lambda e, eqn, a: _sine_and_cosine(e, a)[1],
    "cosh": lambda e, eqn, a: _hyperbolic(e, a)[1],
    "div": lambda e, eqn, a, b: quotient(e, a, b),
    "erf": _of_name("erf", _error_slope),
    "exp": lambda e, eqn, a: _exponential(e, a),
    "exp2": _exp_of_two,
    "expm1": _exp_minus_one,
    "integer_pow": _integer_power,
    "log": lambda e, eqn, a: _logarithm(e, a, lambda: e.first("log", first_of(a))),
    "log1p": lambda e, eqn, a: _logarithm(e, a, lambda: e.first("log1p", first_of(a)), 1.0),
    "logistic": _of_name("logistic", _logistic_slope),
    "mul": lambda e, eqn, a, b: product(e, a, b),
    "pow": _power,
    "rsqrt": lambda e, eqn, a: _one_over_root(e, a),
    "sin": lambda e, eqn, a: _sine_and_cosine(e, a)[0],
    "sinh": lambda e, eqn, a: _hyperbolic(e, a)[0],
    "sqrt": _square_root,
    "square": lambda e, eqn, a: square(e, a),
    "sub": lambda e, eqn, a, b: difference(e, a, b),
    # Rates in y where this is a polynomial, 1 ± y², which needs a square and no quotient.
    "tan": _of_name("tan", lambda e, a, y: _one_plus_square(e, y)),
    "tanh": _of_name("tanh", lambda e, a, y: _one_plus_square(e, y, -1.0)),
}
"""The rules of functions, by the names of their operations."""
