"""What a system holds besides its parameters: whole numbers, flags, words, functions.

A file has these values as text, by which the system is recognised that its numbers belong to.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfil.model.parameter import is_parameter
from jaxfil.model.system import System

# Larger arrays are replaced by a hash, since the attributes of a file are limited.
_NUMBERS = 16


def other_fields(system: System, lanes: Sequence[int] = ()) -> dict[str, str]:
    """The values of all fields and leaves that are no parameters, in JSON, by name; of a function
    its name. Arrays of a batch of `lanes` are of one lane if all lanes have the same.

    >>> import jaxfil as jf
    >>> other_fields(jf.piecewise(jax.nn.relu, jax.nn.relu, max, 2.0))
    {'f_plus': '"relu"', 'f_minus': '"relu"', 'surface': '"max"'}
    """
    return {name: _text(_of_one_lane(v, tuple(lanes))) for name, v in _others(system, "")}


def _others(node: Any, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(node, eqx.Module):
        for field in dataclasses.fields(node):
            path, value = _joined(name, field.name), getattr(node, field.name, None)
            if field.metadata.get("static", False):
                yield path, value
            else:
                yield from _others(value, path)
        return
    inner = jax.tree_util.tree_leaves_with_path(node, is_leaf=lambda v: isinstance(v, eqx.Module))
    for steps, leaf in inner:
        path = _joined(name, jax.tree_util.keystr(steps, simple=True, separator="."))
        if isinstance(leaf, eqx.Module):
            yield from _others(leaf, path)
        elif not is_parameter(leaf):
            yield path, leaf


def _joined(*names: str) -> str:
    return ".".join(name for name in names if name)


def _of_one_lane(value: Any, lanes: tuple[int, ...]) -> Any:
    if not lanes or not eqx.is_array_like(value) or np.shape(value)[: len(lanes)] != lanes:
        return value
    first = np.asarray(value)[(0,) * len(lanes)]
    return first if np.all(np.asarray(value) == first) else value


def _text(value: Any) -> str:
    return json.dumps(value, default=_plain, skipkeys=True, sort_keys=True)


def _plain(value: Any) -> Any:
    """A value that JSON does not know, in a form that it knows, the same in every process."""
    if isinstance(value, np.generic):
        return value.item()
    if eqx.is_array(value) or isinstance(value, np.ndarray):
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            value = jax.random.key_data(value)
        array = np.asarray(value)
        if array.size <= _NUMBERS:
            return array.tolist()
        digest = hashlib.sha256(f"{array.tolist()}".encode()).hexdigest()
        return f"array of shape {array.shape}, {digest[:16]}"
    if callable(value):
        return getattr(value, "__name__", type(value).__name__)
    text = repr(value)
    return type(value).__name__ if " at 0x" in text else text
