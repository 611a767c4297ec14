"""Sine and cosine that vectorise.

Float64 arrays enter, their sine or cosine leaves: a polynomial after range reduction. XLA's own
are one scalar library call a lane on CPU, and cost more than all the rest of a typical
oscillator's field.

Accuracy: within 2 ulp of one for |x| < 1e5; beyond, the error stays of the order of eps·|x|, which
is what rounding of the argument itself does.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

# pi in parts of 33, 33 and 53 bits: a half-integer below 2^20 times one of the first two is exact
# (Cody and Waite 1980; twice the parts of pi/2 in fdlibm).
_PI = (3.14159265346825122834e00, 1.21542010126079319340e-10, 4.04453249759190126308e-21)
# (sin r / r - 1) / r^2 as a polynomial in r^2 on |r| <= pi/2, by Remez's algorithm: the error of
# sin r stays below 2e-19.
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


def _reduced_sine(x: Array, turns: Array, parity: Array) -> Array:
    """(−1)^parity sin(x − turns·π), for an argument of at most π/2."""
    r = ((x - turns * _PI[0]) - turns * _PI[1]) - turns * _PI[2]
    z = r * r
    tail = jnp.full_like(z, _SINE[-1])
    for coefficient in reversed(_SINE[:-1]):
        tail = coefficient + z * tail
    half = 0.5 * parity
    sign = 1 - 4 * (half - jnp.floor(half))
    return sign * (r + r * (z * tail))


@jax.custom_jvp
def sin(x: Array) -> Array:
    """Sine of a float64 array, of any shape."""
    turns = jnp.round(x * (1 / np.pi))
    return _reduced_sine(x, turns, turns)


@jax.custom_jvp
def cos(x: Array) -> Array:
    """Cosine of a float64 array, of any shape."""
    turns = jnp.round(x * (1 / np.pi) - 0.5)
    return _reduced_sine(x, turns + 0.5, turns + 1)


sin.defjvps(lambda dx, _, x: dx * cos(x))
cos.defjvps(lambda dx, _, x: -(dx * sin(x)))
