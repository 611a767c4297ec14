"""Programs of functions, and functions of programs.

A function of arrays enters; its program leaves, which closes over nothing. The same program enters
again; a function leaves that runs it, operation by operation or as a single call.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jexc
import jax.numpy as jnp


def opened(function: Callable, args: tuple) -> tuple[Any, list, Any]:
    """The program of a function, which takes what the function has closed over as arguments; the
    values that it takes, and the structure of what its results stand for."""
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    # A constant inside of a kernel would be written out in its code, and a tracer that the function
    # has closed over would be taken for one lane's number in a batch: both become arguments.
    inner = closed.jaxpr
    program = jexc.ClosedJaxpr(
        inner.replace(constvars=(), invars=[*inner.constvars, *inner.invars]), ()
    )
    values = [*map(jnp.asarray, (*closed.consts, *jax.tree.leaves(args)))]
    return program, values, jax.tree.structure(shapes)


def operations(program: Any) -> Callable:
    """A program that closes over nothing as a function, which applies its operations."""
    run = jexc.jaxpr_as_fun(program)

    # Not `run` itself: JAX looks for the name of a function that it transforms, and what has none
    # is written out for it, the whole program.
    def apply_operations(*values: Any) -> list:
        return run(*values)

    return apply_operations


def call_of(program: Any) -> Callable:
    """The same as one operation, that of a function under `jax.jit`, which is not traced again."""

    def same_numbers(*_: Any) -> list:
        return [jnp.zeros(())] * len(program.out_avals)

    # The call of a function with as many arguments and results says all that a call says of itself
    # in this version of JAX. Only what it calls is replaced.
    with jax.disable_jit(False):
        shown = jax.make_jaxpr(jax.jit(same_numbers))(*program.in_avals)
    (call,) = shown.eqns
    params = {**call.params, "name": "program", "jaxpr": program}
    return lambda *values: call.primitive.bind(*values, **params)
