"""Validation of the numeric fields of a system."""

import dataclasses
import types
import typing
from typing import Any

import equinox as eqx
import jax
import numpy as np

_NUMBERS = (float, jax.Array, np.ndarray, "float", "Array", "jax.Array", "np.ndarray")
_NOTHING = (None, types.NoneType, "None")


def is_no_number(value: object) -> bool:
    """Whether a value is a string, a list or None."""
    return value is None or isinstance(value, (str, bytes, list, tuple, dict))


def check_numbers(module: eqx.Module) -> None:
    """Raise an error for the first numeric field that holds another kind of value."""
    for field in dataclasses.fields(module):
        value = getattr(module, field.name, None)
        if is_no_number(value):
            kinds = _kinds(field.type)
            allowed = value is None and any(kind in _NOTHING for kind in kinds)
            if not allowed and all(kind in (*_NUMBERS, *_NOTHING) for kind in kinds):
                raise ValueError(
                    f"`{field.name}` of {type(module).__name__} must be a number or an array, got "
                    f"{value!r}."
                )


def _kinds(annotation: Any) -> list[Any]:
    """The types that an annotation allows; for a jaxtyping annotation its array types."""
    if isinstance(annotation, str):
        return [kind.strip() for kind in annotation.split("|")]
    union = isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union
    kinds = typing.get_args(annotation) if union else (annotation,)
    return [getattr(kind, "array_type", kind) for kind in kinds]
