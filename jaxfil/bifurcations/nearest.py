"""`nearest_grazing`: the grazing parameters nearest to the parameters of a system.

Newton's method solves for the orbit, its tangency, the parameters and the Lagrange multipliers
together.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from jaxfil.bifurcations.candidates import Guess, attempts, guesses
from jaxfil.bifurcations.defining_system import defining_system
from jaxfil.bifurcations.locate import Bifurcation, bifurcation_at, first_order, lane_by_lane
from jaxfil.bifurcations.optimality import Nearest
from jaxfil.bifurcations.tangency import FAMILY_NAMES, FLIGHT, Tangency
from jaxfil.model import check
from jaxfil.model.card import outcome, precision
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import cast, get_parameter, scalar_parameters
from jaxfil.model.system import System
from jaxfil.orbits.implicit import solve_implicit
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.known import array_of, is_known, part_of, without_derivatives
from jaxfil.xla.select import select

_NEWTON_STEPS = 40


class NearestGrazing(eqx.Module):
    """The nearest grazing parameters, for each orbit of a batch."""

    values: Float[Array, " k"]
    """The parameters; NaN without a start."""
    distance: Float[Array, ""]
    """Their distance from the parameters of the system, in the metric."""
    given: Float[Array, " k"]
    """The parameters of the system, from which the distance is measured."""
    bifurcation: Bifurcation
    """The grazing bifurcation: the orbit, time, state and surface of its tangency, and its kind.
    `continue_bifurcation` continues from it."""
    num_steps: Int[Array, ""]
    """Number of evaluations by Newton's method."""
    result: RESULTS
    """The outcome of the search."""
    parameters: tuple[str, ...] = eqx.field(static=True)
    """The names of the parameters."""

    @property
    def nearest(self) -> "NearestGrazing":
        """The nearest successful lane of a batch."""
        if not self.distance.ndim:
            return self
        fine = self.result == RESULTS.successful
        best = int(jnp.argmin(select(fine, self.distance, jnp.inf)))
        return part_of(self, best)

    def __repr__(self) -> str:
        told = precision(self.values)
        if isinstance(self.distance, jax.core.Tracer) or self.distance.ndim:
            names = ", ".join(self.parameters)
            return f"NearestGrazing{told}: a batch of shape {self.distance.shape} in {names}"
        lines = [f"NearestGrazing{told}: distance {float(self.distance):.10g}"]
        lines[0] += f" after {int(self.num_steps)} Newton steps, {outcome(self.result)}"
        for name, value, given in zip(self.parameters, self.values, self.given, strict=True):
            lines.append(f"  {name} = {float(value):.13g}, given {float(given):.10g}")
        return "\n".join([*lines, *(f"  {line}" for line in repr(self.bifurcation).split("\n"))])


def nearest_grazing(
    system: System,
    parameters: Sequence[str],
    orbit: Orbit,
    *,
    metric: Any = None,
    throw: bool = True,
) -> NearestGrazing:
    """Find the grazing parameters nearest to the parameters of a system.

        minimise (p − p₀)ᵀ G (p − p₀)   subject to   x(t0 + T; x0) = x0,  H = Ḣ_s = 0

    p₀ are the system's own parameters. Newton's method solves the Lagrange equations for the orbit,
    the phase of its tangency, p and the multipliers together, with derivatives that are exact
    through every contact. Grazing is a constraint that holds to rounding, not a penalty.

    **Arguments**

    - `system`: the `System`.
    - `parameters`: the names of k different scalar parameters; all others are constant.
    - `orbit`: a periodic orbit of `system`, at its parameters or others close by, to start from.
      Every approach of it to a surface is tried, and the nearest grazing returned; for a batch (as
      from `equinox.filter_vmap`) one for each orbit. It must not be traced.
    - `metric`: G, a symmetric positive definite matrix, shape (k, k), or its diagonal, shape (k,);
      None is diag(1/p₀²), which measures relative changes (absolute ones for a parameter of zero).
    - `throw`: whether to raise an error unless the outcome is `successful`.

    **Returns** a `NearestGrazing`; for a batch its `nearest` is the nearest lane. The derivatives
    of `values` and `distance` with respect to the float leaves of the system, including p₀, follow
    from the implicit function theorem, forward and reverse.

    **Outcomes**: `successful`; `no_tangency_found` if the orbit itself failed or comes near no
    surface; `orbit_lost` where the orbit has a contact elsewhere; `not_nearest` where the distance
    has no minimum; `newton_stalled`, `newton_singular` or `newton_max_steps_reached` where there is
    perhaps no grazing; and where the flow cannot be followed from the guess, `nonfinite`,
    `max_steps_reached`, `mode_undecided`, `zeno`, `nonunique`, `reset_undecided`,
    `undeclared_sliding` or `step_too_long`.

    **Source**: the equations of grazing: M. di Bernardo, C. Budd, A. Champneys, P. Kowalczyk,
    Piecewise-smooth Dynamical Systems (2008), chapter 8; the nearest critical point as a closest
    point of a curve or surface: I. Dobson, Computing a closest bifurcation instability in
    multidimensional parameter space, J. Nonlinear Science 3 (1993) 307–327.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> system = jf.systems.ImpactOscillator(amplitude=0.3, omega=1.2)
    >>> orbit = jf.periodic_orbit(system, jnp.array([0.5, 0.5]))
    >>> found = jf.nearest_grazing(system, ("amplitude", "omega", "wall"), orbit)
    >>> print(found.bifurcation.kind, round(float(found.distance), 4))
    grazing 0.0572
    >>> [round(float(v), 4) for v in found.values]
    [0.302, 1.1323, 0.9933]
    """
    check.system("system", system)
    names = scalar_parameters(system, parameters)
    check.flags(throw=throw)
    check.instance("orbit", orbit, Orbit)
    system = cast(system, orbit.x0.dtype)
    matrix = _matrix(metric, len(names), orbit.x0.dtype)

    def search(system_of: Callable[[Orbit], System], most: int) -> Callable:
        def one(orbit: Orbit, tangency: Tangency, missing: Array) -> tuple[NearestGrazing, Array]:
            guess = orbit, tangency, missing
            return _find(system_of(orbit), names, matrix, array_of(most), *guess)

        return one if orbit.x0.ndim == 1 else eqx.filter_vmap(one)

    # Candidates are compared on the known orbit, also while the system is traced.
    known = without_derivatives(system)
    first = search(lambda orbit: known if is_known(known) else orbit.system, 1)
    kinds = "grazing", "grazing-sliding"
    every = guesses(orbit, *kinds, away=lambda *guess: first(*guess)[1])
    found = _nearest_found(orbit, every, search(lambda _: system, _NEWTON_STEPS))
    if not throw:
        return found
    return raise_if_failed(found, found.result)


def _nearest_found(orbit: Orbit, lanes: list[list[Guess]], search: Callable) -> NearestGrazing:
    """The nearest result from all candidates of each lane."""
    found = None
    for guess in attempts(orbit, lanes):
        now, _ = search(orbit, guess.tangency, guess.missing)
        found = now if found is None else lane_by_lane(_is_nearer(now, found), now, found)
    assert found is not None
    return found


def _is_nearer(a: NearestGrazing, b: NearestGrazing) -> Array:
    fine, other = a.result == RESULTS.successful, b.result == RESULTS.successful
    return fine & (~other | (a.distance < b.distance))


def _matrix(metric: Any, k: int, dtype: DTypeLike) -> Array | None:
    """G as a matrix, or None."""
    if metric is None:
        return None
    must = f"a symmetric positive definite matrix of shape ({k}, {k}), or its diagonal"
    matrix = check.numbers("metric", metric, dtype, must)
    matrix = jnp.diag(matrix) if matrix.ndim == 1 else matrix
    known = check.concrete(matrix)
    sound = matrix.shape == (k, k)
    if sound and known is not None:
        symmetric = np.allclose(known, known.T, rtol=float(16 * jnp.finfo(dtype).eps), atol=0)
        sound = symmetric and np.all(np.linalg.eigvalsh(known) > 0)
    if not sound:
        raise ValueError(f"`metric` must be {must}, got {check.told(metric)}.")
    return matrix


@eqx.filter_jit
def _find(
    system: System,
    names: tuple[str, ...],
    metric: Array | None,
    newton_steps: Array,
    orbit: Orbit,
    tangency: Tangency,
    missing: Array,
) -> tuple[NearestGrazing, Array]:
    """The nearest grazing from a candidate, and the distance after one more step of Newton's
    method."""
    defining = defining_system(system, orbit, tangency, FLIGHT, names, newton_steps)
    equations = Nearest(defining, metric)
    dtype, n = tangency.starts.dtype, tangency.starts.size
    start = [jnp.asarray(get_parameter(orbit.system, name), dtype) for name in names]
    u = defining.unknowns(orbit, start)
    w, root = solve_implicit(equations, system, jnp.append(u, jnp.zeros(n + 2, dtype)))
    u, values = w[: u.shape[0]], w[n + 1 : u.shape[0]]
    there = eqx.tree_at(lambda r: r.at, root, root.at.aux.defining)
    fields = bifurcation_at(defining, system, orbit, u, there)
    bifurcation = Bifurcation(**fields, parameter=names[0], family=FAMILY_NAMES[FLIGHT])
    result = RESULTS.where(root.at.aux.convex, RESULTS.successful, RESULTS.not_nearest)
    located = bifurcation.result == RESULTS.successful
    result = RESULTS.where(located, result, bifurcation.result)
    result = RESULTS.where(missing, RESULTS.no_tangency_found, result)
    nan = jnp.full_like(values, jnp.nan)
    ahead = equations.distance(system, (w + root.step)[n + 1 : u.shape[0]])
    found = NearestGrazing(
        values=select(missing, nan, values),
        distance=select(missing, nan[0], equations.distance(system, values)),
        given=jnp.stack([jnp.asarray(get_parameter(system, name)) for name in names]),
        bifurcation=bifurcation,
        num_steps=root.num_steps,
        result=result,
        parameters=names,
    )
    return found, first_order(root, ahead)
