"""Functions of the motion, and what they ask for by the names of their arguments.

A function of the user's and what is known of a motion at one time enter; what the function returns
of that leaves.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from jaxtyping import Array

from jaxfil.model.argument import signature_of

ASKED = ("side", "reaction", "mode")
"""What a function of the motion may have arguments of these names for."""

Observe: TypeAlias = Callable[..., Any]
"""A function of the time, the state, shape (n,), and what it asks for, that returns an array. It
asks for `side`, `reaction` and `mode` by arguments of these names, each of the shape of H."""


def asked_of(function: Callable[..., Any]) -> tuple[str, ...]:
    """What a function of the motion asks for besides the time and the state, in its order. A third
    argument of any other name, without a default, is that of the sides."""
    signature = signature_of(function)
    if signature is None:
        return ("side",)
    names = []
    for place, argument in enumerate(list(signature.parameters.values())[2:]):
        if argument.kind in (argument.KEYWORD_ONLY, argument.VAR_KEYWORD):
            continue
        if argument.name in ASKED:
            names.append(argument.name)
        elif place == 0 and argument.default is argument.empty:
            names.append("side")
    return tuple(names)


def value_of(function: Observe, t: Array, x: Array, known: Mapping[str, Array]) -> Any:
    """What a function of the motion returns, given all that may be asked for."""
    return function(t, x, *(known[name] for name in asked_of(function)))
