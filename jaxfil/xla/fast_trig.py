"""Sine, cosine and arctangent that vectorise.

Each is a polynomial or a rational function after range reduction, for arrays of float32 or float64.
XLA's own sine and cosine are a scalar library call for each lane on CPU, which costs more than the
rest of a typical oscillator's field. Its arctangent in jaxlib 0.10.2 is wrong for arrays of 50 or
more numbers (jax-ml/jax issue 39352).

Accuracy of sine and cosine: within 2 ulp of one for |x| < 1e5 (in float32 1e4). Beyond that the
error stays of the order of eps·|x|, which is the effect of rounding the argument itself. The
arctangent's relative error is below 2 eps for every x.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.xla.select import select

# pi in parts of 33, 33 and 53 bits: a half-integer below 2^20 times one of the first two is exact
# (Cody and Waite 1980; twice the parts of pi/2 in fdlibm). In parts of 11, 11 and 24 bits for
# float32: below 2^12.
_PI = (3.14159265346825122834e00, 1.21542010126079319340e-10, 4.04453249759190126308e-21)
_PI_SINGLE = (3.140625, 2029 * 2.0**-21, 1.50995799e-7)
# (sin r / r - 1) / r^2 as a polynomial in r^2 on |r| <= pi/2, by Remez's algorithm: the error of
# sin r stays below 2e-19; of the first six terms below 3e-9.
_SINE = (
    -0.16666666666666666,
    0.008333333333333113,
    -0.0001984126984118571,
    2.755731920774661e-06,
    -2.5052106603099782e-08,
    1.6058927663756415e-10,
    -7.642708523081675e-13,
    2.7184506289152276e-15,
)
_SINGLE_TERMS = 6
# (arctan x / x - 1) / x^2 as P(x^2)/Q(x^2) on |x| <= 0.66, the leading coefficients first (Moshier,
# Cephes library, atan.c, 1989: relative error 2e-16 at most).
_ARCTAN_P = (
    -8.750608600031904122785e-1,
    -1.615753718733365076637e1,
    -7.500855792314704667340e1,
    -1.228866684490136173410e2,
    -6.485021904942025371773e1,
)
_ARCTAN_Q = (
    1.0,
    2.485846490142306297962e1,
    1.650270098316988542046e2,
    4.328810604912902668951e2,
    4.853903996359136964868e2,
    1.945506571482613964425e2,
)
# The part of pi/2 beyond its float64 value.
_HALF_PI_REST = 6.123233995736765886130e-17


def _horner(coefficients: tuple[float, ...], z: Array) -> Array:
    total = jnp.full_like(z, coefficients[0])
    for coefficient in coefficients[1:]:
        total = coefficient + z * total
    return total


def _negated(x: Array, turns: Array) -> Array:
    """x, negated if `turns`, a whole number, is odd.

    At the size of 1.5·2^52 (in float32 1.5·2^23) consecutive floats are consecutive integers, so
    that after its addition the lowest bit of a whole number is its parity.
    """
    digits, size, word = (23, 32, jnp.int32) if x.dtype == jnp.float32 else (52, 64, jnp.int64)
    parity = jax.lax.bitcast_convert_type(turns + 1.5 * 2.0**digits, word)
    bits = jax.lax.bitcast_convert_type(x, word) ^ (parity << (size - 1))
    return jax.lax.bitcast_convert_type(bits, x.dtype)


def _reduced_sine(x: Array, turns: Array, parity: Array) -> Array:
    """(−1)^parity sin(x − turns·π), for an argument of at most π/2."""
    single = x.dtype == jnp.float32
    pi, sine = (_PI_SINGLE, _SINE[:_SINGLE_TERMS]) if single else (_PI, _SINE)
    # Part by part; the first two products are exact (see `_PI`).
    r = ((x - turns * pi[0]) - turns * pi[1]) - turns * pi[2]
    if single:  # beyond 1e7 the parity is lost and r is meaningless
        r = select(abs(turns) < 2.0**22, r, 0 * r)
    z = r * r
    r = _negated(r, parity)
    return r + (r * z) * _horner(sine[::-1], z)


@jax.custom_jvp
def sin(x: Array) -> Array:
    """Sine of a float array, of any shape."""
    turns = jnp.round(x * (1 / np.pi))
    return _reduced_sine(x, turns, turns)


@jax.custom_jvp
def cos(x: Array) -> Array:
    """Cosine of a float array, of any shape."""
    turns = jnp.round(x * (1 / np.pi) - 0.5)
    return _reduced_sine(x, turns + 0.5, turns + 1)


@jax.custom_jvp
def arctan(x: Array) -> Array:
    """Arctangent of a float array, of any shape."""
    size = abs(x)
    # tan 3π/8; above it π/2 − arctan(1/x), and above 0.66 π/4 + arctan((x − 1)/(x + 1)).
    far, near = size > 2.414213562373095, size <= 0.66
    quarters = select(far, 2.0, select(near, 0.0, 1.0)).astype(x.dtype)
    above = select(far, -1.0, select(near, size, size - 1.0))
    below = select(far, size, select(near, 1.0, size + 1.0))
    # One division for all three ranges, which are selected before it.
    r = above / below
    z = r * r
    tail = z * _horner(_ARCTAN_P, z) / _horner(_ARCTAN_Q, z)
    angle = quarters * (np.pi / 4) + (r * tail + (quarters * (_HALF_PI_REST / 2) + r))
    return jnp.copysign(angle, x)


def arctan2(y: Array, x: Array) -> Array:
    """The angle of (x, y), with x hidden from the compiler. If x is known to be 1, XLA uses its
    arctangent, which is wrong (jaxlib 0.10.2)."""
    return jax.lax.atan2(y, select(y == y, x, y))


arctan.defjvps(lambda dx, _, x: dx / (1 + x * x))
sin.defjvps(lambda dx, _, x: dx * cos(x))
cos.defjvps(lambda dx, _, x: -(dx * sin(x)))
