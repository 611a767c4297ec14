"""The cubic through values and rates of a guard at both ends of a step, and its first zero.

Hermite's cubic interpolates the guard within a step (see `locate`).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.xla.select import select

NEVER = 2.0
"""θ of a contact that does not happen in this step."""

# A minimum in the middle of a step that is below this part of the guard's range is examined by a
# step to it, since the cubic's own error could hide a dip below zero. Towards the ends of a step
# that error falls like θ²(1 − θ)², and so does this limit.
SUSPICIOUS = 1 / 64
# A value is zero within rounding below this many times the noise of its guard.
_ROUNDING = 4
# Where a guard that starts at zero is first looked for at zero again, as a multiple of the time of
# its maximum: between a guard with zero rate at its start, 1.5, and a parabola, 2.
_RETURN = 1.75
# The part of a step that is tried where the cubic of the whole one cannot be right.
_PART = 0.25


class Cubic(eqx.Module):
    """g(θ) = g0 + d0 θ + a θ² + b θ³ on [0, 1], its minimum and its maximum."""

    g0: Array
    d0: Array
    a: Array
    b: Array
    disc: Array
    """The discriminant a² − 3 b d0 of the slope; without a positive one there is no minimum."""
    low: Array
    """θ of the local minimum, anywhere; `NEVER` without one."""
    high: Array
    """θ of the local maximum, anywhere; `NEVER` without one."""

    def __init__(self, g0: Array, d0: Array, g1: Array, d1: Array):
        rise = g1 - g0
        a, b = 3 * rise - 2 * d0 - d1, d0 + d1 - 2 * rise
        self.g0, self.d0, self.a, self.b = g0, d0, a, b
        # Roots of 3bθ² + 2aθ + d0, each by the formula that does not cancel. The minimum is the
        # one where the second derivative 2a + 6bθ = +2√disc.
        disc = self.disc = a * a - 3 * b * d0
        root = jnp.sqrt(jnp.maximum(disc, 0))
        sum_ = select(a >= 0, a + root, a - root)
        # `near` is the root nearer to θ = 0: the minimum if the cubic is convex there, a ≥ 0, and
        # otherwise the maximum.
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

    A guard that is not `armed` starts at zero, at θ = 0, and has its maximum at lo. Two iterations
    of Halley's method are accurate to about the cubic's own error; the next trial step corrects the
    rest.
    """
    theta = select(armed, 0.5 * (lo + hi), jnp.minimum(_RETURN * lo, hi))
    for _ in range(2):
        value, slope = cubic(theta), cubic.slope(theta)
        bottom = slope * slope - 0.5 * value * cubic.bend(theta)
        theta = jnp.clip(theta - quotient(value * slope, bottom), lo, hi)
    return theta


def first_contact(
    g0: Array, d0: Array, g1: Array, d1: Array, armed: Array, noise: Array
) -> tuple[Array, Array]:
    """θ of the first contact, and θ of a minimum to be examined; `NEVER` in place of either if it
    does not exist.

    `d0`, `d1` are rates times the step. `noise` is the rounding of the guard. A surface that is not
    `armed` was left at the start of this step, or its guard has not exceeded `noise` since.
    """
    cubic = Cubic(g0, d0, g1, d1)
    inside = (cubic.low > 0) & (cubic.low < 1)
    low_value = cubic(cubic.low)
    # The sign at the end is not enough, since a dip below zero and back is two contacts, or an
    # impact that would be missed.
    dips = inside & (low_value < -noise)
    # A rising guard that is not armed is leaving its surface, however little below zero it starts.
    contact = dips | ((g1 < -noise) & (armed | (d1 < 0)))
    # The first root lies before the minimum, if that is below zero, and after the maximum. Between
    # the two the cubic decreases, and Halley's iteration cannot jump to another root.
    hi = select(dips, cubic.low, 1.0)
    rises_first = (cubic.high > 0) & (cubic.high < hi)
    lo = select(rises_first, cubic.high, 0.0)
    root = _descending_root(cubic, lo, hi, armed)
    # A surface just left must rise before it can be reached again. If the cubic does not show that
    # rise, the step is too long for it, and a part of it is tried.
    root = select(armed | rises_first, root, _PART * hi)
    reach = abs(d0) + abs(d1)
    # A guard within rounding at its start, as for a mass at the limit of its friction, has no
    # meaningful minimum.
    starts = jnp.maximum(abs(g0), abs(d0))
    # 1 in the middle of the step, 0 at its ends.
    inner = 4 * cubic.low * (1 - cubic.low)
    hidden = SUSPICIOUS * inner * inner * reach
    zero = _ROUNDING * noise
    near = ((abs(low_value) <= zero) | (low_value <= hidden)) & (starts > zero)
    look = (armed | (rises_first & (cubic.low > cubic.high))) & inside & ~dips & near
    # If squares of guards overflow, contacts cannot be detected, and both results are NaN.
    known = 0 * cubic.disc
    theta = select(contact, root, NEVER) + known
    return theta, select(look & ~contact, cubic.low, NEVER) + known


def lower_bound(g0: Array, d0: Array, g1: Array, d1: Array) -> Array:
    """The smallest of the cubic's Bernstein coefficients, a lower bound on [0, 1]."""
    return jnp.minimum(jnp.minimum(g0, g1), jnp.minimum(g0 + d0 / 3, g1 - d1 / 3))


def stays_off(g0: Array, d0: Array, g1: Array, d1: Array, noise: Array) -> Array:
    """Whether an armed guard stays so far above zero that `first_contact` has no result. It is
    cheaper, and a True is always right."""
    low = lower_bound(g0, d0, g1, d1)
    return low > jnp.maximum(SUSPICIOUS * (abs(d0) + abs(d1)), _ROUNDING * noise)


def stays_within(g0: Array, d0: Array, g1: Array, d1: Array, noise: Array) -> Array:
    """Whether the cubic stays within its rounding of zero, as all its Bernstein coefficients do."""
    ends, inner = jnp.maximum(abs(g0), abs(g1)), jnp.maximum(abs(g0 + d0 / 3), abs(g1 - d1 / 3))
    return jnp.maximum(ends, inner) <= noise
