"""Functions of the motion and the arguments that they request by name."""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from jaxtyping import Array

from jaxfil.model.argument import signature_of

ASKED = ("side", "reaction", "mode")
"""Names of the optional arguments of a function of the motion."""

Observe: TypeAlias = Callable[..., Any]
"""A function of the time, the state, shape (n,), and optional arguments, that returns an array. The
optional arguments are `side`, `reaction` and `mode`, each of the shape of H."""


def asked_of(function: Callable[..., Any]) -> tuple[str, ...]:
    """The optional arguments of a function of the motion, in its order. A third argument of any
    other name, without a default, receives the sides."""
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
    """The value of a function of the motion, given all optional arguments."""
    return function(t, x, *(known[name] for name in asked_of(function)))
