"""What XLA's CPU backend can do in this process, asked before it is relied on.

Nothing enters; whether a call can be compiled into a single kernel leaves. The attributes that ask
for one are XLA's own and not documented: a version that does not know them ignores them, and some
that know them end the process on what others compile.
"""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jaxlib import version as jaxlib_version

WHOLE = {"inlineable": "false", "xla_cpu_small_call": "true"}
"""The attributes of a call that XLA neither inlines nor splits."""
PARTS = dict.fromkeys(WHOLE)
"""What takes these back, for they are those of the call, not of what it calls."""

# Earlier ones split loops over 64 lanes among threads inside of a kernel too, by a function that
# kernels are not linked with, and end the process.
_OLDEST = (0, 7, 2)


@ft.cache
def makes_whole_kernels() -> bool:
    """Whether XLA compiles a call into a single kernel where it is asked to.

    Of a version that is known to end the process at some programs it is asked nothing. Of any other
    one it is: two short loops are compiled and looked at, once.
    """
    if jax.default_backend() != "cpu" or _version(jaxlib_version.__version__) < _OLDEST:
        return False
    try:
        text = jax.jit(_probe).lower(jax.ShapeDtypeStruct((), jnp.float32)).compile().as_text()
    except Exception:
        return False  # whatever it was that a later version refuses
    # In parts they would be two loops, or two calls that XLA has made of them itself.
    entry = (text or "").partition("ENTRY")[2]
    return entry.count(" call(") == 1 and " while(" not in entry


def may_be_spread() -> bool:
    """Whether the arrays of a program that is being traced may be spread over several devices, as
    those of a `NamedSharding` are: not where there is one, nor under `jax.shard_map`."""
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


def _version(text: str) -> tuple[int, ...]:
    """The numbers of a version, without what stands behind the third."""
    digits = [part for part in text.split(".")[:3] if part.isdigit()]
    return tuple(map(int, digits))
