"""Small arrays as their elements.

Operations on small arrays that consist of scalars, as by `jnp.stack`, are replaced by operations on
each number. XLA would recompute a small array for each element taken from it, and store it in
memory. With this, a field written with arrays compiles like one written with scalars.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax.extend.core as jexc
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

MOST = 32
"""The largest number of elements of such an array."""

MOVES = (
    "broadcast_in_dim",
    "concatenate",
    "pad",
    "reshape",
    "rev",
    "slice",
    "squeeze",
    "stack",
    "transpose",
)
"""Operations that only rearrange elements."""
# Elementwise operations whose parameters are the same for an array and for a number, since
# `evaluate` applies them to the numbers with the parameters of the array.
_NAMES = """
abs acos acosh add add_any and asin asinh atan atan2 atanh ceil convert_element_type cos cosh div eq
erf exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p log2 logistic lt max min mul ne
neg not one_minus_square or pow rem round rsqrt select_n sign sin sinh sqrt square sub tan tanh xor
"""
ON_EACH = frozenset(_NAMES.split())


class Elements:
    """An array as its elements, a NumPy array of scalars."""

    def __init__(self, values: np.ndarray, dtype: Any):
        self.values = values
        self.dtype = dtype

    def array(self) -> Array:
        """The elements as an array."""
        flat = [jnp.asarray(v, self.dtype) for v in self.values.ravel()]
        return jnp.stack(flat).reshape(self.values.shape)


def array_of(value: Any) -> Any:
    """A value as an array, even if it is in elements."""
    return value.array() if isinstance(value, Elements) else value


def in_elements(eqn: Any, inputs: Sequence[Any], mixed: bool) -> bool:
    """Whether an operation is evaluated element by element. With `mixed` this includes operations
    on scalars together with arrays that are not yet in elements."""
    (out, *more), name = eqn.outvars, eqn.primitive.name
    shapes = [v.aval.shape for v in eqn.invars]
    if more or not all(0 < v.aval.size <= MOST for v in (out, *eqn.invars)):
        return False
    if not any(isinstance(v, Elements) for v in inputs):
        # An operation with a scalar operand and an array result starts an array of scalars.
        numbers = [v for v in eqn.invars if not isinstance(v, jexc.Literal)]
        scalars = [v.aval.shape == () for v in numbers]
        if out.aval.shape == () or not (any(scalars) if mixed else scalars and all(scalars)):
            return False
    if name == "dot_general":
        # `np.tensordot` has no batch axes.
        return not any(eqn.params["dimension_numbers"][1])
    if name in ON_EACH:
        # JAX accepts scalars beside arrays, such as the flag of `select_n`.
        return np.broadcast_shapes(*shapes) == out.aval.shape
    return name in MOVES or name == "reduce_sum"


def evaluate(eqn: Any, inputs: Sequence[Any], one: Callable) -> Any:
    """The value of an operation in elements; `one` evaluates it on scalars."""
    parts = [_split(v, x) for v, x in zip(eqn.invars, inputs, strict=True)]
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    if name in MOVES:
        values = moved(name, eqn.params, parts, out.shape)
    elif name == "reduce_sum":
        # NumPy adds and multiplies the entries of an array of objects by their own operators.
        values = np.add.reduce(parts[0], axis=tuple(eqn.params["axes"]))
    elif name == "dot_general":
        values = np.tensordot(*parts, axes=eqn.params["dimension_numbers"][0])
    else:
        wide = (np.broadcast_to(p, out.shape).ravel() for p in parts)
        values = _objects([one(*each) for each in zip(*wide, strict=True)], out.shape)
    if out.shape:
        return Elements(values, out.dtype)
    # NumPy returns the entry itself for a sum over all axes, and an array without axes otherwise.
    return values[()] if isinstance(values, np.ndarray) else values


def _split(atom: Any, value: Any) -> np.ndarray:
    """The elements of an operand."""
    if isinstance(value, Elements):
        return value.values
    value = jnp.asarray(value, atom.aval.dtype)
    return _objects([value[k] for k in np.ndindex(value.shape)], value.shape)


def _objects(scalars: list, shape: tuple[int, ...]) -> np.ndarray:
    """An array of scalars, filled one by one because NumPy would convert a list of JAX scalars."""
    values = np.empty(len(scalars), object)
    for k, scalar in enumerate(scalars):
        values[k] = scalar
    return values.reshape(shape)


def moved(name: str, params: dict, parts: Sequence[np.ndarray], shape: tuple) -> np.ndarray:
    """The result of an operation of `MOVES` on NumPy arrays with elements of any type."""
    first = parts[0]
    if name == "concatenate":
        return np.concatenate(parts, params["dimension"])
    if name == "stack":
        return np.stack(parts, params["axis"])
    if name == "broadcast_in_dim":
        # Other axes of the result are new, and have size 1 before NumPy broadcasts them.
        where = params["broadcast_dimensions"]
        wide = [first.shape[where.index(k)] if k in where else 1 for k in range(len(shape))]
        return np.broadcast_to(first.reshape(wide), shape)
    if name == "pad":
        return _padded(first, parts[1], params["padding_config"], shape)
    if name == "slice":
        steps = params["strides"] or (1,) * first.ndim
        cuts = zip(params["start_indices"], params["limit_indices"], steps, strict=True)
        return first[tuple(slice(*cut) for cut in cuts)]
    if name == "rev":
        return np.flip(first, params["dimensions"])
    if name == "transpose":
        return np.transpose(first, params["permutation"])
    if name == "reshape" and params["dimensions"] is not None:
        first = np.transpose(first, params["dimensions"])
    return first.reshape(shape)  # squeeze is the same


def _padded(array: np.ndarray, fill: np.ndarray, config: Sequence[tuple], shape: tuple) -> Any:
    """The array padded with one number on each side and in between; negative padding crops it."""
    out = np.broadcast_to(fill, shape).astype(array.dtype)
    # The position of each number in the result, shape (axes, *array.shape). Negative padding shifts
    # some of them outside.
    at = np.indices(array.shape)
    for axis, (low, _, between) in enumerate(config):
        at[axis] = low + (1 + between) * at[axis]
    inside = are_inside(at, shape)
    out[tuple(at[:, inside])] = array[inside]
    return out


def are_inside(at: np.ndarray, shape: tuple) -> np.ndarray:
    """Flags of the positions, with coordinates along the first axis, that lie inside an array."""
    ends = np.reshape(shape, (-1, *[1] * (at.ndim - 1)))
    return np.asarray(np.all((at >= 0) & (at < ends), axis=0))
