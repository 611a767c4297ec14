"""Products of matrices without library calls, which a kernel cannot contain.

Small products are written out; others are replaced by sums. Outside kernels products remain library
calls, which are faster for many lanes.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.xla.program import replaced

SHORT = 4095
"""The largest number of terms that XLA sums, or takes an extremum of, without a library call."""

# The largest numbers of multiplications in a product that is written out, and in a kernel.
_SMALL, _MIDDLE = 64, 1 << 16
# Numbers of columns that may be summed at a time.
_WIDTHS = range(8, 0, -1)


def is_small(eqn: Any) -> bool:
    """Whether a product is small enough to be written out."""
    batch = any(eqn.params["dimension_numbers"][1])
    return not batch and _multiplications(eqn) <= _SMALL


def is_middling(eqn: Any) -> bool:
    """Whether a product is small enough to be replaced by sums."""
    return _multiplications(eqn) <= _MIDDLE


def _multiplications(eqn: Any) -> float:
    """The number of multiplications of a product of real matrices; inf for other products."""
    (contracted, _), _ = eqn.params["dimension_numbers"]
    a, out = eqn.invars[0].aval, eqn.outvars[0].aval
    count = out.size * np.prod([a.shape[k] for k in contracted])
    kinds = {v.aval.dtype for v in (*eqn.invars, *eqn.outvars)}
    return float("inf") if kinds != {out.dtype} or out.dtype.kind != "f" else float(count)


def written_out(eqn: Any, a: Array, b: Array) -> Array:
    """A product of small matrices number by number; in a batch XLA would call a library for it."""
    (rows,), (columns,) = matrices_of(eqn, a, b)
    terms = [
        [sum(u * v for u, v in zip(row, column, strict=True)) for column in columns] for row in rows
    ]
    return jnp.array(terms, a.dtype).reshape(eqn.outvars[0].aval.shape)


def matrices_of(eqn: Any, a: Any, b: Any) -> tuple[Any, Any]:
    """The operands of a product, arrays of JAX or NumPy, as batches of matrices, whose columns are
    summed over."""

    def matrices(v: Any, summed: tuple[int, ...], batch: tuple[int, ...]) -> Any:
        free = [k for k in range(v.ndim) if k not in summed and k not in batch]
        sizes = [math.prod(v.shape[k] for k in axes) for axes in (batch, free, summed)]
        return v.transpose(*batch, *free, *summed).reshape(sizes)

    summed, batch = eqn.params["dimension_numbers"]
    return matrices(a, summed[0], batch[0]), matrices(b, summed[1], batch[1])


def by_sums(program: Any) -> Any:
    """A closed program with its products replaced by sums."""
    return replaced(program, "dot_general", _summed)


def _summed(eqn: Any, a: Array, b: Array) -> Array:
    rows, columns = matrices_of(eqn, a, b)
    summed = rows.shape[-1]
    each = math.prod(eqn.outvars[0].aval.shape)

    def product(some: Array, others: Array) -> Array:
        terms = some[:, :, None] * others[:, None]
        return terms[..., 0] if terms.shape[-1] == 1 else jnp.sum(terms, axis=-1)

    if each * summed <= SHORT:
        out = product(rows, columns)
    else:  # in chunks of columns, since a sum of a whole row is not vectorised
        # A width of 1 divides every number of columns, so that one is always available.
        width = next(k for k in _WIDTHS if summed % k == 0 and each * k <= max(each, SHORT))
        zero = jnp.zeros((*rows.shape[:2], columns.shape[1]), a.dtype)

        def add(k: Array, out: Array) -> Array:
            some, others = (
                jax.lax.dynamic_slice_in_dim(v, k * width, width, -1) for v in (rows, columns)
            )
            return out + product(some, others)

        out = jax.lax.fori_loop(0, summed // width, add, zero)
    return out.reshape(eqn.outvars[0].aval.shape)
