"""The test whether a program fits into a single kernel.

It examines the operations of a program before compilation.
"""

from typing import Any

from jaxfil.xla.compiler import makes_whole_kernels
from jaxfil.xla.matrix_product import SHORT, is_middling
from jaxfil.xla.program import programs

# Operations that a single kernel supports, for one or more lanes, including forward derivatives,
# which add no other kinds: arithmetic, control flow, shapes. Operations that XLA refuses are
# excluded: scatters, sorts, and library calls, which a product of matrices may become. (A `psum`
# over the axis of a batch is a sum over an axis of an array at this point; a `device_put`, which
# older versions of JAX create for an array of constants, is a no-op.)
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

_WRITING = FITTING | {"dynamic_update_slice"}

LARGE = 8192
"""Size in bytes above which XLA treats a constant array as a buffer of its own. It is a little less
than XLA's limit, which is measured differently."""

_REDUCTIONS = ("reduce_sum", "reduce_max", "reduce_min")


def fits(jaxpr: Any) -> bool:
    """Whether all operations of a program fit into a single kernel, and XLA compiles such
    kernels."""
    return makes_whole_kernels() and _all_fit(jaxpr)


def _all_fit(jaxpr: Any, names: frozenset[str] = FITTING) -> bool:
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name == "custom_vmap_call":
            # Its batch rule is unknown. The one of `masked_write`, which alone may write, fits.
            if not all(_all_fit(v, _WRITING) for v in programs(eqn.params)):
                return False
            continue
        if name == "dot_general" and is_middling(eqn):  # replaced by sums in `kernel`
            continue
        if name not in names or not all(_all_fit(v, names) for v in programs(eqn.params)):
            return False
        # A longer reduction becomes a library call.
        if name in _REDUCTIONS and eqn.invars[0].aval.size > SHORT:
            return False
    return True
