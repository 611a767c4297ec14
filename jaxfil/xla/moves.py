"""Numbers at known positions, moved by slices.

Operations such as `x.at[0].mul(v)`, `x[jnp.array([2, 0])]`, `jnp.split` and `jnp.cumsum` become
slices and concatenations where positions are known, and a mask where one is not. JAX traces them as
scatters, gathers and the like, which a single kernel cannot contain, and which hide the
dependencies between numbers.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core as jexc
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.xla import elements
from jaxfil.xla.known import is_known
from jaxfil.xla.program import evaluate_one, interpreted, names, pruned

# The largest number of slices that replace a gather.
_SLICES = 32
# The largest number of terms added to one position.
_TERMS = 8
# The largest array in which a mask replaces one unknown position.
_MASKED = 64
_COMBINED: dict[str, Callable] = {
    "scatter-add": jax.lax.add,
    "scatter-max": jax.lax.max,
    "scatter-min": jax.lax.min,
    "scatter-mul": jax.lax.mul,
    "scatter-sub": jax.lax.sub,
}
# Operations on known integers, in addition to rearrangements.
# JAX converts positions that are counted from the end by `lt`, `add` and `select_n`.
_ON_NUMBERS: dict[str, Callable] = {
    "add": np.add,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "select_n": lambda which, *cases: np.choose(which.astype(int), cases),
    "sub": np.subtract,
}


def by_slices(program: Any) -> Any:
    """The same program with its numbers moved by slices."""
    if names(program.jaxpr).isdisjoint(_RULES):
        # The same object, so that its calls share one lowering.
        return program

    def run(*args: Any) -> list:
        unknown = [(v, None) for v in args]
        made = interpreted(program, unknown, lambda v: (v, _whole(v)), _made, _shown)
        return [v for v, _ in made]

    shapes = [jax.ShapeDtypeStruct(v.shape, v.dtype) for v in program.in_avals]
    # Computations of positions that are known by now have no users.
    return pruned(jax.make_jaxpr(run)(*shapes))


def taken(array: Array, places: np.ndarray) -> Array:
    """`array[places]` of a vector, by slices if they are few. A gather takes longer to compile than
    all operations on its result, and is not vectorised."""
    return _put_together([array], np.zeros_like(places), places)


def _whole(value: Any) -> np.ndarray | None:
    """The numbers of a known value, if they are integers or flags."""
    if not is_known(value) or jnp.result_type(value).kind not in "iub":
        return None
    return np.asarray(value)


def _made(jaxpr: Any, eqn: Any, inputs: Sequence[tuple]) -> list[tuple]:
    """The results of one equation, for values each with its known integers or None."""
    arrays, numbers = [v for v, _ in inputs], [k for _, k in inputs]
    known = _computed(eqn, numbers)
    if known is not None:
        return [(known, known)]
    rule = _RULES.get(eqn.primitive.name)
    made = None if rule is None else rule(eqn, [*map(jnp.asarray, arrays)], numbers)
    if made is None:
        made = evaluate_one(jaxpr, eqn, arrays)
    return [(v, None) for v in made]


def _shown(jaxpr: Any, eqn: Any, inputs: Sequence[tuple]) -> list:
    """An equation without results, evaluated unchanged."""
    return evaluate_one(jaxpr, eqn, [v for v, _ in inputs])


def _computed(eqn: Any, numbers: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """The result of one equation on known integers; None for other operands."""
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    known = [v for v in numbers if v is not None]
    if len(known) < len(numbers) or out.dtype.kind not in "iub":
        return None
    if name == "iota":
        size, axis = out.shape, eqn.params["dimension"]
        return np.indices(size, out.dtype)[axis]
    if name in elements.MOVES:
        return np.asarray(elements.moved(name, eqn.params, known, out.shape), out.dtype)
    # Older versions of JAX put an array of constants on the device.
    if name in ("convert_element_type", "copy") or (name == "device_put" and len(known) == 1):
        return np.asarray(known[0], out.dtype)
    # In the type of the program, since NumPy promotes integers by other rules.
    apply = _ON_NUMBERS.get(name)
    return None if apply is None else np.asarray(apply(*known), out.dtype)


def _put_together(arrays: Sequence[Array], source: np.ndarray, place: np.ndarray) -> Array:
    """The array whose numbers are at each `place` of the flat array number `source`."""
    # A run of consecutive numbers of one array is one slice.
    cuts = np.flatnonzero((np.diff(source.ravel()) != 0) | (np.diff(place.ravel()) != 1)) + 1
    flat = [jnp.ravel(v) for v in arrays]
    if len(cuts) >= _SLICES:
        starts = np.cumsum([0, *(v.size for v in flat)])
        joined = jnp.concatenate(flat)
        # Positions are known to be inside, so that no clamping is compiled.
        return joined.at[starts[source] + place].get(mode="promise_in_bounds")
    runs = zip(np.split(source.ravel(), cuts), np.split(place.ravel(), cuts), strict=True)
    pieces = [jax.lax.slice(flat[s[0]], (p[0],), (p[-1] + 1,)) for s, p in runs]
    return jnp.concatenate(pieces).reshape(source.shape)


def _places(eqn: Any, indices: np.ndarray | None) -> np.ndarray | None:
    """The positions in the flat operand of a gather's results, or of a scatter's updates; None if
    unknown or partly outside."""
    d, gathers = eqn.params["dimension_numbers"], eqn.primitive.name == "gather"
    # Batch axes, as `vmap` creates them, are not in the formulas below.
    if indices is None or d.operand_batching_dims:
        return None
    numbers = eqn.outvars[0].aval if gathers else eqn.invars[2].aval
    # `window` has the axes of the numbers that correspond to axes of the operand (except for the
    # dropped ones), `to` the axes of the operand that are indexed.
    window = d.offset_dims if gathers else d.update_window_dims
    dropped = d.collapsed_slice_dims if gathers else d.inserted_window_dims
    to = d.start_index_map if gathers else d.scatter_dims_to_operand_dims
    shape, grid = eqn.invars[0].aval.shape, np.indices(numbers.shape)
    kept = [k for k in range(len(shape)) if k not in dropped]
    batch = tuple(grid[k] for k in range(len(numbers.shape)) if k not in window)
    starts = np.broadcast_to(indices[batch], (*numbers.shape, len(to)))
    # The position of each number along each axis of the operand.
    at = np.zeros((len(shape), *numbers.shape), int)
    at[kept] += grid[list(window)]
    at[list(to)] += np.moveaxis(starts, -1, 0)
    # JAX clips, drops or fills positions outside, depending on the mode.
    inside = numbers.size > 0 and np.all(elements.are_inside(at, shape))
    return np.asarray(np.ravel_multi_index(tuple(at), shape)) if inside else None


def _gather(eqn: Any, arrays: list[Array], numbers: Sequence[Any]) -> list[Array] | None:
    place = _places(eqn, numbers[1])
    if place is None or np.sum(np.diff(place.ravel()) != 1) >= _SLICES:
        return None
    return [_put_together(arrays[:1], np.zeros_like(place), place)]


def _scatter(eqn: Any, arrays: list[Array], numbers: Sequence[Any]) -> list[Array] | None:
    operand, index, updates = arrays
    combine, repeats = _combination(eqn)
    place = _places(eqn, numbers[1])
    if place is None:
        return _scatter_to_unknown(eqn, operand, index, updates)
    terms, out = _terms(place.ravel(), operand.size), operand
    if len(terms) > repeats:
        return None
    for term in terms:
        there = np.flatnonzero(term >= 0)
        # Only at these positions: a function that is applied may have no derivative elsewhere.
        new = combine(taken(jnp.ravel(out), there), taken(jnp.ravel(updates), term[there]))
        # `new` has one number for each of these positions, in their order.
        term[there] = np.arange(there.size)
        out = _replaced(out, new, term)
    return [out]


def _combination(eqn: Any) -> tuple[Callable[[Array, Array], Array], int]:
    """The function of old numbers and updates that gives the new numbers, and the largest number of
    updates of one position, applied one after the other."""
    name = eqn.primitive.name.replace("_", "-")
    if name != "scatter":
        return _COMBINED[name], _TERMS
    if not applies_function(eqn):
        # Of several updates of one position, JAX does not define which one remains.
        return lambda old, new: new, 1

    def applied(old: Array, new: Array) -> Array:
        program = jexc.ClosedJaxpr(eqn.params["update_jaxpr"], eqn.params["update_consts"])
        return jexc.jaxpr_as_fun(program)(old, new)[0]

    # Also differentiable, which this scatter is not in JAX.
    return jnp.vectorize(applied), 1


def applies_function(eqn: Any) -> bool:
    """Whether a scatter applies a function to numbers, as `x.at[0].apply(jnp.negative)` does."""
    return eqn.primitive.name == "scatter" and eqn.params["update_jaxpr"] is not None


def _scatter_to_unknown(eqn: Any, operand: Array, index: Array, updates: Array) -> list | None:
    """A scatter to one position along one axis, by a mask: `x.at[surface].set(0)`."""
    d, combine = eqn.params["dimension_numbers"], _combination(eqn)[0]
    axes = d.scatter_dims_to_operand_dims
    at_one = index.shape == (1,) and len(axes) == 1 and d.inserted_window_dims == axes
    clips = eqn.params["mode"] == jax.lax.GatherScatterMode.CLIP
    if not at_one or clips or operand.size > _MASKED:
        return None
    # A position outside matches no number, so that the update is dropped, as all modes but clipping
    # permit.
    there = jax.lax.broadcasted_iota(index.dtype, operand.shape, axes[0]) == index[0]
    # The old number at all positions: a function that is applied may have no derivative elsewhere.
    old = jnp.sum(operand, axes[0], keepdims=True, where=there, dtype=operand.dtype)
    new = combine(old, jnp.expand_dims(updates, axes[0]))
    return [jnp.where(there, new, operand)]


def _terms(place: np.ndarray, size: int) -> list[np.ndarray]:
    """For each of `size` positions the index of an update that goes there, −1 without one; repeated
    until all updates are used."""
    left, terms = np.arange(place.size), []
    while left.size:
        # The first update of each position, so that several are applied in their order.
        places, first = np.unique(place[left], return_index=True)
        term = np.full(size, -1)
        term[places] = left[first]
        terms.append(term)
        left = np.delete(left, first)
    return terms


def _replaced(operand: Array, updates: Array, term: np.ndarray) -> Array:
    """The operand with the updates given by a `term` in their positions."""
    place = np.where(term < 0, np.arange(term.size), term).reshape(operand.shape)
    return _put_together((updates, operand), (term < 0).astype(int).reshape(operand.shape), place)


def _split(eqn: Any, arrays: list[Array], _: Any) -> list[Array]:
    axis, ends = eqn.params["axis"], np.cumsum([0, *eqn.params["sizes"]])
    cuts = itertools.pairwise(map(int, ends))
    return [jax.lax.slice_in_dim(arrays[0], a, b, axis=axis) for a, b in cuts]


def _unstack(eqn: Any, arrays: list[Array], _: Any) -> list[Array]:
    """The equation of `list(x)` from JAX 0.11 on."""
    (x,), axis = arrays, eqn.params["axis"]
    one = [jax.lax.slice_in_dim(x, k, k + 1, axis=axis) for k in range(x.shape[axis])]
    return [jax.lax.squeeze(v, (axis,)) for v in one]


def _cumsum(eqn: Any, arrays: list[Array], _: Any) -> list[Array]:
    """A cumulative sum by doubling, over 2, 4, 8, … numbers."""
    (x,), axis, reverse = arrays, eqn.params["axis"], eqn.params["reverse"]
    size, shift = x.shape[axis], 1
    while shift < size:
        low, high = (shift, size) if reverse else (0, size - shift)
        # Each number is the sum of up to `shift` numbers so far. The first `shift` of them are
        # complete, so that zeros are added to them.
        rest = jnp.zeros_like(jax.lax.slice_in_dim(x, 0, shift, axis=axis))
        moved = jax.lax.slice_in_dim(x, low, high, axis=axis)
        x = x + jnp.concatenate([moved, rest] if reverse else [rest, moved], axis)
        shift *= 2
    return [x]


_RULES: dict[str, Callable] = {
    "cumsum": _cumsum,
    "gather": _gather,
    "scatter": _scatter,
    "split": _split,
    "unstack": _unstack,
    **dict.fromkeys(_COMBINED, _scatter),
    **dict.fromkeys((name.replace("-", "_") for name in _COMBINED), _scatter),
}
