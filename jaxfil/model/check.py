"""Validation of all arguments before compilation.

Arguments are converted to arrays of one dtype, or raise a `ValueError` that names the argument, the
requirement and the value received. This module validates systems and the values that their
functions return, and re-exports what `argument` has for general values, so that a public function
imports `check` alone. Modules that this one imports use `argument` itself.
"""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from jaxfil.model.argument import (
    MOST_STEPS as MOST_STEPS,
    array_or_none as array_or_none,
    component as component,
    concrete as concrete,
    count as count,
    finite as finite,
    flags as flags,
    function as function,
    instance as instance,
    is_real as is_real,
    is_whole as is_whole,
    kind_of as kind_of,
    known_numbers as known_numbers,
    leaf as leaf,
    number_called as number_called,
    number_of_steps as number_of_steps,
    numbers as numbers,
    one_of as one_of,
    path as path,
    real_shape as real_shape,
    returned as returned,
    scalar as scalar,
    state as state,
    states as states,
    told as told,
)
from jaxfil.model.clock import Clock, Clocks
from jaxfil.model.parameter import parameters
from jaxfil.model.system import System


def period(of: System, dtype: DTypeLike) -> Array:
    """The period of a forced system, positive unless traced. It is NaN for parameters that are NaN;
    a run then reports it as an outcome."""
    name = f"`period` of {type(of).__name__}"
    number = number_called(name, of.period, dtype)
    known = concrete(number)
    if known is not None and known <= 0:
        raise ValueError(f"{name} must be a positive number, got {known}.")
    return number


def clocks(of: System) -> Clocks:
    """The clocks of a system, with positive periods unless traced."""
    name = f"`clocks` of {type(of).__name__}"
    try:
        several = of.clocks
    except ValueError as error:  # of the class `Clock`, for known numbers
        raise ValueError(f"{name} must be a tuple of jaxfil.Clock: {error}") from error
    if not isinstance(several, (tuple, list)) or not all(isinstance(c, Clock) for c in several):
        raise ValueError(f"{name} must be a tuple of jaxfil.Clock, got {told(several)}.")
    for clock in several:
        for what in ("period", "phase"):
            shape = np.shape(getattr(clock, what))
            if shape != ():
                raise ValueError(f"{name} must have one {what} each, got shape {shape}.")
        known = concrete(clock.period)
        if known is not None and not known > 0:
            raise ValueError(f"{name} must have positive periods, got {known}.")
    return tuple(several)


def system(name: str, value: object) -> None:
    """Check that a value is a `System`."""
    if not isinstance(value, System):
        what = value.__name__ if isinstance(value, type) else type(value).__name__
        hint = "; create an instance of it" if isinstance(value, type) else ""
        raise ValueError(f"`{name}` must be an instance of jaxfil.System, got {what}{hint}.")
    # A bound method is neither a number nor None. Properties are not evaluated, because their
    # values could be programs to compile.
    given = vars(value).get("period", getattr(type(value), "period", None))
    if callable(given):
        raise ValueError(
            f"`period` of {type(value).__name__} must be a number, a property or None, got a "
            "method; write @property above it."
        )
    clocks(value)


def shapes(value: System, x: Array) -> tuple[int, ...]:
    """The shape of H, after a check of the values of all functions for a state like x."""
    # Evaluated on shapes alone, without compilation or arithmetic.
    t = jnp.zeros((), x.dtype)
    h = _shape(value, "switching", "a scalar or an array of shape (m,)", t=t, x=x)
    if len(h) > 1:
        raise ValueError(
            f"`switching` of {type(value).__name__} must return a scalar or an array of shape "
            f"(m,), got shape {h}."
        )
    side = jnp.ones(h, x.dtype)
    given = {"side": side, "reaction": side} if value.feels_reactions else {"side": side}
    _same_as_state(value, "vector_field", t=t, x=x, **given)
    if value.feels_reactions and not value.resets:
        raise ValueError(
            f"`vector_field` of {type(value).__name__} must not take `reaction` without a `reset`, "
            "since motions rest only on surfaces that throw back."
        )
    if value.resets:
        _same_as_state(value, "reset", t=t, x=x, surface=jnp.zeros((), jnp.int32))
    _has_what_calls(value)
    if value.ticks and value.clocks:
        _same_as_state(value, "tick", t=t, x=x, clock=jnp.zeros((), jnp.int32))
    return h


def _has_what_calls(value: System) -> None:
    """A map without contacts or ticks, at which it could be called, is a mistake."""
    name = type(value).__name__
    if _defines(value, "reset") and not _defines(value, "switching"):
        raise ValueError(f"`switching` of {name} must return the surfaces of its `reset`; missing.")
    if _defines(value, "tick") and not _defines(value, "clocks"):
        raise ValueError(
            f"`clocks` of {name} must be a tuple of jaxfil.Clock, at which its `tick` is called; "
            "missing."
        )


def _defines(value: System, name: str) -> bool:
    """Whether the class of a system has its own function or property of a name."""
    of, base = (inspect.getattr_static(v, name) for v in (type(value), System))
    return of is not base


def _same_as_state(value: System, name: str, **args: Array) -> None:
    must = f"an array of the shape of the state, {args['x'].shape}"
    shape = _shape(value, name, must, **args)
    if shape != args["x"].shape:
        raise ValueError(
            f"`{name}` of {type(value).__name__} must return {must}, got shape {shape}."
        )


def _shape(value: System, name: str, must: str, **args: Array) -> tuple[int, ...]:
    """The shape of the real numbers that a function returns, in the precision of the state."""
    called = f"`{name}` of {type(value).__name__}"
    try:
        out = returned(called, getattr(value, name), "self, ", **args)
    except (TypeError, ValueError) as error:
        shaped = {k: np.shape(v) for k, v in parameters(value).items() if np.ndim(v) > 0}
        if not shaped or str(error).startswith(called):
            raise
        names, got = ", ".join(f"`{k}`" for k in shaped), ", ".join(map(str, shaped.values()))
        raise ValueError(
            f"{names} of {type(value).__name__} must be of a shape that `{name}` can take (batches "
            f"come from `equinox.filter_vmap`), got {got}: {error}"
        ) from error
    if not isinstance(out, jax.ShapeDtypeStruct):
        hint = "; write jnp.stack([…])" if isinstance(out, (list, tuple)) else ""
        raise ValueError(f"{called} must return {must}, got no array but {kind_of(out)}{hint}.")
    if not is_real(out):
        raise ValueError(f"{called} must return real numbers, got {out.dtype}.")
    dtype = args["x"].dtype
    if out.dtype != dtype:
        raise ValueError(
            f"{called} must return numbers of the state's dtype, {dtype}, got {out.dtype}; write "
            "1.0 instead of 1, or .astype(x.dtype)."
        )
    return out.shape
