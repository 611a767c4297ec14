"""The point of a step at which a function along the motion is largest, where its rate vanishes or
changes its sign."""

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.xla.select import select, select_all

# Largest number of steps to the length at which a rate changes its sign; halvings alone reach the
# rounding of a length.
_STEPS = 60

Turn: TypeAlias = tuple[Array, Array, Array]
"""Two lengths around a maximum, and the part of the way between them."""


def beyond(
    at: Callable[[Array], tuple[Array, Array]], turn: Turn, reach: Array, dt: Array
) -> Array:
    """Terms of second order of a maximum, of which the value and the first derivatives are zero.

    With the rate r and its slope r′ < 0 at a smooth maximum, the time of the maximum moves by
    −r/r′, and the value rises by −r²/2r′. At a kink with D = a − b it moves by −D/Ḋ, and

        a − (ȧ/Ḋ) D + (ä/Ḋ² − ȧ D̈/Ḋ³) D²/2

    is the value at which a and b cross; the first derivative has a constant part p of D for ȧ/Ḋ.
    """
    before, after, part = turn
    one = jnp.ones_like(before)
    (a, a_t), (_, a_tt) = jax.jvp(at, (before,), (one,))
    (b, b_t), (_, b_tt) = jax.jvp(at, (after,), (one,))
    a_tt, b_tt = stop_gradient((a_tt, b_tt))
    small = float(jnp.finfo(one.dtype).eps) ** 0.5
    rate, slope = select_all(part < 0.5, (a_t, a_tt), (b_t, b_tt))
    smooth = (slope < 0) & (abs(rate) <= -small * slope * dt)
    rises = -0.5 * rate**2 / select(smooth, slope, -one)
    apart, fall = a - b, a_t - b_t
    # The two lengths are so near that a smooth rate falls by less.
    kink = (after - before <= small * reach) & (fall > small * reach * (abs(a_tt) + abs(b_tt)))
    moves = apart / select(kink, fall, one)
    bend = (1 - part) * a_tt + part * b_tt
    crosses = (part - a_t / select(kink, fall, one)) * apart + 0.5 * bend * moves**2
    return select(kink, crosses, select(smooth, rises, 0.0))


def turning_point(at: Callable[[Array], tuple[Array, Array]], length: Array, reach: Array) -> Turn:
    """Two lengths between which the rate changes from positive to negative in a step of length
    `reach`, as close as rounding allows, and the part of the way from one to the other at which it
    does. Both are `length` without such a change."""

    def rate(h: Array) -> Array:
        return at(h)[1]

    def on(known: tuple[Array, ...]) -> Array:
        low, r_low, high, r_high, count = known
        part = _part(r_low, r_high)
        # The distance of the nearer length. At a jump both are near, with rates that are not small.
        away = jnp.minimum(part, 1 - part) * (high - low)
        small = 4 * jnp.finfo(high.dtype).eps * reach
        return (count < _STEPS) & (r_low > 0) & (r_high < 0) & (away > small)

    def closer(known: tuple[Array, ...]) -> tuple[Array, ...]:
        low, r_low, high, r_high, count = known
        secant = low + _part(r_low, r_high) * (high - low)
        # A secant is near at once where the rate is straight. Every other step is a halving, which
        # also approaches a jump.
        h = select(count % 2 == 0, jnp.clip(secant, low, high), _middle(low, high))
        r = rate(h)
        rises = r > 0
        return (
            select(rises, h, low),
            select(rises, r, r_low),
            select(rises, high, h),
            select(rises, r_high, r),
            count + 1,
        )

    middle, zero = length, jnp.zeros_like(length)
    r_middle, before = rate(middle), zero
    rises = r_middle > 0
    low, high = select(rises, middle, before), select(rises, reach, middle)
    known = low, rate(low), high, rate(high), jnp.zeros((), jnp.int32)
    low, r_low, high, r_high, _ = jax.lax.while_loop(on, closer, known)
    turns = (r_low > 0) & (r_high <= 0)
    low, high = select(turns, low, middle), select(turns, high, middle)
    return low, high, select(turns, _part(r_low, r_high), 0.0)


def _middle(low: Array, high: Array) -> Array:
    return low + 0.5 * (high - low)


def _part(r_low: Array, r_high: Array) -> Array:
    """The part of the way between two rates at which a line through them vanishes."""
    fall = r_low - r_high
    return select(fall > 0, r_low / select(fall > 0, fall, 1), 0.0)
