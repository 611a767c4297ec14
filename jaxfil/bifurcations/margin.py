"""`grazing_margin`: how far an orbit stays from a surface, as a function of all parameters.

A system and an orbit close to its own enter; a number leaves, positive while the orbit stays clear
of the surface and zero where it grazes, with derivatives with respect to every parameter.
"""

from typing import Literal, overload

import equinox as eqx
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfil.bifurcations.candidates import guesses
from jaxfil.bifurcations.defining_system import DefiningSystem, defining_system
from jaxfil.model import check
from jaxfil.model.card import outcome, precision
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.orbits.implicit import Equations, SystemOf, solve_implicit
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.orbits.orbit import Orbit

_NEWTON_STEPS = 40


class GrazingMargin(eqx.Module):
    """How far an orbit stays from grazing, and whether that was found."""

    value: Float[Array, ""]
    result: RESULTS

    def __repr__(self) -> str:
        told = precision(self.value)
        if isinstance(self.value, jax.core.Tracer) or self.value.ndim:
            return f"GrazingMargin{told}: a batch of shape {self.value.shape}"
        return f"GrazingMargin{told}: {outcome(self.result)}\n  margin {float(self.value):.12g}"


@overload
def grazing_margin(
    system: System, orbit: Orbit, *, throw: Literal[True] = True
) -> Float[Array, ""]: ...


@overload
def grazing_margin(system: System, orbit: Orbit, *, throw: Literal[False]) -> GrazingMargin: ...


def grazing_margin(
    system: System, orbit: Orbit, *, throw: bool = True
) -> Float[Array, ""] | GrazingMargin:
    """The smallest |H| of the flight on which `orbit` comes closest to grazing, signed.

    The flight is followed as if the surface were not there, so that the margin goes on smoothly
    through zero into negative values, where the orbit would cut the surface. `orbit` is one of
    `system` at parameters close by: it says which flight is meant, and is where Newton's method
    starts. NaN where that finds no orbit, or where no flight approaches a surface.

    Differentiable with respect to every float leaf of `system`, forward and reverse; `jit` and
    `vmap` over the system work.

    >>> import jax, jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system = jf.systems.SDOscillator(omega=0.8)
    >>> orbit = jf.periodic_orbit(system, jnp.array([1.7, 0.0]))
    >>> slope = jax.grad(lambda s: jf.grazing_margin(s, orbit))(system)
    >>> print(round(float(jf.grazing_margin(system, orbit)), 6), round(float(slope.f0), 4))
    0.306915 -2.7723
    """
    check.system("system", system)
    if not isinstance(orbit, Orbit) or orbit.x0.ndim != 1:
        raise ValueError(f"`orbit` must be a single Orbit, got {orbit!r}.")
    tangency, missing = guesses(orbit, "grazing")[0][0]
    system = cast(system, orbit.x0.dtype)
    equations = _Margin(defining_system(system, orbit, tangency, "flight", (), _NEWTON_STEPS))
    phase = orbit.period if system.period is None else tangency.phase
    z, root = solve_implicit(equations, system, jnp.append(tangency.x, phase))
    result = RESULTS.where(missing, RESULTS.no_tangency_found, root.result)
    if not throw:
        return GrazingMargin(z[-1], result)
    return result.error_if(z[-1], result != RESULTS.successful)


class _Margin(Equations):
    """The orbit closes and Ḣ = 0: where the guard is smallest. What it is there, the margin, is one
    unknown more, with the equation H − margin = 0."""

    tangency: DefiningSystem

    def solve(self, system: System, guess: Array) -> tuple[Array, Array, Root]:
        """Newton's iteration on the orbit alone; the margin then is known."""
        n = guess.shape[0] - 1
        keep = jnp.array([*range(n), n + 1])

        def evaluate(z: Array) -> Evaluation:
            at = self.tangency.evaluate(system, z)
            return Evaluation(
                at.residual[keep],
                at.jacobian[keep],
                at.equation_scale[keep],
                at.unknown_scale,
                at.result,
                (at.residual[n], at.jacobian),
            )

        root = newton(evaluate, guess, _NEWTON_STEPS)
        margin, jacobian = root.at.aux
        margin = jnp.where(root.result == RESULTS.successful, margin, jnp.nan)
        by_margin = jnp.zeros((n + 2, 1), guess.dtype).at[n].set(-1)
        return jnp.append(root.z, margin), jnp.concatenate([jacobian, by_margin], axis=1), root

    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """The rows of closing, H and Ḣ."""
        return self.tangency.by_parameters(system_of, theta, z[:-1])
