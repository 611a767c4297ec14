"""Known numbers: what is not being traced, and may be asked for its value.

Arguments enter; whether all their numbers are known leaves. Outside of every transformation a verb
is a loop in Python around a few compiled functions that other verbs use too; inside of one it is a
part of the program that is being made.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.core

_F = TypeVar("_F", bound=Callable)


def is_known(tree: Any) -> bool:
    """Whether no number of a tree is traced.

    >>> seen = []
    >>> _ = jax.jit(lambda x: seen.append(is_known(x)) or x)(1.0)
    >>> seen, is_known(1.0)
    ([False], True)
    """
    return not any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(tree))


def compiled_if_traced(function: _F) -> _F:
    """`function`, called as it is where its arguments are known, and compiled as a whole where they
    are not: under `vmap` alone it would be run operation by operation."""
    whole = eqx.filter_jit(function)

    @ft.wraps(function)
    def call(*args: Any) -> Any:
        if not is_known(args):
            return whole(*args)
        # What is known may be called by a derivative: its programs are those of other calls too.
        with jax.core.eval_context():
            return function(*args)

    return call  # pyright: ignore[reportReturnType]
