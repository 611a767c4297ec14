"""How the results of a program depend on its arguments, number by number.

Flags of dependence and degrees are propagated through its operations.
"""

import functools as ft
from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfil.xla import elements
from jaxfil.xla.masked_product import ELEMENTWISE
from jaxfil.xla.moves import applies_function
from jaxfil.xla.program import interpreted

_FLOATS = (jnp.float32, jnp.float64)
# Operations of which each result depends only on the numbers at its own position. Results of other
# ones, such as a sort, a conditional or a product of square matrices, depend on all numbers.
_NAMES = """
bessel_i0e bessel_i1e copy_p device_put imag nextafter real reduce_precision shift_left
shift_right_arithmetic shift_right_logical copy stop_gradient
"""
_ON_EACH = elements.ON_EACH.union(ELEMENTWISE, _NAMES.split())

_Flags = np.ndarray | np.bool_
"""A flag for each element of an array."""


def _through(program: Any, args: Sequence[Any], rule: Callable, kind: type) -> list[Any]:
    """Properties of each number, propagated through a program, as arrays of a `kind` that is False
    or 0 for constants. Rearrangements move them, and `rule(eqn, inputs)` handles other
    operations."""

    def known(_: Any, eqn: Any, inputs: Sequence[Any]) -> Sequence[Any]:
        name, shape = eqn.primitive.name, eqn.outvars[0].aval.shape
        if name in elements.MOVES:
            return [elements.moved(name, eqn.params, [*map(np.asarray, inputs)], shape)]
        if name == "custom_jvp_call":
            return _through(eqn.params["call_jaxpr"], inputs, rule, kind)
        return rule(eqn, inputs)

    return interpreted(program, args, lambda v: np.zeros(np.shape(v), kind), known)


def dependencies(program: Any, args: Sequence[Any], sources: Collection[str] = ()) -> list[_Flags]:
    """Elementwise dependency flags through a program; results of the primitives `sources` are
    flagged."""

    def flags(eqn: Any, inputs: Sequence[_Flags]) -> list[_Flags]:
        shapes = [v.aval.shape for v in eqn.outvars]
        if eqn.primitive.name in sources:
            return [np.ones(shape, bool) for shape in shapes]
        if eqn.primitive.name in _ON_EACH and all(x.shape in ((), shapes[0]) for x in inputs):
            flag = np.zeros(shapes[0], bool)
            for x in inputs:
                flag = flag | x
            return [flag]
        some = any(bool(np.any(x)) for x in inputs)
        return [np.full(shape, some) for shape in shapes]

    return _through(program, args, flags, bool)


# Operations that make a zero of zeros, number by number.
_KEEPS_ZERO = {"add", "add_any", "convert_element_type", "copy", "neg", "stop_gradient", "sub"}


def zeros_of(program: Any) -> list[_Flags]:
    """Flags of the numbers in the results of a program that are zero by its operations, whatever
    its arguments are, unless these are infinite."""

    def nonzero(_: Any, eqn: Any, inputs: Sequence[_Flags]) -> list[_Flags]:
        name, shape = eqn.primitive.name, eqn.outvars[0].aval.shape
        if name in elements.MOVES:
            return [elements.moved(name, eqn.params, [*map(np.asarray, inputs)], shape)]
        if name in _KEEPS_ZERO:
            found = ft.reduce(np.logical_or, inputs)
        elif name == "mul":
            found = inputs[0] & inputs[1]
        elif name == "div":
            found = inputs[0]
        elif name == "select_n":
            found = ft.reduce(np.logical_or, inputs[1:])
        else:
            return [np.ones(v.aval.shape, bool) for v in eqn.outvars]
        return [np.broadcast_to(found, shape)]

    every = [np.ones(v.shape, bool) for v in program.in_avals]
    found = interpreted(program, every, lambda v: np.asarray(v) != 0, nonzero)
    return [~np.asarray(v) for v in found]


# A degree above 1.
_CURVED = 2
# Operations that are linear in the operands with these numbers, given all others.
_LINEAR = {
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "gather": (0,),
    "scatter": (0, 2),
    "scatter-add": (0, 2),
    "scatter_add": (0, 2),
    "triangular_solve": (1,),
}


def degrees_of(program: Any, args: Sequence[np.ndarray]) -> list:
    """The degree of each number in the arguments of degree 1, through a program: 0, 1, or `_CURVED`
    for any other dependence."""

    def degrees(eqn: Any, inputs: Sequence[np.ndarray]) -> list:
        return [np.broadcast_to(_degree(eqn, inputs), v.aval.shape) for v in eqn.outvars]

    return _through(program, args, degrees, int)


def _degree(eqn: Any, inputs: Sequence[np.ndarray]) -> Any:
    """The degree of the result of one operation, number by number where this is simple."""
    name, highest = eqn.primitive.name, [int(np.max(d, initial=0)) for d in inputs]
    if name == "convert_element_type" and eqn.outvars[0].aval.dtype not in _FLOATS:
        return _CURVED if any(highest) else 0  # truncated to integers
    if name in ("add", "add_any", "sub", "neg", "convert_element_type", "copy"):
        return ft.reduce(np.maximum, inputs)
    if name == "mul":
        return np.minimum(inputs[0] + inputs[1], _CURVED)
    if name == "div" and highest[1] == 0:
        return inputs[0]
    # A flag that depends on the arguments makes jumps or kinks, so it is not affine.
    if name == "select_n" and highest[0] == 0:
        return ft.reduce(np.maximum, inputs[1:])
    if name == "reduce_sum":
        return np.max(inputs[0], axis=tuple(eqn.params["axes"]), initial=0)
    if name == "dot_general":
        return min(sum(highest), _CURVED)
    # A scatter that applies a function may be as curved as that function.
    numbers = () if applies_function(eqn) else _LINEAR.get(name, ())
    if name == "custom_linear_solve":  # the right-hand side follows the matrix and its factors
        numbers = range(sum(eqn.params["const_lengths"]), len(inputs))
    if numbers and not any(d for k, d in enumerate(highest) if k not in numbers):
        return max(highest[k] for k in numbers)
    return _CURVED if any(highest) else 0
