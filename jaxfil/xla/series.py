"""Power series of a program's values: Taylor coefficients by recurrences.

Given power series of a program's arguments, its results are power series too. Each operation has a
recurrence for coefficient k of its result from coefficients up to k of its operands: a product is a
convolution, y = exp(u) has y' = u' y, and so on (Jorba and Zou, A software package for the
numerical integration of ODEs by means of high-order Taylor methods, Experimental Mathematics 14,
2005). Coefficients that are zero by structure are not computed, for constants, for time, and for
linear functions of time, whose sine and cosine are one of each.

A solution of x' = f(t, x) is the series of its own field: coefficient k + 1 of x is coefficient k
of f, divided by k + 1. Coefficients are therefore computed on demand, and stored.
"""

import functools as ft
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxfil.xla.bounded_slope import bounded

# Orders of a motion that decide its jumps, 2 for a start at rest on a kink.
AHEAD = 2


class Series:
    """A value as a power series in time; `self[k]` is coefficient k, None for a structural zero.
    Values are numbers or arrays."""

    __slots__ = ("_make", "degree", "is_kept", "is_of_time", "known", "multiple", "terms")

    def __init__(self, make: Callable[[int], Any], degree: int | None = None):
        self._make = make
        self.known: dict[int, Any] = {}
        """Coefficients computed so far."""
        self.degree = degree
        """0 for a constant, 1 for a linear function of time; None for others."""
        # Its one or two coefficients are used at every order, so `Expansion.stage` must not drop
        # them.
        self.is_kept = degree is not None
        """Whether coefficients of higher orders depend on all of these."""
        self.is_of_time = False
        """Whether it depends on time alone."""
        self.multiple: tuple[Series, Series] | None = None
        """The constant and the series of which it is the product; None for other series."""
        self.terms: tuple[tuple[float, Series], ...] | None = None
        """The series of which it is the sum, each with a sign; None for other series."""

    def __getitem__(self, k: int) -> Any:
        if self.degree is not None and k > self.degree:
            return None
        if k not in self.known:
            self.known[k] = self._make(k)
        return self.known[k]


class Same:
    """A value compared by identity, for use as a key."""

    __slots__ = ("value",)

    def __init__(self, value: Any):
        self.value = value

    def __hash__(self) -> int:
        # The key holds the value, so that its identity is not used again.
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and other.value is self.value


class Expansion:
    """A set of related series, and the functions for their first coefficients.

    `functions` replace XLA's, as in `trace`; each sine and cosine goes through `hold`. Slopes of
    `roots` are zero where they are infinite (`bounded_slope`).
    """

    def __init__(
        self,
        functions: Mapping[str, Callable],
        hold: Callable = lambda v: v,
        roots: Collection[str] = (),
    ):
        self.functions, self._hold, self._roots = functions, hold, roots
        self.made: list[Series] = []
        self.ahead = AHEAD
        """The order up to which coefficients of a motion decide its jumps (see `series_jumps`)."""
        self.jumps = False
        """Whether there are any, as comparisons of states."""
        self.compared: dict[tuple[Series, Series], None] = {}
        """The pairs of which a program takes the larger or the smaller, or selects by it, and those
        that are equal where another operation jumps."""
        self.unplaced: dict[str, None] = {}
        """The names of operations of which it is not known where they jump."""
        self._same: dict[tuple, Any] = {}

    def series(self, make: Callable[[int], Any], degree: int | None = None) -> Series:
        """A series with coefficient k given by `make(k)`."""
        made = Series(make, degree)
        self.made.append(made)
        return made

    def constant(self, value: Any) -> Series:
        """A constant."""

        # Not in `self.made`, like time. `stage` would pass its value as a traced argument.
        def made() -> Series:
            known = Series(lambda _: value, 0)
            known.known[0] = value
            return known

        return self.once(("constant", Same(value)), made)

    def linear(self, value: Any, rate: Any) -> Series:
        """The series value + rate·s."""
        made = Series(lambda _: None, 1)
        made.known.update({0: value, 1: rate})
        return made

    @property
    def num_kept(self) -> int:
        """The number of series on whose coefficients higher orders depend."""
        return sum(v.is_kept for v in self.made)

    def once(self, key: tuple, make: Callable[[], Any]) -> Any:
        """The result of `make`, computed once for each key; series are compared by identity."""
        if key not in self._same:
            self._same[key] = make()
        return self._same[key]

    def first(self, name: str, *values: Any) -> Any:
        """A function of one or two numbers, by its name in XLA."""
        given = self.functions.get(name)
        # The replacements are polynomials for these two types (see `fast_trig`).
        if given is not None and jnp.result_type(*values) in (jnp.float32, jnp.float64):
            return self._hold(given(*values))
        function = getattr(jax.lax, name)
        return bounded(function)(*values) if name in self._roots else function(*values)

    def stage(self, wanted: Sequence[Series], orders: range, run: Callable) -> None:
        """Computes some coefficients of some series inside `run(function, arrays)`, which calls the
        function behind a fence, so that a compiler computes each of them once. Coefficients on
        which later ones do not depend are dropped."""
        lasting = {v for v in self.made if v.is_kept} | set(wanted)
        carried = [v for v in self.made if v in lasting]
        others = [v for v in self.made if v not in lasting]
        before = [dict(v.known) for v in carried]

        # Inside `run` the known coefficients are traced arguments, which replace the outer ones.
        # `others` are cleared before and after, since they would hold traced values.
        def made(known: list) -> list:
            for v, own in zip(carried, known, strict=True):
                v.known = dict(own)
            for v in others:
                v.known = {}
            for k in orders:
                for v in wanted:
                    v[k]
            new = [
                {k: c for k, c in v.known.items() if k not in own}
                for v, own in zip(carried, before, strict=True)
            ]
            for v in others:
                v.known = {}
            return new

        new = run(made, before)
        for v, old, more in zip(carried, before, new, strict=True):
            v.known = old | more


def kept(*values: Series) -> None:
    """Marks series on all of whose coefficients higher orders depend."""
    for v in values:
        v.is_kept = True


def degree_of(*values: Series) -> int | None:
    """The degree of a sum."""
    degrees = [v.degree for v in values if v.degree is not None]
    return max(degrees, default=0) if len(degrees) == len(values) else None


def linear_function(expansion: Expansion, function: Callable, value: Series) -> Series:
    """A linear function of one value."""

    def make(k: int) -> Any:
        v = value[k]
        return None if v is None else function(v)

    return expansion.series(make, value.degree)


def add(terms: Sequence[Any]) -> Any:
    """The sum of coefficients."""
    known = [v for v in terms if v is not None]
    return ft.reduce(jnp.add, known) if known else None


def first_of(a: Series) -> Any:
    """Coefficient 0 as a number."""
    return a[0] if a[0] is not None else jnp.zeros_like(a[1])


def times(a: Any, b: Any) -> Any:
    """The product of coefficients."""
    return None if a is None or b is None else a * b


def scaled(factor: float, v: Any) -> Any:
    """A number times a coefficient."""
    return None if v is None else factor * v


def sum_of(expansion: Expansion, terms: Sequence[Series]) -> Series:
    """The sum of one or more values."""
    if len(terms) == 1:
        return terms[0]
    out = expansion.series(lambda k: add([v[k] for v in terms]), degree_of(*terms))
    out.terms = tuple((1.0, v) for v in terms)
    return out


def difference(expansion: Expansion, a: Series, b: Series) -> Series:
    """a − b."""
    out = expansion.series(lambda k: minus(a[k], b[k]), degree_of(a, b))
    out.terms = (1.0, a), (-1.0, b)
    return out


def reduced_difference(expansion: Expansion, a: Series, b: Series) -> Series:
    """a − b with common terms cancelled; for two fields that differ by a constant, this is the
    constant."""
    # The cancellation is by structure, so that the result has a degree. A divisor of degree 0 makes
    # a quotient a multiple, without a recurrence. Equal coefficients would also differ by rounding.
    left, right = [*_spread(a)], [*_spread(b)]
    for term in left.copy():
        if term in right:
            left.remove(term)
            right.remove(term)
    pairs = [(sign, *term) for sign, terms in ((1.0, left), (-1.0, right)) for term in terms]
    whole = []
    for sign, own, factors, base in pairs:
        part = base.value
        # The innermost constant is first, as in the original product, so that the rounding is the
        # same.
        for factor in reversed(factors):
            part = _multiple(expansion, factor.value, part)
        whole.append(_multiple(expansion, expansion.constant(sign * own), part))
    if whole:
        return sum_of(expansion, whole)
    # On demand, since coefficients of a field are not known while its series are made.
    return expansion.series(lambda _: jnp.zeros_like(first_of(a)), 0)


def _spread(a: Series, sign: float = 1.0, factors: tuple = ()) -> Iterator[tuple]:
    """The terms of a sum, including nested sums, each as a sign, constants and a value, by
    identity."""
    if a.terms is not None:
        for own, term in a.terms:
            yield from _spread(term, sign * own, factors)
    elif a.multiple is not None:
        factor, base = a.multiple
        yield from _spread(base, sign, (*factors, Same(factor)))
    else:
        yield sign, factors, Same(a)


def convolution(a: Series, b: Series, k: int, first: int = 0) -> Any:
    """Σ a_i b_{k−i} for i from `first` to k."""
    # With `first` = 1 the coefficient b_k is not used. Recurrences that determine b_k need this.
    return add([times(a[i], b[k - i]) for i in range(first, k + 1)])


def product(expansion: Expansion, a: Series, b: Series) -> Series:
    """a b. For multiples of two values it is a multiple of their product, so that c·a times a is
    c·a², computed as a square."""
    # A multiple needs one multiplication for each order, and no stored coefficients.
    if b.degree == 0:
        a, b = b, a
    if a.degree == 0:
        return _multiple(expansion, a, b)
    (factors, u), (more, v) = _taken_apart(a), _taken_apart(b)
    whole = expansion.once(("product", u, v), lambda: _product(expansion, u, v))
    for factor in (*factors, *more):
        whole = _multiple(expansion, factor, whole)
    return whole


def _taken_apart(a: Series) -> tuple[tuple[Series, ...], Series]:
    """The constant factors of a value, and the remaining value."""
    if a.multiple is None:
        return (), a
    factor, base = a.multiple
    factors, base = _taken_apart(base)
    return (factor, *factors), base


def _multiple(expansion: Expansion, factor: Series, a: Series) -> Series:
    """A constant times a value."""
    out = expansion.series(lambda k: times(factor[0], a[k]), a.degree)
    out.multiple = factor, a
    return out


def _product(expansion: Expansion, a: Series, b: Series) -> Series:
    if a is b:
        return square(expansion, a)
    kept(a, b)
    return expansion.series(lambda k: convolution(a, b, k))


def square(expansion: Expansion, a: Series) -> Series:
    """a², with half the products of a convolution."""
    if a.degree == 0:
        return expansion.series(lambda _: a[0] * a[0], 0)
    kept(a)

    def make(k: int) -> Any:
        # a_i a_{k−i} is equal to a_{k−i} a_i. The product in the middle, for an even k, has no
        # partner.
        pairs = add([times(a[i], a[k - i]) for i in range((k + 1) // 2)])
        middle = times(a[k // 2], a[k // 2]) if k % 2 == 0 else None
        return add([scaled(2.0, pairs), middle])

    return expansion.once(("square", a), lambda: expansion.series(make))


def quotient(expansion: Expansion, a: Series, b: Series) -> Series:
    """a/b: b_0 q_k = a_k − Σ_{i ≥ 1} b_i q_{k−i}."""
    # One division serves all orders, and all quotients with this divisor.
    inverse = expansion.once(
        ("inverse", b), lambda: expansion.series(lambda _: 1.0 / jnp.asarray(b[0]), 0)
    )
    is_multiple = b.degree == 0

    def make(k: int) -> Any:
        # A division, so that coefficient 0 has the rounding of the program itself.
        if k == 0:
            return None if a[0] is None else a[0] / b[0]
        rest = None if is_multiple else convolution(b, out, k, first=1)
        return times(minus(a[k], rest), inverse[0])

    out = expansion.series(make, a.degree if is_multiple else None)
    if not is_multiple:
        # The recurrence uses a_k alone of a, so a is not stored.
        kept(b, out)
    return out


def minus(a: Any, b: Any) -> Any:
    """The difference of coefficients."""
    if b is None:
        return a
    return -b if a is None else a - b
