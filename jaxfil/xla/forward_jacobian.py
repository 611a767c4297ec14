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

from collections.abc import Callable
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero

from jaxfil.xla.program import opened, operations
from jaxfil.xla.pushforward import Lane, Make, Spread, bind, is_real


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
        run = with_derivatives(program, all_or_none(program), plainly)
        return jax.tree.unflatten(tree, run(*values))

    return call


def all_or_none(program: Any) -> Spread:
    """All results of a program are those of a batch if any of its arguments is."""
    return lambda batched: [any(batched)] * len(program.out_avals)


def plainly(program: Any, _: Spread) -> Callable:
    """A program that closes over nothing, as a function."""
    return operations(program)


def with_derivatives(program: Any, spread: Spread, make: Make) -> Callable:
    """A program that closes over nothing as the function that `make` makes of it, with both modes;
    so are its derivatives."""
    whole = jax.custom_jvp(make(program, spread))

    def push(values: tuple, tangents: tuple) -> tuple:
        # What does not move adds nothing to the program: a Jacobian by x0 alone carries no rates of
        # the parameters.
        moving = tuple(k for k, v in enumerate(tangents) if not isinstance(v, SymbolicZero))
        if not moving:
            out = whole(*values)
            return out, list(map(_still, out))
        lane = Lane.of(program, moving, spread, make)
        out, found = bind(lane, values, [tangents[k] for k in moving])
        rates = iter(found)
        return out, [next(rates) if is_real(v) else _still(v) for v in out]

    whole.defjvp(push, symbolic_zeros=True)
    return whole


def _still(value: Any) -> SymbolicZero:
    return SymbolicZero(jax.typeof(value).to_tangent_aval())
