"""Derivatives of what JAX cannot run backward: reverse mode by the forward Jacobian.

A program whose loops have forward derivatives only enters; a function leaves that computes it and
has both modes. Its derivative is one primitive, `pushforward`, which gives results and their
tangents at once:

    (v, v̇)  →  (y, ẏ),   ẏ = J(v) v̇

so that values and tangents share one run. A linearisation, of which reverse mode makes its
gradient, needs y before it knows v̇: it has y and J in one run too, a direction of forward mode for
each number that moves, and ẏ and v̄ = Jᵀ ȳ are products with J. That takes the memory of a forward
run, and the work of as many tangents as numbers move.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax

from jaxfil.xla.program import opened, operations
from jaxfil.xla.pushforward import Lane, Make, Spread, bind


def by_forward_jacobian(function: Callable) -> Callable:
    """`function` of arrays, with a reverse mode.

    >>> import jax
    >>> def power(x):
    ...     step = lambda s: (s[0] + 1, s[1] * x)
    ...     return jax.lax.while_loop(lambda s: s[0] < 3, step, (0, 1.0))[1]
    >>> print(jax.grad(by_forward_jacobian(power))(2.0))
    12.0
    """

    def call(*args: Any) -> Any:
        program, values, tree = opened(function, args)
        return jax.tree.unflatten(tree, with_derivatives(program, plainly)(*values))

    return call


def plainly(program: Any, _: Spread) -> Callable:
    """A program that closes over nothing, as a function."""
    return operations(program)


def with_derivatives(program: Any, make: Make) -> Callable:
    """A program that closes over nothing as the function that `make` makes of it, with both modes;
    so are its derivatives. All of its results are those of a batch if any of its arguments is."""

    def spread(batched: Sequence[bool]) -> list[bool]:
        return [any(batched)] * len(program.out_avals)

    # Where nothing moves yet there are no tangents. This too is the primitive: it is traced when it
    # is compiled, and not at all if it is only the beginning of a derivative.
    still = Lane.of(program, (), spread, make)
    return lambda *values: bind(still, values, [])[0]
