"""A selection between two numbers, as one operation of a program.

`jnp.where` is a call of a function of its own, with conversions of the numbers in it. It takes
three times as long to trace and five times as long to lower, and a program of the loop has hundreds
of selections.
"""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

# Python's number types, and the kinds of array types that cannot hold them.
_OTHER = {bool: "", int: "b", float: "biu"}


def select(flag: Any, yes: Any, no: Any) -> Array:
    """`jnp.where(flag, yes, no)`, for a flag and values that are Python numbers or arrays.

    >>> x = jnp.float32(2.0)
    >>> float(select(x > 1, x, 0)), float(select(x > 3, x, 0))
    (2.0, 0.0)
    """
    like = no if _is_plain(yes) else yes
    if not _is_plain(like):
        yes, no = (_typed(v, like) for v in (yes, no))
        if np.shape(flag) in ((), like.shape) and _same_type(yes, no):
            return jax.lax.select_n(flag, no, yes)
    return jnp.where(flag, yes, no)


def select_all(flag: Any, yes: Any, no: Any) -> Any:
    """`select` between two records, array by array.

    >>> select_all(jnp.asarray(True), {"a": jnp.float32(1.0)}, {"a": jnp.float32(2.0)})
    {'a': Array(1., dtype=float32)}
    """
    return jax.tree.map(ft.partial(select, flag), yes, no)


def _is_plain(v: Any) -> bool:
    return type(v) in _OTHER  # exact types, since a NumPy float, which has a dtype, is a float too


def _same_type(a: Any, b: Any) -> bool:
    return not _is_plain(a) and not _is_plain(b) and (a.shape, a.dtype) == (b.shape, b.dtype)


def _typed(v: Any, like: Any) -> Any:
    """A Python number converted to the type of `like`, if that can hold it."""
    if not _is_plain(v) or like.dtype.kind in _OTHER[type(v)]:
        return v
    number = np.asarray(v, like.dtype)
    return number if like.ndim == 0 else jnp.broadcast_to(number, like.shape)
