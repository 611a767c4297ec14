"""A bracketed zero of a smooth function, with a fixed number of evaluations for all lanes."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfil.xla.select import select

# Number of evaluations. The Illinois rule is of order 1.44; 12 reduce an interval from 1 to eps, in
# both precisions, with two to spare.
_EVALUATIONS = 14


def zero_between(
    function: Callable[[Array], Array], a: Array, b: Array, at_a: Array, at_b: Array
) -> Float[Array, ""]:
    """The zero of `function` in [a, b], by the Illinois variant of regula falsi. If the values at
    the ends have the same sign, any point of the interval."""

    def narrow(_: Array, state: tuple) -> tuple:
        low, high, at_low, at_high, last = state
        gap = at_high - at_low
        secant = low - at_low * (high - low) / select(gap == 0, 1, gap)
        middle = jnp.clip(secant, jnp.minimum(low, high), jnp.maximum(low, high))
        value = function(middle)
        left = (value > 0) == (at_low > 0)
        # The value at an end that stays for the second time is halved.
        kept_low = select(last < 0, 0.5 * at_low, at_low)
        kept_high = select(last > 0, 0.5 * at_high, at_high)
        return (
            select(left, middle, low),
            select(left, high, middle),
            select(left, value, kept_low),
            select(left, kept_high, value),
            select(left, 1, -1).astype(jnp.int32),
        )

    start = (a, b, at_a, at_b, jnp.zeros((), jnp.int32))
    low, high, at_low, at_high, _ = jax.lax.fori_loop(0, _EVALUATIONS, narrow, start)
    return select(abs(at_low) < abs(at_high), low, high)
