"""Reverse-mode derivatives of loops, by the forward Jacobian.

JAX cannot differentiate a while loop in reverse mode. A program whose loops have forward
derivatives is wrapped in one primitive, `pushforward`, which returns results and their tangents
together:

    (v, v̇)  →  (y, ẏ),   ẏ = J(v) v̇

so that values and tangents share one run. A linearisation, on which reverse mode is based, needs y
before v̇ is known. It computes y and J in one run too, with a direction of forward mode for each
number that varies; ẏ and v̄ = Jᵀ ȳ are products with J. This takes the memory of a forward run, and
the work of one tangent for each number that varies.
"""

from collections.abc import Callable, Sequence
from typing import Any

from jaxfil.xla.program import operations
from jaxfil.xla.pushforward import Make, Single, Spread, bind


def plainly(program: Any, _: Spread) -> Callable:
    """A closed program as a function."""
    return operations(program)


def with_derivatives(program: Any, make: Make) -> Callable:
    """A closed program as the function that `make` builds from it, with forward and reverse mode of
    every order. All results are batched if any argument is."""

    def spread(batched: Sequence[bool]) -> list[bool]:
        return [any(batched)] * len(program.out_avals)

    # Without derivatives there are no tangents, but the primitive is used too. It is traced when it
    # is compiled, and not at all if it is only the start of a derivative.
    still = Single.of(program, (), spread, make)
    return lambda *values: bind(still, values, [])[0]
