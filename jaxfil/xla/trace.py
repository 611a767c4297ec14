"""A user's function, traced once.

A function of arrays enters; a `Traced` leaves: callable as the original is, under every
transformation, with its arctangents and products of small matrices, and if it is to be fast its
sines and cosines, replaced by ones that vectorise; able to compute what needs only some of its
arguments ahead of the others, and to say which of its results depend on which of its arguments.
"""

import functools as ft
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.xla import elements, fast_trig, matrix_product
from jaxfil.xla.masked_product import ELEMENTWISE, SINGULAR, evaluate_one, masked
from jaxfil.xla.moves import applies_function, by_slices
from jaxfil.xla.program import interpreted, names, operations, programs, pruned
from jaxfil.xla.select import select
from jaxfil.xla.series import Expansion
from jaxfil.xla.series_program import expanded

_FLOATS = (jnp.float32, jnp.float64)
# What stands in for XLA's functions: for one that is wrong, and for those that do not vectorise.
_RIGHT = {"atan": fast_trig.arctan}
_FAST = {"sin": fast_trig.sin, "cos": fast_trig.cos, **_RIGHT}


def _arctan2(y: Array, x: Array) -> Array:
    """The angle of (x, y), x made unknown to the compiler: where it is known to be 1, XLA turns to
    its arctangent, which is wrong (jaxlib 0.10.2)."""
    return jax.lax.atan2(y, select(y == y, x, y))


_SAFE = {"atan2": _arctan2}
# Numbers of an array for which it pays to find it ahead in a program that is to be small.
_SOME = 3
# What takes longer than a few multiplications.
_DEAR = (*_FAST, *_SAFE, "exp", "log", "log2", "pow", "tan", "tanh")
# Operations whose results depend each on the numbers in its own place. Of any other one each result
# depends on all numbers, whatever their shapes: of a sort, of a conditional, of a product of square
# matrices.
_NAMES = """
bessel_i0e bessel_i1e copy_p device_put imag nextafter real reduce_precision shift_left
shift_right_arithmetic shift_right_logical copy stop_gradient
"""
_ON_EACH = elements.ON_EACH.union(ELEMENTWISE, _NAMES.split())
# What has no forward derivatives, unless a rule of the user's own stands around it.
_NO_DERIVATIVES = {
    "custom_vjp_call": "jax.custom_vjp",
    "custom_vjp_call_jaxpr": "jax.custom_vjp",
    "pure_callback": "jax.pure_callback",
    "io_callback": "jax.experimental.io_callback",
}
# When an argument is known: from the start, with the time, or with the state.
FIRST, EARLY, LATE = range(3)


_Flags = np.ndarray | np.bool_
"""Of each element of an array, whether something is so."""


class Traced:
    """`function` for arguments shaped like `example`.

    `when` says of each argument when it is known. What is dear and can be computed early, `ahead`
    of the late arguments, a call can be given as `known`. Each sine is divided by the call's
    `fence`, a one that the compiler cannot see through, unless the call says that its result is
    used `alone` and one number in it depends on them: see `ComponentSystem`. With `transposed`, its
    derivatives are those of `masked_product` where they might not be finite. Unless it is `fast`,
    sines and cosines are XLA's own, one operation in place of some twenty, arrays that numbers
    enter into stay arrays, and no more than arrays are computed early, by functions that vectorise.
    """

    def __init__(
        self,
        function: Callable,
        *example: Any,
        when: Sequence[int] | None = None,
        transposed: bool = False,
        fast: bool = True,
    ):
        self._fast, self._functions = fast, _FAST if fast else _RIGHT
        written, shape = jax.make_jaxpr(function, return_shape=True)(*example)
        self._closed = by_slices(written)
        self._of_rates: dict[int, Any] = {}
        self._tree = jax.tree.structure(shape)
        order = when or (LATE,) * len(example)
        each = zip(order, example, strict=True)
        self._when = [k for k, arg in each for _ in jax.tree.leaves(arg)]
        nothing = jax.tree.map(lambda v: np.zeros(np.shape(v), bool), jax.tree.leaves(example))
        waves = _dependencies(self._closed, nothing, sources=self._functions)
        self._shared = sum(int(np.sum(flags)) for flags in waves) > 1
        self._masks = transposed and not SINGULAR.isdisjoint(names(self._closed.jaxpr))
        # As functions of their own they are put through a transformation once, however often they
        # are called.
        self._run, self._ahead = jax.jit(self._evaluated), jax.jit(self._found)

    def _evaluated(self, leaves: list, known: list | None, fence: Array | None) -> list:
        hold = _same if fence is None else lambda v: v / fence
        evaluation = _Evaluation(self._functions, hold, known, self._masks, self._fast)
        return evaluation(self._closed, leaves, self._when)

    def _found(self, leaves: list) -> list:
        late = [None] * (len(self._when) - len(leaves))
        evaluation = _Evaluation(_FAST, _same, mixed=self._fast, shows=False)
        evaluation(self._closed, [*leaves, *late], self._when)
        return evaluation.found

    def __call__(
        self,
        *args: Any,
        fence: Array | None = None,
        alone: bool = False,
        known: list | None = None,
    ) -> Any:
        fenced = self._shared or not alone
        out = self._run(jax.tree.leaves(args), known, fence if fenced else None)
        return jax.tree.unflatten(self._tree, out)

    def ahead(self, *args: Any) -> list:
        """What is dear and early, given all arguments that are not late."""
        return self._ahead(jax.tree.leaves(args))

    def expansion(self, fence: Array | None = None) -> Expansion:
        """Where power series of the function are made."""
        return Expansion(self._functions, _same if fence is None else lambda v: v / fence)

    def expanded(self, made: Expansion, *args: Any) -> list[Any]:
        """Power series of the results as `series_program.expanded` gives them, of such series or of
        values, which are constant."""
        return expanded(made, self._closed, jax.tree.leaves(args))

    def expanded_rate(
        self, made: Expansion, known: Any, moving: Sequence[Any], along: Sequence[Any]
    ) -> list[Any]:
        """The same of the rates of the results, as the arguments after those `known` move along a
        direction."""
        program = self._rates(len(moving))
        args = [*jax.tree.leaves(known), *moving, *along]
        return expanded(made, program, args)

    def _rates(self, count: int) -> Any:
        """The program of the rates of the results, as the last arguments, so many, move."""
        if count in self._of_rates:
            return self._of_rates[count]
        run = operations(self._closed)

        def rates(*given: Any) -> list:
            fixed, rest = given[: -2 * count], given[-2 * count :]
            return jax.jvp(ft.partial(run, *fixed), rest[:count], rest[count:])[1]

        shapes = [jax.ShapeDtypeStruct(v.shape, v.dtype) for v in self._closed.in_avals]
        program = by_slices(pruned(jax.make_jaxpr(rates)(*shapes, *shapes[-count:])))
        self._of_rates[count] = program
        return program

    def without_derivatives(self) -> str | None:
        """What the function calls that has no forward derivatives, by its name in JAX."""
        return _without_derivatives(self._closed.jaxpr)

    def depends(self, *args: Any) -> Any:
        """Which results depend on the flagged arguments, number by number: pytrees of flags in, of
        flags out."""
        jaxpr = self._closed.jaxpr
        flags = [
            np.broadcast_to(flag, v.aval.shape)
            for v, flag in zip(jaxpr.invars, jax.tree.leaves(args), strict=True)
        ]
        out = _dependencies(self._closed, flags)
        return jax.tree.unflatten(self._tree, list(map(np.asarray, out)))

    def is_affine(self, *args: Any) -> bool:
        """Whether all results are affine in the flagged arguments, as far as the operations say."""
        jaxpr = self._closed.jaxpr
        degrees = [
            np.full(v.aval.shape, int(flag))
            for v, flag in zip(jaxpr.invars, jax.tree.leaves(args), strict=True)
        ]
        return all(np.all(d <= 1) for d in _degrees(self._closed, degrees))


def _without_derivatives(jaxpr: Any) -> str | None:
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        inner = [] if name == "custom_jvp_call" else programs(eqn.params)
        for found in (_NO_DERIVATIVES.get(name), *map(_without_derivatives, inner)):
            if found is not None:
                return found
    return None


def _same(v: Array) -> Array:
    return v


class _Evaluation:
    """A function equation by equation, with `functions` in place of XLA's.

    What is dear and early is left in `found`, or taken from `known`, in order. An unknown value is
    None, and what is made of it too. What has no result, as `jax.debug.print`, is done if it
    `shows`.
    """

    def __init__(
        self,
        functions: Mapping[str, Callable],
        hold: Callable,
        known: Sequence[Array] | None = None,
        masks: bool = False,
        mixed: bool = True,
        shows: bool = True,
    ):
        self._functions, self._mixed = functions, mixed
        self._show = self._shown if shows else None
        self._hold = hold
        self._known = None if known is None else iter(known)
        self._masks = masks
        self.found = []

    def __call__(self, closed: Any, args: Sequence[Any], when: Sequence[int]) -> list[Any]:
        timed = list(zip(args, when, strict=True))
        out = interpreted(closed, timed, lambda v: (v, FIRST), self._made_when, self._show)
        return [elements.array_of(v) for v, _ in out]

    def _shown(self, jaxpr: Any, eqn: Any, inputs: Sequence[tuple]) -> list:
        """What has no result, as it is."""
        return evaluate_one(jaxpr, eqn, [elements.array_of(v) for v, _ in inputs])

    def _made_when(self, jaxpr: Any, eqn: Any, inputs: Sequence[tuple]) -> list[tuple]:
        """What one equation gives of values with when they are known, and when that is."""
        when = max((k for _, k in inputs), default=FIRST)
        return [(v, when) for v in self._made(jaxpr, eqn, [v for v, _ in inputs], when)]

    def _made(self, jaxpr: Any, eqn: Any, inputs: Sequence[Any], when: int) -> Sequence[Any]:
        """What one equation gives."""
        if any(v is None for v in inputs):
            return [None] * len(eqn.outvars)
        if not self._masks and elements.in_elements(eqn, inputs, self._mixed):
            make = ft.partial(self._of_scalars, eqn)
            return [elements.evaluate(eqn, inputs, lambda *v: self._ahead(eqn, when, make, v)[0])]
        make = ft.partial(self._of_arrays, jaxpr, eqn)
        return self._ahead(eqn, when, make, [elements.array_of(v) for v in inputs])

    def _ahead(self, eqn: Any, when: int, make: Callable, inputs: Sequence[Any]) -> Sequence[Any]:
        """What one equation gives, unless it is known ahead."""
        name, aval = eqn.primitive.name, eqn.outvars[0].aval
        if when != EARLY or name not in _DEAR or not (self._mixed or aval.size >= _SOME):
            return make(*inputs)
        if self._known is not None:
            return [next(self._known)]
        outputs = make(*inputs)
        self.found.extend(outputs)
        return outputs

    def _of_arrays(self, jaxpr: Any, eqn: Any, *inputs: Any) -> Sequence[Any]:
        name = eqn.primitive.name
        if self._masks and name in ELEMENTWISE:
            out = masked(lambda *v: self._evaluate(jaxpr, eqn, v, _same)[0])(*inputs)
            return [self._hold(out) if name in self._functions else out]
        return self._evaluate(jaxpr, eqn, inputs, self._hold)

    def _of_scalars(self, eqn: Any, *inputs: Any) -> Sequence[Any]:
        name = eqn.primitive.name
        if name in self._functions and eqn.invars[0].aval.dtype in _FLOATS:
            return [self._hold(self._functions[name](*inputs))]
        return [_SAFE.get(name, ft.partial(eqn.primitive.bind, **eqn.params))(*inputs)]

    def _evaluate(
        self, jaxpr: Any, eqn: Any, inputs: Sequence[Any], hold: Callable
    ) -> Sequence[Any]:
        """One equation, by the function that stands in for its own if there is one."""
        name = eqn.primitive.name
        if name in self._functions and eqn.invars[0].aval.dtype in _FLOATS:
            return [hold(self._functions[name](jnp.asarray(inputs[0])))]
        if name in _SAFE:
            return [_SAFE[name](*map(jnp.asarray, inputs))]
        if name == "dot_general" and self._mixed and matrix_product.is_small(eqn):
            return [matrix_product.written_out(eqn, *map(jnp.asarray, inputs))]
        return evaluate_one(jaxpr, eqn, inputs)


def _through(program: Any, args: Sequence[Any], rule: Callable, kind: type) -> list[Any]:
    """What is known of each number, as arrays of a kind that is False or 0 of a constant, through a
    program: what only moves numbers about moves it too, and `rule(eqn, inputs)` is that of any
    other operation."""

    def known(_: Any, eqn: Any, inputs: Sequence[Any]) -> Sequence[Any]:
        name, shape = eqn.primitive.name, eqn.outvars[0].aval.shape
        if name in elements.MOVES:
            return [elements.moved(name, eqn.params, [*map(np.asarray, inputs)], shape)]
        if name == "custom_jvp_call":
            return _through(eqn.params["call_jaxpr"], inputs, rule, kind)
        return rule(eqn, inputs)

    return interpreted(program, args, lambda v: np.zeros(np.shape(v), kind), known)


def _dependencies(program: Any, args: Sequence[Any], sources: Collection[str] = ()) -> list[_Flags]:
    """Element-wise dependency flags through a program; what the primitives `sources` give is
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


# More than affine.
_CURVED = 2
# Operations that are linear in their operands of these numbers, given all others.
_LINEAR = {
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "gather": (0,),
    "scatter": (0, 2),
    "scatter-add": (0, 2),
    "scatter_add": (0, 2),
}


def _degrees(program: Any, args: Sequence[np.ndarray]) -> list:
    """The degree of each number in the arguments of degree 1, through a program: 0, 1, or `_CURVED`
    for whatever else."""

    def degrees(eqn: Any, inputs: Sequence[np.ndarray]) -> list:
        return [np.broadcast_to(_degree(eqn, inputs), v.aval.shape) for v in eqn.outvars]

    return _through(program, args, degrees, int)


def _degree(eqn: Any, inputs: Sequence[np.ndarray]) -> Any:
    """The degree of what one operation gives, number by number where that is easily told."""
    name, highest = eqn.primitive.name, [int(np.max(d, initial=0)) for d in inputs]
    if name == "convert_element_type" and eqn.outvars[0].aval.dtype not in _FLOATS:
        return _CURVED if any(highest) else 0  # what is cut off to whole numbers
    if name in ("add", "add_any", "sub", "neg", "convert_element_type", "copy"):
        return ft.reduce(np.maximum, inputs)
    if name == "mul":
        return np.minimum(inputs[0] + inputs[1], _CURVED)
    if name == "div" and highest[1] == 0:
        return inputs[0]
    if name == "select_n" and highest[0] == 0:
        return ft.reduce(np.maximum, inputs[1:])
    if name == "reduce_sum":
        return np.max(inputs[0], axis=tuple(eqn.params["axes"]), initial=0)
    if name == "dot_general":
        return min(sum(highest), _CURVED)
    numbers = () if applies_function(eqn) else _LINEAR.get(name, ())
    if numbers and not any(d for k, d in enumerate(highest) if k not in numbers):
        return max(highest[k] for k in numbers)
    return _CURVED if any(highest) else 0
