"""Access to parameters by name.

A name is a dotted path to a float leaf of a system, or to an entry of an array, "a[0,1]". Functions
return the leaf or entry, or a copy of the system with another value.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, PyTree

from jaxfil.model.argument import told
from jaxfil.xla.known import array_of

_Tree = TypeVar("_Tree")

# A name, and the indices of an entry after it.
_ENTRY = re.compile(r"(.+)\[(\s*-?\d+\s*(?:,\s*-?\d+\s*)*)\]")


def parameters(system: PyTree) -> dict[str, Any]:
    """Names and values of all float leaves."""
    leaves = jax.tree_util.tree_leaves_with_path(system)
    return {_name(path): leaf for path, leaf in leaves if is_parameter(leaf)}


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def get_parameter(system: PyTree, name: str, argument: str = "parameter") -> Any:
    """The leaf called `name`, or an entry of one. An error names the `argument` by which the user
    gave the name."""
    _, leaf, entry = _found(system, name, argument)
    return leaf if entry is None else jnp.asarray(leaf).reshape(-1)[entry]


def scalar_parameter(system: PyTree, name: str, argument: str = "parameter") -> Any:
    """The scalar parameter called `name`, with errors as in `get_parameter`."""
    leaf = get_parameter(system, name, argument)
    if np.ndim(leaf):
        raise ValueError(
            f"`{argument}` must name a scalar parameter, got {name!r}, which is an array."
        )
    return leaf


def _found(system: PyTree, name: str, argument: str) -> tuple[str, Any, int | None]:
    """The name of the leaf in a name, the leaf, and the index of the entry in C order, or None."""
    known = parameters(system)
    if isinstance(name, str) and name in known:
        return name, known[name], None
    base, index = _split(name) if isinstance(name, str) else ("", ())
    shape = np.shape(known[base]) if base in known else ()
    if len(index) == len(shape) > 0 and all(-n <= i < n for i, n in zip(index, shape, strict=True)):
        return base, known[base], int(np.arange(np.prod(shape)).reshape(shape)[index])
    other = vars(system).get(name) if isinstance(name, str) else None
    hint = "" if other is None else f", which is {told(other)} and no float"
    hint = f", and `{base}` is of shape {shape}" if index and base in known else hint
    raise ValueError(
        f"`{argument}` must be a parameter of {type(system).__name__}, one of "
        f"{', '.join(known) or '(it has none)'}; got {told(name)}{hint}."
    )


def _split(name: str) -> tuple[str, tuple[int, ...]]:
    """The name of the leaf and the indices of the entry; () for a leaf."""
    match = _ENTRY.fullmatch(name)
    if match is None:
        return name, ()
    return match[1], tuple(int(i) for i in match[2].split(","))


def scalar_parameters(system: PyTree, names: Any) -> tuple[str, ...]:
    """The names of different scalar parameters, from an argument `parameters`."""
    several = isinstance(names, (tuple, list)) and all(isinstance(name, str) for name in names)
    if not several or not names or not are_different(system, names, "parameters"):
        raise ValueError(
            f"`parameters` must be the names of different parameters, got {told(names)}."
        )
    return tuple(names)


def are_different(system: PyTree, names: Sequence[str], argument: str = "parameter") -> bool:
    """Whether each name is of another scalar parameter, with errors as in `scalar_parameter`. An
    entry of an array has several names, "a[1]" and "a[-1]"."""
    for name in names:
        scalar_parameter(system, name, argument)
    return len({_found(system, name, argument)[::2] for name in names}) == len(names)


def two_parameters(system: PyTree, names: Any) -> tuple[str, str]:
    """The names of two different scalar parameters."""
    several = scalar_parameters(system, names)
    if len(several) != 2:
        raise ValueError(f"`parameters` must be two different parameters, got {told(names)}.")
    return several[0], several[1]


def replace_parameters(system: _Tree, names: Iterable[str], values: Iterable[ArrayLike]) -> _Tree:
    """`system` with each of these replaced (see `replace_parameter`)."""
    for name, value in zip(names, values, strict=True):
        system = replace_parameter(system, name, value)
    return system


def replace_parameter(system: _Tree, name: str, value: ArrayLike) -> _Tree:
    """`system` with the leaf or entry called `name` replaced, in its shape and dtype."""
    base, _, entry = _found(system, name, "parameter")

    def swap(path: tuple[Any, ...], leaf: Any) -> Any:
        if _name(path) != base:
            return leaf
        # Programs are compiled for certain shapes and dtypes. A value with another dtype
        # would compile another program.
        dtype, shape = jnp.asarray(leaf).dtype, jnp.shape(leaf)
        if entry is None:
            return jnp.broadcast_to(jnp.asarray(value, dtype), shape)
        # Not by `.at`, which is a scatter and not supported in a kernel.
        flat, one = jnp.reshape(leaf, -1), jnp.reshape(jnp.asarray(value, dtype), 1)
        parts = flat[:entry], one, flat[entry + 1 :]
        return jnp.concatenate([v for v in parts if v.size]).reshape(shape)

    return jax.tree_util.tree_map_with_path(swap, system)


def replace_leaves(system: _Tree, values: Mapping[str, Array]) -> _Tree:
    """`system` with each named leaf replaced, of any shape and dtype."""

    def swap(path: tuple[Any, ...], leaf: Any) -> Any:
        return values.get(_name(path), leaf)

    return jax.tree_util.tree_map_with_path(swap, system)


def is_parameter(leaf: object) -> bool:
    """Whether a leaf of a system is a real number or an array of them."""
    # Integers are not parameters, because a count or an index has no derivative.
    return isinstance(leaf, (float, np.floating)) or eqx.is_inexact_array(leaf)


def cast(system: _Tree, dtype: DTypeLike) -> _Tree:
    """`system`, or another pytree, with every float leaf as an array of the given dtype, so that no
    float is static. Complex leaves are refused."""
    for name, leaf in parameters(system).items():
        if jnp.iscomplexobj(leaf):
            raise ValueError(
                f"`{name}` of {type(system).__name__} must be real, got {told(leaf)}; give its "
                "real and its imaginary part as two parameters."
            )
    # A Python float would be a constant of the compiled program, and a new value a new program.
    return jax.tree.map(lambda leaf: array_of(leaf, dtype) if is_parameter(leaf) else leaf, system)
