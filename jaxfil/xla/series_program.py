"""Power series through a program, operation by operation.

Small arrays are taken apart into their numbers, as in `elements`.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfil.xla import elements
from jaxfil.xla.known import is_known
from jaxfil.xla.matrix_product import matrices_of
from jaxfil.xla.moves import by_slices
from jaxfil.xla.program import closed, evaluate_one, interpreted
from jaxfil.xla.series import (
    Expansion,
    Same,
    Series,
    degree_of,
    linear_function,
    product,
    sum_of,
)
from jaxfil.xla.series_jumps import decided_by, just_after, list_places
from jaxfil.xla.series_rules import (
    COMPARISONS,
    FROZEN,
    LINEAR,
    RULES,
    NoSeries,
    is_real,
    jumps,
    selected,
)

# Operations with a program whose value is theirs, by the names of their parameters. The rule of a
# `custom_jvp` and the storage of `jax.checkpoint` concern derivatives by JAX.
_WRAPPED = {"checkpoint": "jaxpr", "custom_jvp_call": "call_jaxpr", "remat2": "jaxpr"}

# The largest number of passes of a loop that is written out, enough to search 2³² places.
_PASSES = 32


def expanded(expansion: Expansion, program: Any, args: Sequence[Any]) -> list[Any]:
    """The series of a program's results, each a `Series`, or for a small array a NumPy array of
    them. `args` are such series, or values, which are constant."""
    given = [v if _is_series(v) else expansion.constant(v) for v in args]
    rule = ft.partial(_made, expansion)
    return interpreted(program, given, expansion.constant, rule)


def scalars_of(expansion: Expansion, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The numbers of an array as series, in a NumPy array of its shape."""
    if not isinstance(value, Series):
        return value
    return _each(shape, lambda k: _number(expansion, value, k) if shape else value)


def array_of(expansion: Expansion, value: Any) -> Series:
    """An array as one series."""
    if isinstance(value, Series):
        return value
    if not value.shape:
        return value[()]
    flat, shape = list(value.ravel()), value.shape

    def joined(k: int) -> Any:
        parts = [v[k] for v in flat]
        if all(v is None for v in parts):
            return None
        zero = jnp.zeros_like(next(v for v in parts if v is not None))
        return jnp.stack([zero if v is None else v for v in parts]).reshape(shape)

    return expansion.series(joined, degree_of(*flat))


def _number(expansion: Expansion, value: Series, k: tuple[int, ...]) -> Series:
    # One series for each number, since squares and common terms are recognised by identity.
    key = ("number", value, k)
    if _is_known(value) and is_known(value[0]):
        # The numbers of a known array are known too, such as its exponents.
        return expansion.once(key, lambda: expansion.constant(np.asarray(value[0])[k]))
    return expansion.once(key, lambda: linear_function(expansion, lambda v: v[k], value))


def _is_series(value: Any) -> bool:
    return isinstance(value, Series) or (isinstance(value, np.ndarray) and value.dtype == object)


def _made(expansion: Expansion, jaxpr: Any, eqn: Any, inputs: Sequence[Any]) -> list[Any]:
    """The results of one operation, shared with earlier evaluations on the same operands."""
    # Arrays of NumPy are not hashable, so the numbers in them are the key. The fields on both sides
    # of a surface share all operations that do not depend on the side.
    same = [v if isinstance(v, Series) else tuple(map(Same, v.ravel())) for v in inputs]
    key = ("operation", Same(eqn), _decision(expansion, eqn), *same)
    return expansion.once(key, lambda: _new(expansion, jaxpr, eqn, inputs))


def _new(expansion: Expansion, jaxpr: Any, eqn: Any, inputs: Sequence[Any]) -> list[Any]:
    name = eqn.primitive.name
    if name in _WRAPPED:
        rule = ft.partial(_made, expansion)
        program = _opened(expansion, eqn.params[_WRAPPED[name]])
        return interpreted(program, inputs, expansion.constant, rule)
    if all(_is_known(v) for v in inputs):
        # Evaluated by JAX at once, so that operations on constants need no rule, and their results
        # are known in the same way.
        values = [array_of(expansion, v)[0] for v in inputs]
        return [expansion.constant(v) for v in evaluate_one(jaxpr, eqn, values)]
    if name == "cond":
        return _of_cond(expansion, eqn, inputs)
    if name == "scan" and _counts(eqn):
        return _written_out(expansion, eqn, inputs)
    (out, *more) = (v.aval for v in eqn.outvars)
    if more:
        raise NoSeries(name)
    sizes = [v.aval.size for v in eqn.invars]
    if out.shape == () and not any(v.aval.shape for v in eqn.invars):
        return [_of_one(expansion, eqn, [array_of(expansion, v) for v in inputs])]
    if all(0 < size <= elements.MOST for size in (out.size, *sizes)):
        found = _in_elements(expansion, eqn, inputs)
        if found is not None:
            return [found]
    return [_of_one(expansion, eqn, [array_of(expansion, v) for v in inputs])]


def _opened(expansion: Expansion, program: Any) -> Any:
    """A program inside an operation, with its numbers moved by slices."""
    # Made once, since operations are shared by identity.
    return expansion.once(("opened", Same(program)), lambda: by_slices(closed(program)))


def _is_known(value: Any) -> bool:
    """Whether a value is a constant that has been computed."""
    if isinstance(value, Series):
        return value.degree == 0 and 0 in value.known
    return all(map(_is_known, value.ravel()))


def _in_elements(expansion: Expansion, eqn: Any, inputs: Sequence[Any]) -> Any:
    """An operation on small arrays, number by number; None if this is not supported."""
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    shapes = [v.aval.shape for v in eqn.invars]
    parts = [scalars_of(expansion, v, shape) for v, shape in zip(inputs, shapes, strict=True)]
    if name in elements.MOVES:
        return np.asarray(elements.moved(name, eqn.params, parts, out.shape))
    if name in ("reduce_sum", "reduce_prod"):
        join = _sum if name == "reduce_sum" else _joint_product
        return _reduced(ft.partial(join, expansion), parts[0], eqn.params["axes"], out.shape)
    if name == "dot_general":
        return _dotted(expansion, eqn, *parts)
    if name in elements.ON_EACH and np.broadcast_shapes(*shapes) == out.shape:
        wide: list[Any] = [np.broadcast_to(p, out.shape) for p in parts]
        return _each(out.shape, lambda k: _of_one(expansion, eqn, [p[k] for p in wide]))
    return None


def _sum(expansion: Expansion, terms: Sequence[Series]) -> Series:
    return sum_of(expansion, terms)


def _joint_product(expansion: Expansion, factors: Sequence[Series]) -> Series:
    return ft.reduce(ft.partial(product, expansion), factors)


def _reduced(join: Callable, array: np.ndarray, axes: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The numbers of an array joined along some axes."""
    others = [k for k in range(array.ndim) if k not in axes]
    rows = np.transpose(array, (*others, *axes)).reshape(*shape, -1)
    return _each(shape, lambda k: join(list(rows[k])))


def _dotted(expansion: Expansion, eqn: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """A product of matrices or other contraction; None with batch axes."""
    if any(eqn.params["dimension_numbers"][1]):
        return None
    (rows,), (columns,) = matrices_of(eqn, a, b)

    def entry(k: tuple[int, ...]) -> Series:
        terms = zip(rows[k[0]], columns[k[1]], strict=True)
        return sum_of(expansion, [product(expansion, u, v) for u, v in terms])

    return _each((len(rows), len(columns)), entry).reshape(eqn.outvars[0].aval.shape)


def _each(shape: tuple[int, ...], make: Callable) -> np.ndarray:
    """An array of series, each computed from its index."""
    out = np.empty(shape, object)
    for k in np.ndindex(*shape):
        out[k] = make(k)
    return out


def _of_cond(expansion: Expansion, eqn: Any, inputs: Sequence[Any]) -> list[Any]:
    """The branch that is selected at the start of a step."""
    which, *args = inputs
    programs = [_opened(expansion, branch) for branch in eqn.params["branches"]]
    branches = [expanded(expansion, program, args) for program in programs]

    def chosen(*cases: Any) -> Series:
        cases = tuple(array_of(expansion, v) for v in cases)
        # `select_n` is undefined for an index out of this range.
        index = expansion.series(lambda _: jnp.clip(which[0], 0, len(cases) - 1), 0)
        return selected(expansion, index, cases)

    return [chosen(*cases) for cases in zip(*branches, strict=True)]


def _counts(eqn: Any) -> bool:
    """Whether a loop has a few known passes, and carries integers or flags alone, as the search for
    a place in a table."""
    carried = len(eqn.invars) - eqn.params["num_consts"] == len(eqn.outvars)
    return carried and eqn.params["length"] <= _PASSES and not any(map(_is_real, eqn.outvars))


def _is_real(atom: Any) -> bool:
    return is_real(atom.aval)


def _written_out(expansion: Expansion, eqn: Any, inputs: Sequence[Any]) -> list[Any]:
    """A loop pass after pass, so that its comparisons are located."""
    program, split = _opened(expansion, eqn.params["jaxpr"]), eqn.params["num_consts"]
    fixed, carried = list(inputs[:split]), list(inputs[split:])
    for _ in range(eqn.params["length"]):
        carried = expanded(expansion, program, [*fixed, *carried])
    return carried


def _of_one(expansion: Expansion, eqn: Any, inputs: Sequence[Series]) -> Series:
    """The result of an operation on series of whole arrays."""
    name, moves = eqn.primitive.name, is_real(eqn.outvars[0].aval)
    if name in RULES and (moves or name in COMPARISONS):
        # The equation is not in this key, unlike in `_made`, so that equal operations in different
        # programs are shared, such as those of H and of its rate.
        key = (name, _params_key(eqn), _decision(expansion, eqn), *inputs)
        return expansion.once(key, lambda: RULES[name](expansion, eqn, *inputs))
    bind = ft.partial(eqn.primitive.bind, **eqn.params)
    # Integers and flags are constant within a step. Constants that are not computed yet, such as a
    # sine at the start of a step, need no rule.
    constant = all(v.degree == 0 for v in inputs)
    if not moves or (name in FROZEN and not _is_complex(eqn)) or constant:
        ahead = decided_by(expansion, *inputs)
        out = expansion.series(lambda _: bind(*(just_after(ahead, v) for v in inputs)), 0)
        list_places(expansion, eqn, inputs, out)
        return out
    if name not in LINEAR or any(v.degree != 0 for v in inputs[1:]):
        raise NoSeries(name)
    # The other operands, such as positions, are constants in all orders.
    others = inputs[1:]
    return linear_function(expansion, lambda v: bind(v, *(o[0] for o in others)), inputs[0])


def _is_complex(eqn: Any) -> bool:
    # The sign of a complex number is z/|z|, which moves.
    return jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.complexfloating)


def _decision(expansion: Expansion, eqn: Any) -> int:
    """The order up to which coefficients decide the jumps of an operation; 0 without jumps."""
    return expansion.ahead if jumps(eqn) else 0


def _params_key(eqn: Any) -> str:
    return str(sorted(eqn.params.items(), key=lambda item: item[0])) if eqn.params else ""
