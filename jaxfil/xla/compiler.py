"""Abilities of XLA's CPU backend in this process, tested before they are relied on.

A call is compiled into a single kernel by attributes of XLA that are not documented.
Versions without them ignore them.
"""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata

WHOLE = {"inlineable": "false", "xla_cpu_small_call": "true"}
"""The attributes of a call that XLA neither inlines nor splits."""
PARTS = dict.fromkeys(WHOLE)
"""The attributes that cancel these for the functions inside a call, which would inherit them."""


@ft.cache
def makes_whole_kernels() -> bool:
    """Whether XLA compiles a call into a single kernel on request.

    Two short loops are compiled and inspected, once.
    """
    if jax.default_backend() != "cpu":
        return False
    try:
        text = jax.jit(_probe).lower(jax.ShapeDtypeStruct((), jnp.float32)).compile().as_text()
    except Exception:
        return False  # a later version may refuse the attributes with any exception
    # Otherwise they would be two loops, or two calls created by XLA itself.
    entry = (text or "").partition("ENTRY")[2]
    return entry.count(" call(") == 1 and " while(" not in entry


def may_be_spread() -> bool:
    """Whether the arrays of a program being traced may be distributed over several devices, as with
    a `NamedSharding`. They are not if there is one device, nor under `jax.shard_map`."""
    if jax.local_device_count() == 1:
        return False
    mesh = jax.sharding.get_abstract_mesh()
    return not (mesh.axis_names and {*mesh.manual_axes} == {*mesh.axis_names})


def _probe(x: Any) -> Any:
    with set_xla_metadata(**WHOLE):
        return jax.jit(_loops)(x)


def _loops(x: Any) -> Any:
    with set_xla_metadata(**PARTS):
        x = jax.lax.while_loop(lambda x: x < 3, lambda x: x + jnp.cos(x), x)
        return jax.lax.while_loop(lambda x: x < 7, lambda x: x + jnp.sin(x), jnp.sqrt(x))
