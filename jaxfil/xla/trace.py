"""A user's function, traced once.

A `Traced` is callable like the original, under every transformation. Its arctangents and products
of small matrices are replaced, and if it should be fast its sines and cosines too, by versions that
vectorise. It can compute values that need only some of its arguments ahead of the others, and
determine which of its results depend on which of its arguments.
"""

import functools as ft
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.xla import elements, fast_trig, matrix_product
from jaxfil.xla.bounded_slope import ROOTS, bounded
from jaxfil.xla.dependence import degrees_of, dependencies, zeros_of
from jaxfil.xla.masked_product import ELEMENTWISE, SINGULAR, masked
from jaxfil.xla.moves import by_slices
from jaxfil.xla.program import (
    evaluate_one,
    holds,
    interpreted,
    operations,
    programs,
    pruned,
    replaced_inside,
    with_traced_values,
)
from jaxfil.xla.series import Expansion
from jaxfil.xla.series_program import expanded
from jaxfil.xla.series_rules import jumps

_FLOATS = (jnp.float32, jnp.float64)
# Replacements of XLA's functions: arctan is wrong (jaxlib 0.10.2), sin and cos do not vectorise.
_RIGHT = {"atan": fast_trig.arctan}
_FAST = {"sin": fast_trig.sin, "cos": fast_trig.cos, **_RIGHT}


_SAFE = {"atan2": fast_trig.arctan2}
# The smallest array that is computed ahead in a compact program.
_SOME = 3
# Operations that take longer than a few multiplications.
_DEAR = (*_FAST, *_SAFE, "exp", "log", "log2", "pow", "tan", "tanh")
# Operations without forward derivatives, unless a user's own rule encloses them.
_NO_DERIVATIVES = {
    "custom_vjp_call": "jax.custom_vjp",
    "custom_vjp_call_jaxpr": "jax.custom_vjp",
    "pure_callback": "jax.pure_callback",
    "io_callback": "jax.experimental.io_callback",
}
_OPEN_LOOPS = {"while": "jax.lax.while_loop"}
# The time at which an argument is known: from the start, with the time, or with the state.
FIRST, EARLY, LATE = range(3)


class Traced:
    """`function` for arguments with the shapes of `example`.

    `when` says for each argument when it is known. Expensive values that can be computed early,
    `ahead` of the late arguments, can be passed to a call as `known`. Each sine is divided by the
    call's `fence`, the number 1 hidden from the compiler, unless the call says that its result is
    used `alone` and only one number in it depends on sines (see `ComponentSystem`). With
    `transposed`, derivatives that may be infinite or NaN use `masked_product`; with `bounded`,
    slopes of roots are zero where they are infinite (`bounded_slope`). Unless it is `fast`,
    sines and cosines are XLA's own, one operation in place of some twenty, arrays built from
    numbers remain arrays, and only arrays are computed early, by functions that vectorise.

    Numbers of the function's closure that are traced, as one with respect to which a user
    differentiates, are arguments too, so that its derivatives in any rule include them. They are
    `closed_over`, and precede the others in a call.
    """

    def __init__(
        self,
        function: Callable,
        *example: Any,
        when: Sequence[int] | None = None,
        transposed: bool = False,
        fast: bool = True,
        bounded: bool = False,
    ):
        self._fast, self._functions = fast, _FAST if fast else _RIGHT
        self._roots = ROOTS if bounded else frozenset()
        written, shape = jax.make_jaxpr(function, return_shape=True)(*example)
        written, self.closed_over = with_traced_values(written)
        self._closed = by_slices(written)
        self._of_rates: dict[int, Any] = {}
        self._tree = jax.tree.structure(shape)
        order = when or (LATE,) * len(example)
        each = zip(order, example, strict=True)
        self._when = [k for k, arg in each for _ in jax.tree.leaves(arg)]
        self._when = [FIRST] * len(self.closed_over) + self._when
        # The flags of the results that depend on a sine. With only one, a call whose result is used
        # `alone` needs no fence.
        nothing = [np.zeros(v.shape, bool) for v in self._closed.in_avals]
        waves = dependencies(self._closed, nothing, sources=self._functions)
        self._shared = sum(int(np.sum(flags)) for flags in waves) > 1
        # Without singular operations all derivatives are finite at finite arguments, and need no
        # masks.
        self.is_singular = holds(self._closed.jaxpr, SINGULAR)
        """Whether derivatives may be infinite or NaN at finite arguments."""
        self._masks = transposed and self.is_singular
        # Under `jit`, so that a transformation processes each function once, for any number of
        # calls.
        self._run, self._ahead = jax.jit(self._evaluated), jax.jit(self._found)

    def _evaluated(self, leaves: list, known: list | None, fence: Array | None) -> list:
        hold = _same if fence is None else lambda v: v / fence
        evaluation = _Evaluation(self._functions, hold, self._roots, known, self._masks, self._fast)
        return evaluation(self._closed, leaves, self._when)

    def _found(self, leaves: list) -> list:
        # Late arguments come last, and are unknown here.
        late = [None] * (len(self._when) - len(leaves))
        # Fast functions even in a compact program, since the values of all stages are one array
        # here, which fills vectors. Prints are not executed, since the call itself executes them.
        # With the masks of the call, which takes the values in the order in which they are found.
        given = _FAST, _same, self._roots, None, self._masks, self._fast
        evaluation = _Evaluation(*given, shows=False)
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
        """The expensive early values, given all arguments that are not late."""
        return self._ahead(jax.tree.leaves(args))

    def expansion(self, fence: Array | None = None) -> Expansion:
        """A new expansion for power series of the function."""
        hold = _same if fence is None else lambda v: v / fence
        return Expansion(self._functions, hold, self._roots)

    def expanded(self, made: Expansion, *args: Any) -> list[Any]:
        """Power series of the results (see `series_program.expanded`), given series of the
        arguments, or values, which are constant."""
        return expanded(made, self._closed, jax.tree.leaves(args))

    def expanded_rate(
        self, made: Expansion, known: Any, moving: Sequence[Any], along: Sequence[Any]
    ) -> list[Any]:
        """Power series of the rates of the results, as the arguments after `known` move along a
        direction."""
        program = self._rates(len(moving))
        args = [*jax.tree.leaves(known), *moving, *along]
        return expanded(made, program, args)

    def _rates(self, count: int) -> Any:
        """The program of the rates of the results, as the last `count` arguments move."""
        if count in self._of_rates:
            return self._of_rates[count]
        # Directions are arguments, so that one program serves the fields on both sides.
        run = operations(self._closed)

        def rates(*given: Any) -> list:
            fixed, rest = given[: -2 * count], given[-2 * count :]
            return jax.jvp(ft.partial(run, *fixed), rest[:count], rest[count:])[1]

        shapes = [jax.ShapeDtypeStruct(v.shape, v.dtype) for v in self._closed.in_avals]
        program = by_slices(pruned(jax.make_jaxpr(rates)(*shapes, *shapes[-count:])))
        self._of_rates[count] = program
        return program

    def without_derivatives(self) -> str | None:
        """An operation of the function without forward derivatives, by its name in JAX."""
        return _named(self._closed.jaxpr, _NO_DERIVATIVES)

    @property
    def has_open_loop(self) -> bool:
        """Whether the function has a loop without reverse derivatives."""
        return _named(self._closed.jaxpr, _OPEN_LOOPS) is not None

    def depends(self, *args: Any) -> Any:
        """Flags of the results that depend on the flagged arguments, number by number, as
        pytrees."""
        flags = [np.broadcast_to(flag, v.shape) for v, flag in self._asked(args)]
        out = dependencies(self._closed, flags)
        return jax.tree.unflatten(self._tree, list(map(np.asarray, out)))

    def zeros(self) -> Any:
        """Flags of the numbers in the results that are zero for all arguments, as pytrees."""
        return jax.tree.unflatten(self._tree, zeros_of(self._closed))

    def is_affine(self, *args: Any) -> bool:
        """Whether all results are provably affine in the flagged arguments."""
        degrees = [np.full(v.shape, int(flag)) for v, flag in self._asked(args)]
        return all(np.all(d <= 1) for d in degrees_of(self._closed, degrees))

    def is_kinked(self, *args: Any) -> bool:
        """Whether the function may jump, or have a kink, as the flagged arguments move."""
        found = [False]

        def rule(jaxpr: Any, eqn: Any, inputs: Sequence[bool]) -> list[bool]:
            found[0] |= any(inputs) and jumps(eqn)
            return [any(inputs)] * len(eqn.outvars)

        interpreted(self._closed, [flag for _, flag in self._asked(args)], lambda _: False, rule)
        return found[0]

    def _asked(self, flags: tuple) -> Iterator[tuple[Any, Any]]:
        """The shape of each argument with its flag, which is not set for those closed over."""
        every = [*(False for _ in self.closed_over), *jax.tree.leaves(flags)]
        return zip(self._closed.in_avals, every, strict=True)


def without_branches(function: Callable, *args: Any) -> Any:
    """`function(*args)`, with derivatives that are independent of branches that are not taken, in
    reverse mode too (`masked_product`)."""
    traced = Traced(function, *args, transposed=True, fast=False)
    return traced(traced.closed_over, *args)


def _named(jaxpr: Any, refused: Mapping[str, str]) -> str | None:
    """The first of some operations in a program, by its name in JAX."""
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        inner = [] if name == "custom_jvp_call" else programs(eqn.params)
        for found in (refused.get(name), *(_named(v, refused) for v in inner)):
            if found is not None:
                return found
    return None


def _same(v: Array) -> Array:
    return v


class _Evaluation:
    """The evaluation of a function equation by equation, with `functions` in place of XLA's.

    Expensive early values are appended to `found`, or taken from `known`, in order of evaluation.
    An unknown value is None, as are all values that depend on it. Operations without a result, such
    as `jax.debug.print`, are executed if `shows`.
    """

    def __init__(
        self,
        functions: Mapping[str, Callable],
        hold: Callable,
        roots: frozenset[str],
        known: Sequence[Array] | None = None,
        masks: bool = False,
        mixed: bool = True,
        shows: bool = True,
    ):
        self._functions, self._mixed = functions, mixed
        self._show = self._shown if shows else None
        self._hold, self._roots = hold, roots
        self._known = None if known is None else iter(known)
        self._masks = masks
        self.found = []

    def __call__(self, closed: Any, args: Sequence[Any], when: Sequence[int]) -> list[Any]:
        timed = list(zip(args, when, strict=True))
        out = interpreted(closed, timed, lambda v: (v, FIRST), self._made_when, self._show)
        return [elements.array_of(v) for v, _ in out]

    def _shown(self, jaxpr: Any, eqn: Any, inputs: Sequence[tuple]) -> list:
        """An equation without results, evaluated unchanged."""
        return evaluate_one(jaxpr, eqn, [elements.array_of(v) for v, _ in inputs])

    def _made_when(self, jaxpr: Any, eqn: Any, inputs: Sequence[tuple]) -> list[tuple]:
        """The results of one equation, given values and the times at which they are known, with
        their own times."""
        # An operation without operands, such as an iota, is a constant.
        when = max((k for _, k in inputs), default=FIRST)
        return [(v, when) for v in self._made(jaxpr, eqn, [v for v, _ in inputs], when)]

    def _made(self, jaxpr: Any, eqn: Any, inputs: Sequence[Any], when: int) -> Sequence[Any]:
        """The results of one equation."""
        if any(v is None for v in inputs):
            return [None] * len(eqn.outvars)
        if not self._masks and elements.in_elements(eqn, inputs, self._mixed):
            make = ft.partial(self._of_scalars, eqn)
            return [elements.evaluate(eqn, inputs, lambda *v: self._ahead(eqn, when, make, v)[0])]
        make = ft.partial(self._of_arrays, jaxpr, eqn)
        return self._ahead(eqn, when, make, [elements.array_of(v) for v in inputs])

    def _ahead(self, eqn: Any, when: int, make: Callable, inputs: Sequence[Any]) -> Sequence[Any]:
        """The results of one equation, taken from the values computed ahead if it is among them."""
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
        one = _SAFE.get(name, ft.partial(eqn.primitive.bind, **eqn.params))
        return [bounded(one)(*inputs) if name in self._roots else one(*inputs)]

    def _evaluate(
        self, jaxpr: Any, eqn: Any, inputs: Sequence[Any], hold: Callable
    ) -> Sequence[Any]:
        """The results of one equation, by its replacement if it has one."""
        name = eqn.primitive.name
        if name in self._functions and eqn.invars[0].aval.dtype in _FLOATS:
            return [hold(self._functions[name](jnp.asarray(inputs[0])))]
        if name in _SAFE:
            return [_SAFE[name](*map(jnp.asarray, inputs))]
        if name in self._roots:
            return [bounded(lambda *v: evaluate_one(jaxpr, eqn, v)[0])(*map(jnp.asarray, inputs))]
        if name == "dot_general" and self._mixed and matrix_product.is_small(eqn):
            return [matrix_product.written_out(eqn, *map(jnp.asarray, inputs))]
        return evaluate_one(jaxpr, _right_inside(eqn), inputs)


def _right_inside(eqn: Any) -> Any:
    """The same operation without XLA's arctangents in the programs inside it."""
    for name, function in (_RIGHT | _SAFE).items():

        def rule(inner: Any, *values: Array, function: Callable = function) -> Any:
            if inner.invars[0].aval.dtype in _FLOATS:
                return function(*values)
            return inner.primitive.bind(*values, **inner.params)

        eqn = replaced_inside(eqn, name, rule)
    return eqn
