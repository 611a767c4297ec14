"""A parameter by its name.

A system and the name of a float leaf (a dotted path for nested modules) enter; the leaf, or the
system with another value in its place, leaves.
"""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import PyTree

from jaxfil.model.system import System

_Tree = TypeVar("_Tree")


def parameters(system: PyTree) -> dict[str, Any]:
    """Names and values of all float leaves."""
    leaves = jax.tree_util.tree_leaves_with_path(system)
    return {_name(path): leaf for path, leaf in leaves if is_parameter(leaf)}


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def get_parameter(system: PyTree, name: str) -> Any:
    """The leaf called `name`."""
    known = parameters(system)
    if name not in known:
        fields = vars(system) if isinstance(name, str) else {}
        hint = f", which is {fields[name]!r} and no float" if name in fields else ""
        raise ValueError(
            f"`parameter` must be a parameter of {type(system).__name__}, one of "
            f"{', '.join(known) or '(it has none)'}; got {name!r}{hint}."
        )
    return known[name]


def replace_parameter(system: _Tree, name: str, value: ArrayLike) -> _Tree:
    """`system` with the leaf called `name` replaced, shape and dtype kept."""
    get_parameter(system, name)

    def swap(path: tuple[Any, ...], leaf: Any) -> Any:
        if _name(path) != name:
            return leaf
        # A program is compiled for the shapes and dtypes of its leaves: a value that kept its own
        # would compile another one.
        return jnp.broadcast_to(jnp.asarray(value, jnp.asarray(leaf).dtype), jnp.shape(leaf))

    return jax.tree_util.tree_map_with_path(swap, system)


def is_parameter(leaf: object) -> bool:
    """Whether a leaf of a system is a real number or an array of them."""
    # Integers are no parameters: a count or an index has no derivative.
    return isinstance(leaf, (float, np.floating)) or eqx.is_inexact_array(leaf)


def cast(system: System, dtype: DTypeLike) -> System:
    """`system` with every float leaf an array of the given dtype, so that none is static."""
    # A Python float would be a constant of the compiled program, and a new value another program.
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, dtype) if is_parameter(leaf) else leaf, system
    )
