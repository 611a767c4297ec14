"""Validation of arguments of any kind.

Each function converts a value to an array of one dtype, an integer or a flag, or raises a one-line
`ValueError` that names the argument, the requirement and the value received. `check` validates
systems.
"""

import inspect
import os
from collections.abc import Callable, Mapping
from typing import Any, TypeGuard

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from jaxfil.xla.known import array_of

# Steps are counted in 32-bit integers, on every device and in every precision.
MOST_STEPS = 2**31 - 1
# NumPy's own dtypes. It knows neither eps nor the largest number of others.
_PRECISIONS = (np.dtype(np.float64), np.dtype(np.float32), np.dtype(np.float16))
# Limits of an error line: numbers of an array, and characters of any other value.
_NUMBERS, _LETTERS = 8, 160


def told(value: object) -> str:
    """A value in one line; for a large array its shape."""
    if isinstance(value, (np.ndarray, jax.Array)) and (value.ndim > 1 or value.size > _NUMBERS):
        return f"an array of shape {value.shape}"
    text = " ".join(repr(value).split())
    return text if len(text) <= _LETTERS else f"{text[: _LETTERS - 1]}…"


def kind_of(value: object) -> str:
    """A description of the type of a value."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return "None" if value is None else f"an object of type {type(value).__name__}"


def concrete(value: object) -> np.ndarray | None:
    """The value as NumPy numbers, or None while it is being traced."""
    if isinstance(value, jax.core.Tracer):
        return None
    return np.asarray(value)


def is_real(array: Any) -> bool:
    """Whether an array holds real numbers; booleans do not count."""
    return jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)


def real_shape(name: str, returned: Any) -> tuple[int, ...]:
    """The shape of the value returned by the function `name`, which must be a real array."""
    if not hasattr(returned, "shape") or not is_real(returned):
        raise ValueError(f"`{name}` must return an array of real numbers, got {told(returned)}.")
    return tuple(returned.shape)


def array_or_none(value: Any) -> Any:
    """Real numbers as an array, in their own dtype; None for any other value."""
    # True would become the number one, and a string an array of characters.
    if value is None or isinstance(value, (str, bytes, bool)):
        return None
    try:
        array = array_of(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if is_real(array) else None


def state(name: str, x: Any) -> Array:
    """A state of shape (n,), in its own float precision (the default one for integers)."""
    try:
        array = array_of(x)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"`{name}` must be an array of shape (n,), got {told(x)}.") from error
    if array.ndim != 1 or array.shape[0] == 0:
        raise ValueError(
            f"`{name}` must be of shape (n,) with n ≥ 1, got shape {array.shape}. "
            "Batches come from `jax.vmap` or `equinox.filter_vmap`."
        )
    if not is_real(array):
        raise ValueError(f"`{name}` must be of a real dtype, got {array.dtype}.")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))  # float32 or float64, as JAX is configured
    if array.dtype not in _PRECISIONS:
        raise ValueError(
            f"`{name}` must be of dtype {', '.join(v.name for v in _PRECISIONS)}, got "
            f"{array.dtype}."
        )
    return array


def states(name: str, x: Any) -> Array:
    """A state of shape (n,), or an array of them, shape (…, n), in their float precision."""
    array = array_or_none(x)
    if array is None or array.ndim == 0:
        raise ValueError(f"`{name}` must be states, of shape (n,) or (…, n), got {told(x)}.")
    one = state(name, np.zeros(array.shape[-1:], array.dtype))
    return array.astype(one.dtype)


def finite(name: str, x: Array) -> None:
    """Check that a state is finite, unless it is traced."""
    known = concrete(x)
    if known is not None and not np.isfinite(known).all():
        raise ValueError(f"`{name}` must be finite, got {told(known)}.")


def scalar(name: str, value: Any, dtype: DTypeLike, *, positive: bool = False) -> Array:
    """A real number, traced or not; finite unless it is traced."""
    number = number_called(f"`{name}`", value, dtype, positive=positive)
    known = concrete(value)
    if known is not None and not np.isfinite(known):
        raise ValueError(f"`{name}` must be finite, got {known}.")
    return number


def number_called(name: str, value: Any, dtype: DTypeLike, *, positive: bool = False) -> Array:
    """A real number with a descriptive `name` for errors; it may be infinite or NaN."""
    must = "a positive number" if positive else "a number"
    array = array_or_none(value)
    if array is None:
        was = f"dtype {value.dtype}" if isinstance(value, jax.Array) else told(value)
        raise ValueError(f"{name} must be {must}, got {was}.")
    if array.ndim != 0:
        raise ValueError(f"{name} must be {must}, got an array of shape {array.shape}.")
    # Under `jit` the value is unknown; the caller is then responsible for its sign.
    known = concrete(value)
    if positive and known is not None and not known > 0:
        raise ValueError(f"{name} must be {must}, got {known}.")
    return array.astype(dtype) if isinstance(value, jax.Array) else array_of(value, dtype)


def leaf(name: str, value: Any, *, positive: bool = False) -> Any:
    """A future parameter of a system: a number, or an array of numbers in a batch, finite unless
    traced."""
    array = array_or_none(value)
    known = None if array is None else concrete(array)
    sound = known is None or np.all(np.isfinite(known) & (known > 0 if positive else True))
    if array is None or array.size == 0 or not sound:
        must = "positive" if positive else "a number"
        raise ValueError(f"`{name}` must be {must} and finite, got {told(value)}.")
    return parameter(value)


def parameter(value: Any) -> Any:
    """A number, or an array of numbers, as a parameter, which integers are not."""
    if isinstance(value, (int, np.integer)):
        return array_of(float(value))
    array = array_of(value)
    return array.astype(float) if jnp.issubdtype(array.dtype, jnp.integer) else array


def numbers(name: str, value: Any, dtype: DTypeLike, must: str) -> Array:
    """An array of real numbers, traced or not, of any shape; `must` states the requirement."""
    array = array_or_none(value)
    if array is None:
        raise ValueError(f"`{name}` must be {must}, got {told(value)}.")
    return jnp.asarray(array, dtype)


def known_numbers(name: str, value: Any, must: str) -> np.ndarray:
    """NumPy numbers in their own dtype, not traced."""
    if isinstance(value, jax.core.Tracer):
        raise ValueError(f"`{name}` must be {must}, and not be traced, got {told(value)}.")
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be {must}, got {told(value)}.") from error
    if array.dtype.kind not in "fiu":
        was = f"shape {array.shape} of dtype {array.dtype}" if array.ndim else told(value)
        raise ValueError(f"`{name}` must be {must}, got {was}.")
    return array


def count(name: str, value: Any, *, least: int = 1, optional: bool = False) -> Any:
    """A Python integer of at least `least`, or None if `optional`."""
    # 40.0 is refused, because counts are shapes and lengths of loops, as 40.5 cannot be.
    if value is None and optional:
        return None
    if not is_whole(value) or value < least:
        must = f"an integer of at least {least}" + (" or None" if optional else "")
        raise ValueError(f"`{name}` must be {must}, got {told(value)}.")
    if value > MOST_STEPS:
        raise ValueError(f"`{name}` must be an integer below 2³¹, got {value}.")
    return int(value)


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a value is an integer; True, an integer in Python, does not count."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def component(name: str, value: Any, n: int) -> int:
    """The number of one of n components of a state, from 0, or from the end if negative."""
    if not is_whole(value) or not -n <= value < n:
        raise ValueError(f"`{name}` must be an integer from 0 to {n - 1}, got {told(value)}.")
    return int(value)


def number_of_steps(steps: int, *, runs: int = 1, **periods: int) -> None:
    """Check that `steps` steps in each of these periods can be counted. A second run (`runs`), at
    half the step, doubles their number."""
    total = sum(periods.values()) * steps * runs
    if total > MOST_STEPS:
        names = ", ".join(f"`{name}`" for name in periods)
        product = f"({' + '.join(map(str, periods.values()))}) × {steps}"
        twice = " × 2 with `estimate_error`" if runs > 1 else ""
        raise ValueError(
            f"{names} and `steps` must make fewer than 2³¹ steps, got {product}{twice}."
        )


def flags(**values: object) -> None:
    """Check named booleans."""
    for name, value in values.items():
        if not isinstance(value, (bool, np.bool_)):
            raise ValueError(f"`{name}` must be True or False, got {told(value)}.")


def signature_of(function: Callable[..., Any]) -> inspect.Signature | None:
    """The signature of a function; None if it is written in C, as `max`, and has no signature.

    >>> list(signature_of(lambda t, x: x).parameters), signature_of(max)
    (['t', 'x'], None)
    """
    try:
        return inspect.signature(function)
    except (TypeError, ValueError):
        return None


def function(name: str, value: Any, args: str) -> Callable[..., Any]:
    """A function of arguments of these names."""
    if not callable(value) or isinstance(value, type):
        raise ValueError(f"`{name}` must be a callable of {args}, got {told(value)}.")
    return value


def returned(name: str, value: Callable[..., Any], first: str = "", **args: Any) -> Any:
    """The shape and dtype returned by a user's function for such arguments, or a tree of them.
    `name` is its name in errors, `first` precedes its arguments."""
    # Bound before the call, because a TypeError from inside the function is a different mistake.
    if (was := _other_arguments(value, args)) is not None:
        raise ValueError(f"{name} must take ({first}{', '.join(args)}), got {was}.")
    try:
        return eqx.filter_eval_shape(value, *args.values())
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        raise ValueError(
            f"{name} must use jnp functions, since it is compiled, and {', '.join(args)} have no "
            "values before it runs; got "
            f"{type(error).__name__}. Write jnp.where(side > 0, a, b) instead of `if`, jnp.sin "
            "instead of math.sin or np.sin, jnp.stack instead of np.array."
        ) from error


def _other_arguments(value: Callable[..., Any], args: Mapping[str, Any]) -> str | None:
    """The signature of a function that cannot accept this number of arguments."""
    signature = signature_of(value)
    if signature is None:
        return None
    try:
        signature.bind(*args.values())
    except TypeError:
        return str(signature)
    return None


def path(name: str, value: Any) -> str:
    """A path of a file or a folder."""
    if not isinstance(value, (str, os.PathLike)):
        raise ValueError(f"`{name}` must be a path, got {told(value)}.")
    return os.fspath(value)


def one_of(name: str, value: Any, members: tuple[str, ...]) -> str:
    """One of several words."""
    if not isinstance(value, str) or value not in members:
        raise ValueError(f"`{name}` must be one of {', '.join(members)}; got {told(value)}.")
    return value


def instance(name: str, value: object, *kinds: type) -> None:
    """Check that a value is a result of one of these public classes."""
    if not isinstance(value, kinds):
        must = " or ".join(f"a jaxfil.{kind.__name__}" for kind in kinds)
        raise ValueError(f"`{name}` must be {must}, got {kind_of(value)}.")
