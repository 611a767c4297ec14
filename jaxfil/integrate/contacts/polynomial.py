"""The first zero of a guard that is a polynomial within its step.

For a guard g(s) = Σ c_k s^k, s from 0 to 1, the result is its first zero, or a minimum too close to
zero to be distinguished from one. A polynomial lies above the smallest of its Bernstein
coefficients. The coefficients of the part of degree three, less the sizes of all higher terms,
exclude a zero in nearly every step. Otherwise the step is halved until the polynomial is monotone,
convex or concave in it, by the same bounds on its derivatives. The number of zeros is then known,
and Newton's method in a bracket locates the one.

A guard that starts at zero is divided by s, or by s² if its rate is zero too, since the zero at the
start is not a contact.
"""

from collections.abc import Sequence

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import NEVER
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.select import select

# A minimum above this multiple of the guard's rounding is not a zero.
_CLOSE = 4
# The largest number of halvings until a guard is simple. For any other guard, the search that
# serves all steppers takes over.
_HALVINGS = 24
# The largest number of Newton iterations, bisections included, and the change after which one more
# iteration is enough.
_NEWTON, _SMALL = 60, 0.1
# Number of iterations that nearly all zeros need, written out before the loop.
_WRITTEN_OUT = 2


Guard = tuple[Array, ...]


def _bounds(c: Sequence[Array]) -> tuple[Array, Array]:
    """Lower and upper bounds of a polynomial on [0, 1]."""
    c0, c1, c2, c3, *higher = (*c, 0.0, 0.0, 0.0)
    # Bernstein coefficients of the cubic part.
    inner = c0 + c1 / 3, c0 + (2 * c1 + c2) / 3, c0 + c1 + c2 + c3
    low, high = c0, c0
    for v in inner:
        low, high = jnp.minimum(low, v), jnp.maximum(high, v)
    rest = sum(map(abs, higher))
    return low - rest, high + rest


def _slope(c: Sequence[Array]) -> Guard:
    return tuple(k * v for k, v in enumerate(c) if k > 0)


def _value_and_slope(c: Sequence[Array], s: Array) -> tuple[Array, Array]:
    *lower, value = c
    slope = jnp.zeros_like(value)
    for v in reversed(lower):
        slope = value + s * slope
        value = v + s * value
    return value, slope


def _zeros_at_start(c: Guard) -> tuple[Array, Array]:
    """Whether a polynomial has a zero at 0, and whether it has two."""
    once = c[0] <= 0
    return once, once & (c[1] <= 0)


def _reduced(c: Guard) -> Guard:
    """The polynomial with its zeros at 0 divided out, up to two of them."""
    (once, twice), zero = _zeros_at_start(c), jnp.zeros_like(c[0])
    padded = (*c, zero, zero)
    return tuple(
        select(twice, padded[k + 2], select(once, padded[k + 1], v)) for k, v in enumerate(c)
    )


def stays_positive(c: Guard, noise: Array) -> Array:
    """Whether a guard has no zero in its step, except at the start, and stays away from zero."""
    low, _ = _bounds(_reduced(c))
    # The noise of a guard does not apply to its quotient by s or s².
    return low > select(c[0] > 0, _CLOSE * noise, 0.0)


# Knowledge of the zeros of a polynomial: unknown; no zero; one zero; a minimum inside, and no zero
# at the end.
_UNKNOWN, _NO_ZERO, _ONE_ZERO, _TURNS = range(4)


def first_zero(system: ComponentSystem, noise: Array, *c: Array) -> tuple[Array, Array, Array]:
    """The fraction of its step at which a guard has its first zero, and the one at which the step
    should end because the guard is unknown beyond it, at a minimum that is zero to rounding, or
    where the search has stopped; `NEVER` without one. The third value is 1 if both are known, else
    0. `noise` is the rounding of the guard."""
    # A guard entirely within rounding has no meaningful zeros.
    quiet = sum(map(abs, c)) <= _CLOSE * noise
    # As in `stays_positive`, the noise does not apply to a quotient by s or s².
    noise = select(c[0] > 0, noise, 0.0)
    kind = system.hold(select(quiet, float(_NO_ZERO), _kind(_reduced(c), noise)))

    def halved(kind: Array, noise: Array, *c: Array) -> tuple[Array, Array]:
        return _halved(_reduced(c), kind, noise)

    def whole(kind: Array, noise: Array, *_: Array) -> tuple[Array, Array]:
        return kind, jnp.ones_like(noise)

    unknown = jnp.any(kind == _UNKNOWN)
    kind, scale = system.where_any(unknown, halved, whole, kind, noise, *c)
    turns = kind == _TURNS

    def minimum(turns: Array, scale: Array, *c: Array) -> tuple[Array, Array]:
        return _minimum(system, _reduced(c), turns, scale)

    def nowhere(turns: Array, scale: Array, *_: Array) -> tuple[Array, Array]:
        return scale, jnp.ones_like(scale)

    lowest, least = system.where_any(jnp.any(turns), minimum, nowhere, turns, scale, *c)
    below, grazes = turns & (least < -noise), turns & (abs(least) <= _CLOSE * noise)
    crosses = (kind == _ONE_ZERO) | below
    # The first zero lies before a minimum that is below zero.
    s = _descending(system, c, crosses, select(below, lowest, scale))
    look = select(grazes, lowest, select(scale < 1, scale, NEVER))
    known = (kind != _UNKNOWN).astype(noise.dtype)
    return select(crosses, s, NEVER), select(crosses, NEVER, look), known


def _kind(q: Sequence[Array], noise: Array) -> Array:
    """The kind of a polynomial that is positive at 0, by its zeros."""
    low, _ = _bounds(q)
    slope = _slope(q)
    bend = _slope(slope)
    (falls, rises), (concave, convex) = _signs(slope), _signs(bend)
    end, rate, first = sum(q), sum(slope), slope[0]
    below = end < -noise
    # A monotone, convex or concave polynomial that is positive at 0 and negative at the end has one
    # zero.
    single = below & (falls | convex | concave)
    # A convex polynomial that falls at the start and rises at the end has its minimum inside.
    turns = convex & (first < 0) & (rate > 0)
    simple = falls | rises | concave | (convex & ~turns)
    clear = (low > _CLOSE * noise) | (~below & simple) | (q[0] <= 0)
    other = select(single, _ONE_ZERO, select(~below & turns, _TURNS, _UNKNOWN))
    return select(clear, _NO_ZERO, other).astype(noise.dtype)


def _signs(c: Sequence[Array]) -> tuple[Array, Array]:
    """Whether a polynomial is negative, and whether it is positive."""
    low, high = _bounds(c)
    return high < 0, low > 0


def _halved(q: Guard, kind: Array, noise: Array) -> tuple[Array, Array]:
    """The kind of the polynomial in the first half, quarter and so on, and the fraction used."""

    def unknown(carry: tuple) -> Array:
        _, kind, _, count = carry
        return eqxi.unvmap_any(kind == _UNKNOWN) & (count < _HALVINGS)

    def halve(carry: tuple) -> tuple:
        q, kind, scale, count = carry
        half = select(kind == _UNKNOWN, 0.5, 1.0)
        # On the first half the polynomial is one on [0, 1] with the coefficients c_k/2ᵏ.
        power, smaller = jnp.ones_like(noise), []
        for v in q:
            smaller.append(v * power)
            power = power * half
        found = _kind(smaller, noise)
        return tuple(smaller), select(kind == _UNKNOWN, found, kind), scale * half, count + 1

    start = q, kind, jnp.ones_like(noise), jnp.zeros((), jnp.int32)
    _, kind, scale, _ = jax.lax.while_loop(unknown, halve, start)
    return kind, scale


def _minimum(system: ComponentSystem, q: Guard, turns: Array, high: Array) -> tuple[Array, Array]:
    """The position before `high` at which a convex polynomial is smallest, and its value there."""
    # The slope of a convex polynomial rises through zero, and `_descending` expects one that falls.
    falls = tuple(-v for v in _slope(q))
    s = _descending(system, (*falls, jnp.zeros_like(high)), turns, high)
    return s, _value_and_slope(q, s)[0]


def _descending(system: ComponentSystem, c: Guard, todo: Array, high: Array) -> Array:
    """The zero in (0, high) of a polynomial that is positive after 0 and negative at `high`, by
    Newton's method in a shrinking bracket, with zeros at 0 divided out; `high` where `todo` is
    false."""
    small = _SMALL * float(jnp.finfo(high.dtype).eps) ** 0.5
    once, twice = _zeros_at_start(c)
    zeros = system.hold(select(twice, 2.0, select(once, 1.0, 0.0)).astype(high.dtype))
    start = system.hold(_guess(c, zeros, todo, high))

    def improved(s: Array, low: Array, high: Array, todo: Array) -> tuple:
        value, slope = _value_and_slope(c, s)
        low, above = select(value > 0, s, low), select(value > 0, high, s)
        # Newton's method for the polynomial divided by s^zeros, whose logarithmic derivative is
        # slope/value − zeros/s.
        rate = slope - zeros * value / s
        new = s - value / select(rate == 0, 1, rate)
        inside = (new >= low) & (new <= above) & (rate != 0)
        near = (inside & (abs(new - s) <= small * above)) | (value == 0)
        new = select(todo, select(inside, new, 0.5 * (low + above)), s)
        done = (todo & ~near).astype(high.dtype)
        return system.hold((new, low, above, done))

    s, low, above, going = start, jnp.zeros_like(high), high, todo.astype(high.dtype)
    for _ in range(_WRITTEN_OUT):
        s, low, above, going = improved(s, low, above, going > 0)

    def on(carry: tuple) -> Array:
        *_, going, count = carry
        return eqxi.unvmap_any(going > 0) & (count < _NEWTON)

    def again(carry: tuple) -> tuple:
        s, low, above, going, count = carry
        return *improved(s, low, above, going > 0), count + 1

    first = s, low, above, going, jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(on, again, first)[0]


def _guess(c: Guard, zeros: Array, todo: Array, high: Array) -> Array:
    """An estimate of the zero in (0, high) from the part of degree three, with the higher terms
    fixed at their value at `high`; `high` where `todo` is false."""
    bottom = _value_and_slope(c, high)[0]
    c0, c1, c2, _ = c[:4]
    c3 = (bottom - c0 - high * (c1 + high * c2)) / (high * high * high)
    top = select(zeros > 0, -bottom, c0)
    s = high * select(todo, top / select(top == bottom, 1.0, top - bottom), 1.0)
    for _ in range(2):
        value = c0 + s * (c1 + s * (c2 + s * c3))
        rate = c1 + s * (2 * c2 + 3 * s * c3) - zeros * value / s
        # The lower limit is positive, since the next rate has a quotient by s.
        s = jnp.clip(s - value / select(rate == 0, 1.0, rate), 0.01 * s, high)
    # NaN differs from itself, and `high` takes its place.
    return select(todo & (s == s), s, high)
