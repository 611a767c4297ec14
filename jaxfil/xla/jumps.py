"""Discontinuous operations of a function, for error messages."""

from collections.abc import Callable, Sequence
from typing import Any

import jax

from jaxfil.xla.program import interpreted

# Operations of a program, and the functions by which a user writes them.
_JUMPS = {
    "sign": "sign",
    "floor": "floor",
    "ceil": "ceil",
    "round": "round",
    **dict.fromkeys(("lt", "le", "gt", "ge", "eq", "ne"), "where"),
}


def jumps_of(function: Callable, *args: Any) -> list[str]:
    """The names of operations that jump with the first argument: `sign`, `floor`, `ceil`, `round`,
    and `where` for any comparison, in program order.

    >>> import jax.numpy as jnp
    >>> jumps_of(lambda x, t: jnp.sign(x) + jnp.floor(t) + jnp.maximum(x, 0.0), 1.0, 0.0)
    ['sign']
    """
    program = jax.make_jaxpr(function)(*args)
    first = len(jax.tree.leaves(args[0]))
    depends = [i < first for i in range(len(program.jaxpr.invars))]
    found: dict[str, None] = {}

    def rule(jaxpr: Any, eqn: Any, inputs: Sequence[bool]) -> list[bool]:
        name = _JUMPS.get(eqn.primitive.name)
        if name and any(inputs):
            found[name] = None
        return [any(inputs)] * len(eqn.outvars)

    interpreted(program, depends, lambda _: False, rule)
    return list(found)
