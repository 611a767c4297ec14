"""The door: bad arguments are named before anything is compiled.

Arguments as the user gave them enter; arrays of one dtype leave, or a `ValueError` that names the
argument, what it must be and what it was.
"""

import inspect
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from jaxfil.model.clock import Clock, Clocks
from jaxfil.model.parameter import parameters
from jaxfil.model.system import System
from jaxfil.xla.known import array_of

# Steps are counted in 32 bits, on every device and in every precision.
MOST_STEPS = 2**31 - 1
# Those of NumPy: of others neither eps nor the largest number is known to it.
_PRECISIONS = (np.dtype(np.float64), np.dtype(np.float32), np.dtype(np.float16))


def concrete(value: object) -> np.ndarray | None:
    """The value as NumPy numbers, or None while it is being traced."""
    if isinstance(value, jax.core.Tracer):
        return None
    return np.asarray(value)


def state(name: str, x: Any) -> Array:
    """A state of shape (n,), in its own float precision (the default one for integers)."""
    try:
        array = array_of(x)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be an array of shape (n,), got {x!r}.") from error
    if array.ndim != 1 or array.shape[0] == 0:
        raise ValueError(
            f"`{name}` must be of shape (n,) with n ≥ 1, got shape {array.shape}. "
            "Batches come from `jax.vmap` or `equinox.filter_vmap`."
        )
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise ValueError(f"`{name}` must be of a real dtype, got {array.dtype}.")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))  # float32 or float64, as JAX is set
    if array.dtype not in _PRECISIONS:
        raise ValueError(
            f"`{name}` must be of dtype {', '.join(v.name for v in _PRECISIONS)}, got "
            f"{array.dtype}."
        )
    return array


def finite(name: str, x: Array) -> None:
    """A state of finite numbers, as far as they are known."""
    known = concrete(x)
    if known is not None and not np.isfinite(known).all():
        raise ValueError(f"`{name}` must be finite, got {known}.")


def scalar(name: str, value: Any, dtype: DTypeLike, *, positive: bool = False) -> Array:
    """A real number, traced or not."""
    return _number(f"`{name}`", value, dtype, positive)


def period(of: System, dtype: DTypeLike) -> Array:
    """The period of a forced system, a positive number as far as it is known. NaN is that of
    parameters that are NaN, and a run tells it by its outcome."""
    told = f"`period` of {type(of).__name__}"
    number = _number(told, of.period, dtype, False)
    known = concrete(number)
    if known is not None and known <= 0:
        raise ValueError(f"{told} must be a positive number, got {known}.")
    return number


def clocks(of: System) -> Clocks:
    """The clocks of a system, with positive periods as far as they are known."""
    told = f"`clocks` of {type(of).__name__}"
    for clock in (several := tuple(of.clocks)):
        if not isinstance(clock, Clock):
            raise ValueError(f"{told} must be a tuple of jaxfil.Clock, got {several!r}.")
        known = concrete(clock.period)
        if known is not None and not known > 0:
            raise ValueError(f"{told} must have positive periods, got {known}.")
    return several


def _number(told: str, value: Any, dtype: DTypeLike, positive: bool) -> Array:
    must = "a positive number" if positive else "a number"
    # A string would become an array of characters, and True the number one.
    if isinstance(value, (str, bytes, bool)) or value is None:
        raise ValueError(f"{told} must be {must}, got {value!r}.")
    try:
        array = array_of(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{told} must be {must}, got {value!r}.") from error
    if array.ndim != 0:
        raise ValueError(f"{told} must be {must}, got an array of shape {array.shape}.")
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise ValueError(f"{told} must be {must}, got dtype {array.dtype}.")
    # Under `jit` the value is not known yet: its sign is then the caller's affair.
    known = concrete(value)
    if positive and known is not None and not known > 0:
        raise ValueError(f"{told} must be {must}, got {known}.")
    return array.astype(dtype) if isinstance(value, jax.Array) else array_of(value, dtype)


def count(name: str, value: Any, *, least: int = 1, optional: bool = False) -> Any:
    """A Python integer of at least `least`, or None where that is allowed."""
    # 40.0 is refused: counts are shapes and lengths of loops, and 40.5 would have to be as well.
    if value is None and optional:
        return None
    whole = isinstance(value, (int, np.integer))  # as True is, to Python
    if not whole or isinstance(value, bool) or value < least:
        must = f"an integer of at least {least}" + (" or None" if optional else "")
        raise ValueError(f"`{name}` must be {must}, got {value!r}.")
    if value > MOST_STEPS:
        raise ValueError(f"`{name}` must be an integer below 2³¹, got {value}.")
    return int(value)


def component(name: str, value: Any, n: int) -> int:
    """The number of one of n components of a state, from 0, or from the end if it is negative."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or not -n <= value < n:
        raise ValueError(f"`{name}` must be an integer from 0 to {n - 1}, got {value!r}.")
    return int(value)


def number_of_steps(steps: int, *, runs: int = 1, **periods: int) -> None:
    """An error where `steps` steps in each of these periods are more than can be counted. `runs`: a
    second one, at half the step, has twice as many."""
    total = sum(periods.values()) * steps * runs
    if total > MOST_STEPS:
        names = ", ".join(f"`{name}`" for name in periods)
        product = f"({' + '.join(map(str, periods.values()))}) × {steps}"
        twice = " × 2 with `estimate_error`" if runs > 1 else ""
        raise ValueError(
            f"{names} and `steps` must make fewer than 2³¹ steps, got {product}{twice}."
        )


def system(name: str, value: object) -> None:
    """A `System`."""
    if not isinstance(value, System):
        what = value.__name__ if isinstance(value, type) else type(value).__name__
        hint = "; create an instance of it" if isinstance(value, type) else ""
        raise ValueError(f"`{name}` must be an instance of jaxfil.System, got {what}{hint}.")
    # A bound method is no number, and no None either. Properties are not asked for their value,
    # which could be a program to compile.
    given = vars(value).get("period", getattr(type(value), "period", None))
    if callable(given):
        raise ValueError(
            f"`period` of {type(value).__name__} must be a number, a property or None, got a "
            "method: write @property above it."
        )


def instance(name: str, value: object, *kinds: type) -> None:
    """A result of one of these public kinds."""
    if not isinstance(value, kinds):
        must = " or ".join(f"a jaxfil.{kind.__name__}" for kind in kinds)
        raise ValueError(f"`{name}` must be {must}, got {_kind(value)}.")


def shapes(value: System, x: Array) -> tuple[int, ...]:
    """The shape of H, after a look at what all functions of a system return for a state like x."""
    # Evaluated on shapes alone, which costs no compilation and no arithmetic.
    t = jnp.zeros((), x.dtype)
    h = _shape(value, "switching", "a scalar or an array of shape (m,)", t=t, x=x)
    if len(h) > 1:
        raise ValueError(
            f"`switching` of {type(value).__name__} must return a scalar or an array of shape "
            f"(m,), got shape {h}."
        )
    _same_as_state(value, "vector_field", t=t, x=x, side=jnp.ones(h, x.dtype))
    if value.resets:
        _same_as_state(value, "reset", t=t, x=x, surface=jnp.zeros((), jnp.int32))
    if value.ticks and value.clocks:
        _same_as_state(value, "tick", t=t, x=x, clock=jnp.zeros((), jnp.int32))
    return h


def _same_as_state(value: System, name: str, **args: Array) -> None:
    must = f"an array of the shape of the state, {args['x'].shape}"
    shape = _shape(value, name, must, **args)
    if shape != args["x"].shape:
        raise ValueError(
            f"`{name}` of {type(value).__name__} must return {must}, got shape {shape}."
        )


def _shape(value: System, name: str, must: str, **args: Array) -> tuple[int, ...]:
    """The shape of the real numbers that one of the user's functions returns."""
    function, told = getattr(value, name), f"`{name}` of {type(value).__name__}"
    # Bound before it is called: a TypeError from inside of the function is another mistake.
    try:
        inspect.signature(function).bind(*args.values())
    except TypeError as error:
        was = inspect.signature(function)
        raise ValueError(f"{told} must take (self, {', '.join(args)}), got {was}.") from error
    try:
        out = eqx.filter_eval_shape(function, *args.values())
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        raise ValueError(
            f"{told} must be made of jnp functions, for it is compiled, and {', '.join(args)} have "
            "no values until it runs: jnp.where(side > 0, a, b) instead of `if`, jnp.sin instead "
            "of math.sin or np.sin, jnp.stack instead of np.array; got "
            f"{type(error).__name__}."
        ) from error
    except (TypeError, ValueError) as error:
        shaped = {k: np.shape(v) for k, v in parameters(value).items() if np.ndim(v) > 0}
        if not shaped:
            raise
        names, got = ", ".join(f"`{k}`" for k in shaped), ", ".join(map(str, shaped.values()))
        raise ValueError(
            f"{names} of {type(value).__name__} must be of a shape that `{name}` can take (batches "
            f"come from `equinox.filter_vmap`), got {got}: {error}"
        ) from error
    if not isinstance(out, jax.ShapeDtypeStruct):
        hint = ": write jnp.stack([…])" if isinstance(out, (list, tuple)) else ""
        raise ValueError(f"{told} must return {must}, got no array but {_kind(out)}{hint}.")
    if not jnp.issubdtype(out.dtype, jnp.number) or jnp.issubdtype(out.dtype, jnp.complexfloating):
        raise ValueError(f"{told} must return real numbers, got {out.dtype}.")
    return out.shape


def _kind(value: object) -> str:
    return "None" if value is None else f"an object of type {type(value).__name__}"
