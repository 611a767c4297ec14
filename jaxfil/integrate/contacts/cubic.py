"""The cubic through values and rates of a guard at both ends of a step, and its first zero.

Hermite's cubic stands for the guard within a step: see `locate`.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.xla.select import select

NEVER = 2.0
"""θ of a contact that does not happen in this step."""

# A minimum in the middle of a step this small a part of the guard's range is stepped to and looked
# at: the cubic's own error could hide a dip below it. Towards the ends of a step that error falls
# like θ²(1 − θ)², and so does what is looked at.
SUSPICIOUS = 1 / 64


class Cubic(eqx.Module):
    """g(θ) = g0 + d0 θ + a θ² + b θ³ on [0, 1], its minimum and its maximum."""

    g0: Array
    d0: Array
    a: Array
    b: Array
    disc: Array
    low: Array
    high: Array

    def __init__(self, g0: Array, d0: Array, g1: Array, d1: Array):
        rise = g1 - g0
        a, b = 3 * rise - 2 * d0 - d1, d0 + d1 - 2 * rise
        self.g0, self.d0, self.a, self.b = g0, d0, a, b
        # Roots of 3bθ² + 2aθ + d0, each by the formula that does not cancel. The minimum is the
        # one where the second derivative 2a + 6bθ = +2√disc.
        disc = self.disc = a * a - 3 * b * d0
        root = jnp.sqrt(jnp.maximum(disc, 0))
        sum_ = select(a >= 0, a + root, a - root)
        near, far = -quotient(d0, sum_), -quotient(sum_, 3 * b)
        exists = disc > 0
        self.low = select(exists, select(a >= 0, near, far), NEVER)
        self.high = select(exists, select(a >= 0, far, near), NEVER)

    def __call__(self, theta: Array) -> Array:
        return self.g0 + theta * (self.d0 + theta * (self.a + theta * self.b))

    def slope(self, theta: Array) -> Array:
        return self.d0 + theta * (2 * self.a + 3 * theta * self.b)

    def bend(self, theta: Array) -> Array:
        return 2 * (self.a + 3 * theta * self.b)


def quotient(a: Array, b: Array) -> Array:
    """a/b, far outside the step where b = 0."""
    zero = b == 0
    return select(zero, NEVER, a / select(zero, 1, b))


def _descending_root(cubic: Cubic, lo: Array, hi: Array, armed: Array) -> Array:
    """The root in [lo, hi], on which the cubic falls from ≥ 0 to < 0 without turning.

    A guard that starts at zero, at θ = 0, and has its maximum at lo comes back to zero between
    1.5 lo (where its rate started at zero too) and 2 lo (a parabola). Two of Halley's iterations
    leave about the cubic's own error; what they leave the next trial step finds.
    """
    theta = select(armed, 0.5 * (lo + hi), jnp.minimum(1.75 * lo, hi))
    for _ in range(2):
        value, slope = cubic(theta), cubic.slope(theta)
        bottom = slope * slope - 0.5 * value * cubic.bend(theta)
        theta = jnp.clip(theta - quotient(value * slope, bottom), lo, hi)
    return theta


def first_contact(
    g0: Array, d0: Array, g1: Array, d1: Array, armed: Array, noise: Array
) -> tuple[Array, Array]:
    """θ of the first contact, and θ of a minimum to be looked at; `NEVER` where there is none.

    `d0`, `d1` are rates times the step. `noise` is what rounding does to the guard; a surface not
    `armed` was left at this step's start or has not been left by more than `noise` since.
    """
    cubic = Cubic(g0, d0, g1, d1)
    inside = (cubic.low > 0) & (cubic.low < 1)
    low_value = cubic(cubic.low)
    # The end alone would not do: a dip below zero and back is two contacts, or an impact missed.
    dips = inside & (low_value < -noise)
    # One that has not been left and rises is leaving, from however little below zero.
    contact = dips | ((g1 < -noise) & (armed | (d1 < 0)))
    # The first root lies before the minimum, if that is below zero, and after the maximum: between
    # the two the cubic falls, and Halley's iteration cannot leave for another root.
    hi = select(dips, cubic.low, 1.0)
    rises_first = (cubic.high > 0) & (cubic.high < hi)
    lo = select(rises_first, cubic.high, 0.0)
    root = _descending_root(cubic, lo, hi, armed)
    # A surface just left must rise before it can be met again. If the cubic does not show that
    # rise the step is too long for it: look at a quarter.
    root = select(armed | rises_first, root, 0.25 * hi)
    reach = abs(d0) + abs(d1)
    # A guard that is rounding where it starts, as of a mass at the very limit of its friction,
    # says no more at a minimum.
    starts = jnp.maximum(abs(g0), abs(d0))
    inner = 4 * cubic.low * (1 - cubic.low)
    hidden = SUSPICIOUS * inner * inner * reach
    near = ((abs(low_value) <= 4 * noise) | (low_value <= hidden)) & (starts > 4 * noise)
    look = (armed | (rises_first & (cubic.low > cubic.high))) & inside & ~dips & near
    # Where squares of guards overflow no contact can be told from none: both are then NaN.
    known = 0 * cubic.disc
    theta = select(contact, root, NEVER) + known
    return theta, select(look & ~contact, cubic.low, NEVER) + known


def lower_bound(g0: Array, d0: Array, g1: Array, d1: Array) -> Array:
    """The least of the cubic's Bernstein coefficients, above which it lies."""
    return jnp.minimum(jnp.minimum(g0, g1), jnp.minimum(g0 + d0 / 3, g1 - d1 / 3))


def stays_off(g0: Array, d0: Array, g1: Array, d1: Array, noise: Array) -> Array:
    """Whether an armed guard stays so far above zero that `first_contact` finds nothing. Cheaper,
    and never true in error."""
    low = lower_bound(g0, d0, g1, d1)
    return low > jnp.maximum(SUSPICIOUS * (abs(d0) + abs(d1)), 4 * noise)


def stays_within(g0: Array, d0: Array, g1: Array, d1: Array, noise: Array) -> Array:
    """Whether the cubic stays within its rounding of zero, as all its Bernstein coefficients do."""
    ends, inner = jnp.maximum(abs(g0), abs(g1)), jnp.maximum(abs(g0 + d0 / 3), abs(g1 - d1 / 3))
    return jnp.maximum(ends, inner) <= noise
