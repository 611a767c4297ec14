"""Jumps in power series: comparisons and other operations that are constant between their jumps.

If a motion starts on a jump or kink of a program, as at rest where a friction reverses, the part
just after the start is right, which the first coefficients of the motion decide. Coefficient k + 1
of a state is coefficient k of its field, which needs the decision itself. A field that is
continuous there has the same value on both sides, so coefficients of order 0 need no decision, and
where a decision needs coefficients up to order k + 1, both sides agree up to order k. `Taylor` thus
computes the field up to order 0 with the decisions at the start (`Expansion.ahead` = 0), up to
order 1 with those up to order 1, and all others with those up to order `AHEAD`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.xla.select import select
from jaxfil.xla.series import AHEAD, Expansion, Series, first_of


def decided_by(expansion: Expansion, *values: Series) -> int:
    """The order up to which coefficients decide a jump of some values."""
    # Coefficients of time, and of constants, depend on no decision.
    if all(v.degree is not None for v in values):
        return AHEAD
    expansion.jumps = True
    return expansion.ahead


def compared(expansion: Expansion, compare: Callable, a: Series, b: Series) -> Series:
    """The flag of a comparison of the first coefficients that differ, as the values do just after
    the start of a step."""
    if a.degree == b.degree == 0:
        return expansion.series(lambda _: compare(first_of(a), first_of(b)), 0)
    highest = decided_by(expansion, a, b)
    if expansion.ahead == AHEAD and compare not in (jnp.equal, jnp.not_equal):
        expansion.compared[a, b] = None

    def from_order(k: int) -> Any:
        own, other = _filled(a, k), _filled(b, k)
        now = compare(own, other)
        return now if k == highest else select(own == other, from_order(k + 1), now)

    return expansion.series(lambda _: from_order(0), 0)


def _filled(v: Series, k: int) -> Any:
    """Coefficient k, with a zero for a structural one."""
    return jnp.zeros_like(first_of(v)) if v[k] is None else v[k]


def list_places(expansion: Expansion, eqn: Any, values: Sequence[Series], out: Series) -> None:
    """Lists the pairs that are equal where an operation jumps next, given its operands, and its
    result in this step. Of an operation for which they are not known the name is listed."""
    name, a = eqn.primitive.name, values[0]
    if expansion.ahead < AHEAD or all(v.degree == 0 for v in values) or name in _WITHOUT_PLACE:
        return
    if name == "convert_element_type":
        if not jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.integer):
            return
        # Between −1 and 1 this has one place too many, at zero.
        out = expansion.series(lambda _: jnp.floor(just_after(AHEAD, a)), 0)
    if name == "rem":
        size = expansion.series(lambda _: abs(values[1][0]), 0)
        sides = (out, expansion.constant(0.0)), (size, out), (out, _moved(expansion, size, -1.0))
    elif name in _STEPS:
        below, above = (_moved(expansion, out, 1.0, shift) for shift in _STEPS[name])
        sides = (a, below), (above, a)
    elif name == "sign":
        sides = ((a, expansion.constant(0.0)),)
    else:
        expansion.unplaced[name] = None
        return
    expansion.compared.update(dict.fromkeys(sides))


# The interval of operands with one result, from the result on.
_STEPS = {
    "ceil": (-1.0, 0.0),
    "convert_element_type": (0.0, 1.0),
    "floor": (0.0, 1.0),
    "round": (-0.5, 0.5),
}
# Operations whose result changes nowhere, or only at single moments, as a test for equality.
_WITHOUT_PLACE = frozenset(["is_finite"])


def _moved(expansion: Expansion, v: Series, factor: float, shift: float = 0.0) -> Series:
    """factor v + shift, for a constant."""
    return expansion.series(lambda _: factor * first_of(v) + shift, 0)


def kinks_of(expansion: Expansion, orders: int) -> tuple[Array, ...] | None:
    """The differences of all pairs that are compared, as series that are positive just after the
    start of a step: their coefficients, one array for each order. None without any."""
    if expansion.unplaced:
        raise ValueError(
            "`stepper` must not be jaxfil.Taylor() with a tolerance, or a kink in `switching`, for "
            "a system with an operation whose jumps it cannot locate, got one with "
            f"`{next(iter(expansion.unplaced))}`. diffrax.Dopri8() takes any."
        )
    pairs = list(expansion.compared)
    if not pairs:
        return None

    def coefficient(k: int) -> Array:
        return jnp.concatenate([jnp.ravel(_filled(a, k) - _filled(b, k)) for a, b in pairs])

    rows = [coefficient(k) for k in range(orders)]
    # As in `compared`, the first coefficient that is not zero decides.
    side = jnp.zeros_like(rows[0])
    for row in reversed(rows[: AHEAD + 1]):
        side = select(row == 0, side, jnp.sign(row))
    return tuple(side * row for row in rows)


def just_after(ahead: int, a: Series) -> Any:
    """A value just after the start of a step, apart from the value there by its last bits in the
    direction of the motion, which the coefficients up to order `ahead` tell."""
    first = first_of(a)
    if a.degree == 0 or not jnp.issubdtype(first.dtype, jnp.floating):
        return first
    direction = jnp.zeros_like(first)
    for k in range(ahead, 0, -1):
        if a[k] is not None:
            direction = select(a[k] != 0, jnp.sign(a[k]), direction)
    # The smallest normal number, since XLA may replace those below by zero.
    limits = jnp.finfo(first.dtype)
    return first + direction * (limits.eps * abs(first) + limits.tiny)
