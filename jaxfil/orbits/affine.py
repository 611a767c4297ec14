"""First-order models of functions of some unknowns, in one form for all unknowns.

A program of an `Affine` does not depend on which unknowns vary (a parameter, a period, or no
unknown), and is compiled once for all of them.
"""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_Tree = TypeVar("_Tree")


class Affine(eqx.Module, Generic[_Tree]):
    """A tree as a function of W numbers s: value + Σ s_i slope_i."""

    value: _Tree
    slopes: _Tree
    """The derivatives of its float leaves, with a leading axis of W; None for any other leaf."""

    @property
    def width(self) -> int:
        """The number W of unknowns."""
        return jax.tree.leaves(self.slopes)[0].shape[0]

    def __call__(self, s: Float[Array, " W"]) -> _Tree:
        moving, still = eqx.partition(self.value, eqx.is_inexact_array)

        def moved(v: _Tree, row: tuple[Array, _Tree]) -> tuple[_Tree, None]:
            # Not a matrix product, which would end a kernel.
            return jax.tree.map(lambda v, slope: v + row[0] * slope, v, row[1]), None

        return eqx.combine(jax.lax.scan(moved, moving, (s, self.slopes))[0], still)


def affine(
    function: Callable[[Array], _Tree], u: Float[Array, " N"], width: int, first: Array | int = 0
) -> Affine[_Tree]:
    """A function near u, as its unknowns number `first`, `first` + 1, … vary, `width` of them;
    missing unknowns have slopes of zero."""
    value = jax.tree.map(_typed, function(u))
    slopes = jax.jacfwd(lambda u: eqx.filter(function(u), eqx.is_inexact_array))(u)

    def rows(v: Array) -> Array:
        v = _typed(jnp.moveaxis(v, -1, 0))
        v = jnp.concatenate([v, jnp.zeros((width, *v.shape[1:]), v.dtype)])
        return jax.lax.dynamic_slice_in_dim(v, first, width)

    return Affine(value, jax.tree.map(rows, slopes))


def _typed(v: Any) -> Any:
    """A number whose type is not weak, because weak types would compile another program."""
    return jax.lax.convert_element_type(v, v.dtype) if eqx.is_inexact_array(v) else v
