"""`grazing_margin`: the distance of an orbit from a surface, as a function of all parameters.

It is positive while the orbit stays clear of the surface and zero where it grazes.
"""

from typing import Literal, overload

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfil.bifurcations.candidates import Guess, approaches
from jaxfil.bifurcations.closure import Closing
from jaxfil.bifurcations.defining_system import DefiningSystem, defining_system
from jaxfil.bifurcations.tangency import FLIGHT, Tangency, conditions
from jaxfil.integrate.run.solution import switches
from jaxfil.integrate.system.closed_over import with_closed_numbers
from jaxfil.model import check
from jaxfil.model.card import outcome, precision
from jaxfil.model.outcomes import RESULTS, is_successful, raise_if_failed
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.orbits.implicit import Equations, SystemOf, solve_implicit
from jaxfil.orbits.newton import Evaluation, Root
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.select import select

_NEWTON_STEPS = 40


class GrazingMargin(eqx.Module):
    """The distance of an orbit from grazing, with its outcome."""

    value: Float[Array, ""]
    """The margin, in the unit of H; NaN after a failure."""
    result: RESULTS
    """The outcome of the search."""

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
    """Measure the distance of an orbit from grazing, as a function of all parameters.

        margin = min_t s H(t, x(t)) on the flight that comes closest to grazing from side s

    The flight is followed as if the surface were not there, so that the margin continues smoothly
    through zero to negative values, where the orbit would cut the surface. For an orbit that hits
    the surface this is the orbit without that contact, if it exists, or, of a reset that is not the
    identity where H = Ḣ = 0, such as a spike, the orbit with the reset at the minimum.

    **Arguments**

    - `system`: the `System`; the margin is differentiable with respect to each of its float leaves,
      forward and reverse, twice, under `jit` and `vmap`.
    - `orbit`: an orbit of `system` at parameters close by, which selects the flight and starts
      Newton's method. It must not be traced.
    - `throw`: whether to raise an error unless the outcome is `successful`.

    **Returns** the margin, an array of shape (), or with `throw=False` a `GrazingMargin`, which has
    the outcome of each lane of a batch.

    **Outcomes**: `successful`; `no_tangency_found` if the given orbit itself failed, no flight of
    it approaches a surface, H has no minimum on its flights, or its least one is at a tick of a
    clock or a contact with another surface, where the state or the field jumps; `orbit_lost` where
    the flight meets another surface, or its ends are beyond this one; `newton_stalled`,
    `newton_singular` or `newton_max_steps_reached` if the system has perhaps no orbit near it; and
    where the flow cannot be followed from the guess, `nonfinite`, `max_steps_reached`,
    `mode_undecided`, `zeno`, `nonunique`, `reset_undecided`, `undeclared_sliding` or
    `step_too_long`.

    **Source**: the implicit function theorem (textbook) applied to the defining system of grazing,
    as in `find_bifurcation`.

    >>> import jax, jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> system = jf.systems.SDOscillator(omega=0.8)
    >>> orbit = jf.periodic_orbit(system, jnp.array([1.7, 0.0]))
    >>> slope = jax.grad(lambda s: jf.grazing_margin(s, orbit))(system)
    >>> print(round(float(jf.grazing_margin(system, orbit)), 6), round(float(slope.f0), 4))
    0.306915 -2.7723
    """
    check.system("system", system)
    check.flags(throw=throw)
    if not isinstance(orbit, Orbit) or orbit.x0.ndim != 1:
        raise ValueError(f"`orbit` must be a single Orbit, got {check.told(orbit)}.")
    system = with_closed_numbers(cast(system, orbit.x0.dtype), orbit.x0)
    found = _margin_at(system, orbit, _nearest(orbit))
    return raise_if_failed(found.value, found.result) if throw else found


def _nearest(orbit: Orbit) -> Guess:
    """The nearest candidate for a margin. From a contact with the surface the search may end at a
    maximum of the guard."""
    nearest = approaches(orbit)
    if switches(orbit.events).size:
        # Decided on the concrete orbit, also while the system is traced.
        with jax.core.eval_context():
            for guess in nearest:
                found = _margin_at(orbit.system, orbit, guess)
                if is_successful(found.result):
                    return guess
    return nearest[0]


def _margin_at(system: System, orbit: Orbit, guess: Guess) -> GrazingMargin:
    """The margin from a candidate."""
    equations, start = _first_guess(orbit, guess.tangency)
    z, root = solve_implicit(equations, system, start)
    closing: Closing
    _, _, closing = root.at.aux  # see `_without_height`
    there = conditions(system, closing.t, closing.x, guess.tangency)
    return _margin_of(z, root, guess.missing, there.bend, closing.passes)


@eqx.filter_jit
def _first_guess(orbit: Orbit, tangency: Tangency) -> tuple["_Margin", Array]:
    """The equations and a guess of their unknowns. They do not contain the system itself, which may
    be traced."""
    equations = defining_system(orbit.system, orbit, tangency, FLIGHT, (), _NEWTON_STEPS)
    return _Margin(equations), equations.unknowns(orbit, [])


@jax.jit
def _margin_of(z: Array, root: Root, missing: Array, bend: Array, passes: Array) -> GrazingMargin:
    """The margin of a solution, if the guard has a minimum there, and the flight is one of the
    system apart from its passage through the surface."""
    is_minimum = bend > 0
    found = root.result == RESULTS.successful
    result = RESULTS.where(found & ~passes, RESULTS.orbit_lost, root.result)
    none = missing | (found & ~is_minimum)
    result = RESULTS.where(none, RESULTS.no_tangency_found, result)
    return GrazingMargin(select(is_minimum & passes, z[-1], jnp.nan), result)


class _Margin(Equations):
    """The orbit closes and Ḣ = 0 at the minimum of the guard. Its value, the margin, is one more
    unknown, with the equation H − margin = 0."""

    tangency: DefiningSystem

    def solve(self, system: System, guess: Array) -> tuple[Array, Array, Root]:
        """Newton's iteration on the orbit alone, which then determines the margin."""
        root = self.tangency.root(system, guess, _without_height)
        return *_with_margin(root), root

    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """The rows of closure, H and Ḣ."""
        return self.tangency.by_parameters(system_of, theta, z[:-1])

    def by_unknowns(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """The same, with the column of the margin."""
        by_z = self.tangency.by_unknowns(system_of, theta, z[:-1])
        return jnp.concatenate([by_z, _by_margin(by_z)], axis=1)


def _without_height(at: Evaluation, z: Array) -> Evaluation:
    """The equations without H = 0. The further data has the value of H, which is the margin at a
    root, the derivative of all equations, and the further data of these."""
    n = at.residual.shape[0] - 2  # the row of H, before that of Ḣ

    def kept(v: Array) -> Array:
        return jnp.concatenate([v[:n], v[n + 1 :]])

    return Evaluation(
        kept(at.residual),
        kept(at.jacobian),
        kept(at.equation_scale),
        at.unknown_scale,
        at.result,
        (at.residual[n], at.jacobian, at.aux),
    )


@jax.jit
def _with_margin(root: Root) -> tuple[Array, Array]:
    """All unknowns at a root, and the derivative of all equations there."""
    # Without an orbit the last guard has no meaning.
    margin, jacobian, _ = root.at.aux
    margin = select(root.result == RESULTS.successful, margin, jnp.nan)
    return jnp.append(root.z, margin), jnp.concatenate([jacobian, _by_margin(jacobian)], axis=1)


def _by_margin(jacobian: Array) -> Array:
    """The derivative of the equations by the margin, in the row of H."""
    return jnp.zeros_like(jacobian[:, :1]).at[-2].set(-1)
