"""The primitive `pushforward`: results and their tangents.

A `Push` computes both from values and rates. The primitive has the rules that JAX's transformations
need: its derivative is another pushforward, and so is its batch. If values are known and rates are
not yet, as in a linearisation, it computes results and the Jacobian first, and tangents later.
"""

import dataclasses
import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.extend.core as jexc
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.interpreters import ad, batching, mlir, partial_eval as pe
from jaxtyping import Array

from jaxfil.xla.compiler import PARTS
from jaxfil.xla.masked_product import masked_row_product
from jaxfil.xla.program import operations, pruned

# The module that has `set_current_trace`; `jax.core` until JAX 0.8.
_traces: Any = jexc if hasattr(jexc, "set_current_trace") else jax.core

Spread = Callable[[Sequence[bool]], list[bool]]
"""A function from flags of a program's batched arguments to flags of its batched results."""
Make = Callable[[Any, Spread], Callable]
"""A function that turns a program into a function, for example a kernel."""


def is_real(value: Any) -> bool:
    """Whether a value, or a shape, has tangents."""
    return jnp.issubdtype(value.dtype, jnp.inexact)


@dataclasses.dataclass(frozen=True, eq=False)
class Single:
    """The push of one lane, a program with rates for the values numbered `moving`."""

    base: Any
    moving: tuple[int, ...]
    batches: Spread
    """`spread` of the program's results."""
    make: Make
    joint: Any
    """The program of results and tangents."""

    @staticmethod
    def of(base: Any, moving: tuple[int, ...], batches: Spread, make: Make) -> "Single":
        """The push of a program, with its joint program traced."""
        return Single(base, moving, batches, make, _joint(base, moving) if moving else base)

    @property
    def count(self) -> int:
        """The number of values."""
        return len(self.base.in_avals)

    @property
    def program(self) -> Any:
        """The program of one lane."""
        return self.joint

    def spread(self, batched: Sequence[bool]) -> list[bool]:
        """Flags of the batched results, given flags of the batched values."""
        return self.batches(batched)

    @property
    def outs(self) -> tuple[list, list]:
        """Shapes of results and of tangents."""
        avals = self.base.out_avals
        return avals, [v for v in avals if is_real(v) and self.moving]

    def spread_of_both(self, batched: Sequence[bool]) -> list[bool]:
        """Flags of the batched results and tangents, given the flags of values and rates."""
        if not self.moving:
            return self.spread(batched)
        # A result depends on values alone, a tangent on values and rates. The directions of a
        # Jacobian therefore share their results.
        of_values, of_rates = batched[: self.count], batched[self.count :]
        either = list(of_values)
        for k, flag in zip(self.moving, of_rates, strict=True):
            either[k] = either[k] or flag
        real = map(is_real, self.base.out_avals)
        return [*self.spread(of_values), *itertools.compress(self.spread(either), real)]

    def forward(self, values: Sequence[Array], rates: Sequence[Array]) -> tuple[list, list]:
        """Results and tangents."""
        out = self.make(self.joint, self.spread_of_both)(*values, *rates)
        split = len(self.base.out_avals)
        return list(out[:split]), list(out[split:])

    def jacobian(self, values: Sequence[Array]) -> tuple[list, list]:
        """Results, and for each real result its derivatives by all numbers that vary, along the
        first axis (of each lane)."""
        shapes = _shapes(self.base, self.moving)
        ends = np.cumsum([int(np.prod(v.shape)) for v in shapes])
        # Row k of the unit matrix is the direction of number k among all rates.
        parts = np.split(np.eye(ends[-1]), ends[:-1], axis=1)
        rows = [
            jnp.asarray(part.reshape(-1, *v.shape), v.dtype)
            for part, v in zip(parts, shapes, strict=True)
        ]
        # Values are not batched, so that results are computed once for all directions.
        directions = Batch(self, (None,) * self.count + (0,) * len(rows), int(ends[-1]))
        out, columns = bind(directions, values, rows)
        # A result that depends on values alone, where only rates move, has one tangent, a zero.
        return out, [
            v if axis == 0 else jnp.broadcast_to(v, (directions.size, *v.shape))
            for v, axis in zip(columns, directions.out_axes[1], strict=True)
        ]

    def applied(self, columns: Sequence[Array], rates: Sequence[Array]) -> list:
        """The tangents for these derivatives and rates."""

        # The rates have the order of the rows in `jacobian`, and possibly another float type than a
        # result.
        def product(column: Array) -> Array:
            flat = jnp.concatenate([jnp.ravel(v).astype(column.dtype) for v in rates])
            return masked_row_product(flat, column)

        return list(map(product, columns))

    def still(self) -> "Single":
        """The same push without tangents."""
        return Single.of(self.base, (), self.batches, self.make)

    def derived(self, moving: tuple[int, ...]) -> "Single":
        """The derivative of this push, whose values are the values and rates of this one, with
        rates for those numbered `moving`."""
        return Single.of(self.joint, moving, self.spread_of_both, self.make)


def _shapes(base: Any, moving: Sequence[int]) -> list[jax.ShapeDtypeStruct]:
    """The shapes of the rates of some values of a program."""
    avals = base.in_avals
    return [jax.ShapeDtypeStruct(avals[k].shape, avals[k].dtype) for k in moving]


def _joint(base: Any, moving: tuple[int, ...]) -> Any:
    """The program of results and tangents, with rates for the values numbered `moving`."""
    run, count = operations(base), len(base.in_avals)

    def both(*given: Any) -> list:
        values, rates = given[:count], given[count:]

        def moved(*moves: Any) -> list:
            here = list(values)
            for k, v in zip(moving, moves, strict=True):
                here[k] = v
            return run(*here)

        out, tangents = jax.jvp(moved, [values[k] for k in moving], list(rates))
        # Integers have tangents of type float0, which hold no numbers.
        return [*out, *(v for v in tangents if v.dtype != jax.dtypes.float0)]

    # Many tangents are zero by structure; pruning removes them before XLA receives them.
    return pruned(jax.make_jaxpr(both)(*_shapes(base, range(count)), *_shapes(base, moving)))


@dataclasses.dataclass(frozen=True, eq=False)
class Batch:
    """The push of a batch of lanes, with the same methods. Values and rates whose axis is 0 are
    batched; None marks the others."""

    lane: "Push"
    axes: tuple[int | None, ...]
    size: int

    @property
    def count(self) -> int:
        return self.lane.count

    @property
    def program(self) -> Any:
        return self.lane.program

    def spread(self, batched: Sequence[bool]) -> list[bool]:
        return self.lane.spread(batched)

    def spread_of_both(self, batched: Sequence[bool]) -> list[bool]:
        return self.lane.spread_of_both(batched)

    @property
    def out_axes(self) -> tuple[list, list]:
        """The batch axes of results and of tangents."""
        flags = self.spread_of_both([axis == 0 for axis in self.axes])
        axes, split = [0 if flag else None for flag in flags], len(self.lane.outs[0])
        return axes[:split], axes[split:]

    @property
    def outs(self) -> tuple[list, list]:
        def wide(shapes: list, axes: list) -> list:
            return [
                v
                if axis is None
                else jax.core.ShapedArray((self.size, *v.shape), v.dtype, weak_type=v.weak_type)
                for v, axis in zip(shapes, axes, strict=True)
            ]

        (out, tangents), (of_out, of_tangents) = self.lane.outs, self.out_axes
        return wide(out, of_out), wide(tangents, of_tangents)

    def forward(self, values: Sequence[Array], rates: Sequence[Array]) -> tuple[list, list]:
        run = jax.vmap(self.lane.forward, self._split_axes(), self.out_axes)
        return run(list(values), list(rates))

    def _split_axes(self) -> tuple[list, list]:
        """The batch axes of values and of rates."""
        return list(self.axes[: self.count]), list(self.axes[self.count :])

    def jacobian(self, values: Sequence[Array]) -> tuple[list, list]:
        axes, _ = self._split_axes()
        # Values that are the same in all lanes have one Jacobian for the rates of all lanes.
        if 0 not in axes:
            return self.lane.jacobian(values)
        out_axes = [0 if flag else None for flag in self.spread([axis == 0 for axis in axes])]
        return jax.vmap(self.lane.jacobian, (axes,), (out_axes, 0))(list(values))

    def applied(self, columns: Sequence[Array], rates: Sequence[Array]) -> list:
        of_values, of_rates = self._split_axes()
        axis = 0 if 0 in of_values else None
        found = jax.vmap(self.lane.applied, (axis, of_rates), axis_size=self.size)(
            list(columns), list(rates)
        )
        # A tangent that is not batched is the same in all rows.
        return [
            v[0] if axis is None else v for v, axis in zip(found, self.out_axes[1], strict=True)
        ]

    def still(self) -> "Batch":
        return Batch(self.lane.still(), self.axes[: self.count], self.size)

    def derived(self, moving: tuple[int, ...]) -> "Batch":
        axes = self.axes + tuple(self.axes[k] for k in moving)
        return Batch(self.lane.derived(moving), axes, self.size)


Push = Single | Batch
"""Results and their tangents, as a function of values and of the rates of some of them."""


pushforward_p = jexc.Primitive("pushforward")
pushforward_p.multiple_results = True


def bind(push: Push, values: Sequence[Any], rates: Sequence[Any]) -> tuple[list, list]:
    """Results and tangents, computed by the primitive."""
    # The program is a parameter so that `fits` can examine it.
    out = pushforward_p.bind(*values, *rates, push=push, program=push.program)
    split = len(push.outs[0])
    return out[:split], out[split:]


def _forward(*args: Any, push: Push, **_: Any) -> list:
    # A surrounding kernel's attributes must not apply to calls that are traced here.
    with set_xla_metadata(**PARTS):
        return [*itertools.chain(*push.forward(args[: push.count], args[push.count :]))]


def _abstract(*_: Any, push: Push, program: Any) -> tuple[list, Any]:
    # Weak types and effects are those of the program, as if it were traced here. Without the weak
    # types a result would promote other numbers, and without the effects JAX would remove
    # callbacks.
    shapes = itertools.chain(*push.outs)
    outs = [jax.core.ShapedArray(v.shape, v.dtype, weak_type=v.weak_type) for v in shapes]
    return outs, program.effects


def _jvp(primals: Any, tangents: Any, *, push: Push, **params: Any) -> tuple[list, list]:
    # Under `jax.jvp` an integer has a tangent of type float0, which is not a symbolic zero.
    moving = tuple(
        k
        for k, v in enumerate(tangents)
        if not isinstance(v, ad.Zero) and jax.typeof(v).dtype != jax.dtypes.float0
    )
    if moving:
        out, found = bind(push.derived(moving), primals, [tangents[k] for k in moving])
    else:  # only integers have tangents
        out, found = pushforward_p.bind(*primals, push=push, **params), []
    rates = iter(found)
    return out, [
        next(rates) if moving and is_real(v) else ad.Zero(jax.typeof(v).to_tangent_aval())
        for v in out
    ]


def rows_of(args: Any, dims: Any) -> tuple[int, list[bool], list]:
    """The size of a batch, flags of its batched arguments, and the arguments with rows first."""
    (size,) = {v.shape[d] for v, d in zip(args, dims, strict=True) if d is not None}
    rows = [v if d is None else jnp.moveaxis(v, d, 0) for v, d in zip(args, dims, strict=True)]
    return size, [d is not None for d in dims], rows


def _batch(args: Any, dims: Any, *, push: Push, **_: Any) -> tuple[list, list]:
    size, batched, rows = rows_of(args, dims)
    several = Batch(push, tuple(0 if flag else None for flag in batched), size)
    out, tangents = bind(several, rows[: push.count], rows[push.count :])
    return [*out, *tangents], [*itertools.chain(*several.out_axes)]


def _partial_eval(trace: Any, *tracers: Any, push: Push, **params: Any) -> list:
    """The rule for known values and unknown rates, by which results and derivatives are computed
    now, and tangents later."""
    values, rates = tracers[: push.count], tracers[push.count :]
    # With known rates this is an ordinary operation. With unknown values no Jacobian can be
    # computed.
    if all(v.is_known() for v in rates) or not all(v.is_known() for v in values):
        return trace.default_process_primitive(pushforward_p, tracers, {"push": push, **params})
    out, columns = push.jacobian([jnp.asarray(v.pval.get_known()) for v in values])
    # JAX calls this rule inside the outer trace, in which the Jacobian is computed. The products
    # with unknown rates belong to the trace of the linear program.
    with _traces.set_current_trace(trace):
        return [*out, *push.applied(columns, rates)]


def _partial_eval_of_eqn(_: Any, unknown: Sequence[bool], made: Sequence[bool], eqn: Any) -> tuple:
    """The same rule in a program whose residuals are recomputed, as in `jax.checkpoint`.

    It is an entry of JAX's `partial_eval_jaxpr_custom_rules`, and follows the protocol there.
    """
    push, still = eqn.params["push"], eqn.params["push"].still()
    split = len(push.outs[0])
    needed = [v for v, there in zip(eqn.invars, made, strict=True) if not there]
    # Without values neither results nor tangents are known.
    if any(unknown[: push.count]):
        every = [True] * len(eqn.outvars)
        return None, eqn, every, every, needed
    # Results are computed now without tangents, since rates are unknown. The later program has the
    # whole operation, and computes the results again.
    known = eqn.replace(
        invars=eqn.invars[: push.count],
        outvars=eqn.outvars[:split],
        params={**eqn.params, "push": still, "program": still.program},
    )
    late = [k >= split for k in range(len(eqn.outvars))]
    return known, eqn, late, [True] * len(late), needed


pushforward_p.def_impl(lambda *args, **params: jax.jit(ft.partial(_forward, **params))(*args))
pushforward_p.def_effectful_abstract_eval(_abstract)
ad.primitive_jvps[pushforward_p] = _jvp
batching.primitive_batchers[pushforward_p] = _batch
mlir.register_lowering(pushforward_p, mlir.lower_fun(_forward, multiple_results=True))
pe.custom_partial_eval_rules[pushforward_p] = _partial_eval
pe.partial_eval_jaxpr_custom_rules[pushforward_p] = _partial_eval_of_eqn
