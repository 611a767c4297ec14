"""What fits into a single kernel.

A program enters; whether XLA's CPU backend can compile all of it into one kernel leaves, known from
its operations before it is compiled.
"""

from typing import Any

from jaxfil.xla.compiler import makes_whole_kernels
from jaxfil.xla.matrix_product import SHORT, is_middling
from jaxfil.xla.program import programs

# What a single kernel can hold, alone, as a few lanes and with forward derivatives, none of which
# add anything that is not here: arithmetic, control flow, shapes. Left out is what XLA refuses:
# scatters, sorts, and calls of libraries, which a product of matrices may become. (A `psum` over
# the axis of a batch has become a sum over an axis of an array by then; a `device_put`, which older
# versions of JAX make of an array of constants, nothing at all.)
_NAMES = """
abs acos acosh add add_any and argmax argmin asin asinh atan atan2 atanh bitcast_convert_type
broadcast_in_dim cbrt ceil clamp concatenate cond convert_element_type copy copy_p cos cosh
custom_jvp_call device_put div dynamic_slice empty2 eq erf erf_inv erfc exp exp2 expm1 floor gather
ge gt integer_pow iota is_finite jit le log log1p log2 logistic lt max min mul ne neg nextafter not
one_minus_square optimization_barrier or pad pjit pow psum pushforward reduce_and reduce_max
reduce_min reduce_or reduce_precision reduce_prod reduce_sum rem reshape rev round rsqrt scan
select_n shift_left sign sin sinh slice split sqrt square squeeze stack stop_gradient sub tan tanh
tile transpose unstack unvmap_any vanishing_map while xor
"""
FITTING = frozenset(_NAMES.split())
"""Names of operations that fit."""

LARGE = 8192
"""Bytes of an array from which on XLA treats a constant as a buffer of its own: a little less, for
it has its own measure."""

_REDUCTIONS = ("reduce_sum", "reduce_max", "reduce_min")


def fits(jaxpr: Any) -> bool:
    """Whether all operations of a program fit into a single kernel, and XLA makes such kernels."""
    return makes_whole_kernels() and _all_fit(jaxpr)


def _all_fit(jaxpr: Any) -> bool:
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name == "custom_vmap_call":  # that of `masked_write`, which knows what to be in a batch
            continue
        if name == "dot_general" and is_middling(eqn):  # of sums: see `kernel`
            continue
        if name not in FITTING or not all(map(_all_fit, programs(eqn.params))):
            return False
        if name in _REDUCTIONS and eqn.invars[0].aval.size > SHORT:
            return False
    return True
