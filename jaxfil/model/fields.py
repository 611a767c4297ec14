"""The fields of a system: those that replace a property of it, and checks of their values."""

import dataclasses
import types
import typing
from typing import Any

import equinox as eqx
import jax
import numpy as np

_NUMBERS = (float, jax.Array, np.ndarray, "float", "Array", "jax.Array", "np.ndarray")
_NOTHING = (None, types.NoneType, "None")


class Replaceable:
    """A property that a field of a subclass may replace, with a default or without one.

    A field of the name of a Python property has that for its default and cannot be set.
    """

    def __init__(self, own: property):
        self._own, self.__doc__ = own, own.__doc__

    def __get__(self, instance: Any, owner: type) -> Any:
        if instance is None:
            raise AttributeError("A property of an instance.")
        return self._own.__get__(instance, owner)


def is_no_number(value: object) -> bool:
    """Whether a value is a string, a list or None."""
    return value is None or isinstance(value, (str, bytes, list, tuple, dict))


def check_fields(module: eqx.Module) -> None:
    """Raise an error for the first numeric field that holds another kind of value, or for any field
    with a value that cannot be hashed, by which JAX distinguishes programs."""
    for field in dataclasses.fields(module):
        value = getattr(module, field.name, None)
        for leaf in [value] if field.metadata.get("static", False) else jax.tree.leaves(value):
            if not eqx.is_array_like(leaf) and not _is_hashable(leaf):
                raise ValueError(
                    f"`{field.name}` of {type(module).__name__} must hold numbers, arrays, "
                    "equinox.Module or values that can be hashed, as of a frozen dataclass; got "
                    f"{leaf!r}."
                )
        if is_no_number(value):
            kinds = _kinds(field.type)
            allowed = value is None and any(kind in _NOTHING for kind in kinds)
            if not allowed and all(kind in (*_NUMBERS, *_NOTHING) for kind in kinds):
                raise ValueError(
                    f"`{field.name}` of {type(module).__name__} must be a number or an array, got "
                    f"{value!r}."
                )


def _is_hashable(value: object) -> bool:
    try:
        hash(value)
    except TypeError:
        return False
    return True


def _kinds(annotation: Any) -> list[Any]:
    """The types that an annotation allows; for a jaxtyping annotation its array types."""
    if isinstance(annotation, str):
        return [kind.strip() for kind in annotation.split("|")]
    union = isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union
    kinds = typing.get_args(annotation) if union else (annotation,)
    return [getattr(kind, "array_type", kind) for kind in kinds]
