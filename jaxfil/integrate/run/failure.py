"""The error of an unsuccessful run, with the sentence of its outcome, and the time, the state and
the surfaces where it stopped.
"""

import jax
import jax.numpy as jnp
import numpy as np
from equinox import EquinoxRuntimeError
from jaxtyping import Array

from jaxfil.integrate.run.solution import Solution
from jaxfil.model.outcomes import RESULTS, code, raise_outcome
from jaxfil.model.system import System, field_of
from jaxfil.xla.jumps import jumps_of
from jaxfil.xla.known import is_known


def raise_unless_successful(sol: Solution, system: System, x0: Array) -> Solution:
    """The same solution, or an error with the sentence of its outcome. Outside `jit` it also says
    where the run from x0 stopped."""
    if not is_known((sol, system, x0)):
        # The error of a traced run is part of the program, and its sentence a constant.
        return raise_outcome(sol, sol.result, RESULTS.successful, RESULTS.section_reached)
    # Compared as Python numbers, since a comparison of arrays would compile a program.
    if code(sol.result) in (code(RESULTS.successful), code(RESULTS.section_reached)):
        return sol
    told = f"{RESULTS[sol.result]} It stopped at {_place(sol, system, x0)}."
    # Across a jump that is not declared as a surface, steps of any length may be too long.
    if code(sol.result) == code(RESULTS.step_too_long):
        told += _jumps(system, sol)
    raise EquinoxRuntimeError(told)


def _jumps(system: System, sol: Solution) -> str:
    """A sentence on operations in the vector field that jump without a surface; empty without
    any."""
    side = jnp.ones(np.shape(sol.mode_final), sol.x_final.dtype)
    # A scalar H has a scalar side.
    if np.ndim(system.switching(sol.t_final, sol.x_final)) == 0:
        side = side[0]
    found = jumps_of(lambda x: field_of(system, sol.t_final, x, side), sol.x_final)
    if not found:
        return ""
    names = " and ".join(f"`{name}`" for name in found)
    return f" Its vector field jumps by {names} of the state; let `switching` vanish there."


def _place(sol: Solution, system: System, x0: Array) -> str:
    """Time, state and surfaces at the end of a run."""
    state = np.array2string(
        np.asarray(sol.x_final), precision=6, separator=", ", max_line_width=10**6
    )
    told = f"t = {float(sol.t_final):.10g}, x = {state}"
    size = jnp.maximum(abs(x0), abs(sol.x_final))
    # A surface slid or rested on counts too, even if H is not within rounding.
    met = _surfaces(system, sol.t_final, sol.x_final, size) | (np.abs(sol.mode_final) != 1)
    if not met.any():
        return told
    numbers = ", ".join(map(str, np.flatnonzero(met)))
    return f"{told}, on surface{'s' if met.sum() > 1 else ''} {numbers}"


def _surfaces(system: System, t: Array, x: Array, size: Array) -> np.ndarray:
    """The surfaces that a state is on, up to the square root of the rounding of states of that
    size, shape (m,)."""

    def switching(t: Array, x: Array) -> Array:
        return jnp.atleast_1d(system.switching(t, x))

    h = switching(t, x)
    by_t, by_x = jax.jacfwd(switching, (0, 1))(t, x)
    noise = jnp.sqrt(jnp.finfo(x.dtype).eps) * (abs(by_t * t) + abs(by_x) @ size)
    return np.asarray(abs(h) <= noise)
