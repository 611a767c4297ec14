"""`find_bifurcation`: the parameter value at which an orbit becomes tangent to a surface.

Newton's method solves for the orbit, the phase of the tangency and the parameter together, without
the square root of the period map at grazing.

Kinds and conditions: M. di Bernardo, C. Budd, A. Champneys, P. Kowalczyk, Piecewise-smooth
Dynamical Systems (2008), chapter 8, with time as a state.
"""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfil.bifurcations.candidates import Guess, attempts, guesses
from jaxfil.bifurcations.closure import Closing
from jaxfil.bifurcations.defining_system import DefiningSystem, Placed, defining_system
from jaxfil.bifurcations.tangency import (
    FAMILIES,
    FAMILY_NAMES,
    Conditions,
    Tangency,
    conditions,
    kind_of,
)
from jaxfil.model import check
from jaxfil.model.card import outcome, precision
from jaxfil.model.outcomes import RESULTS, is_successful, raise_if_failed
from jaxfil.model.parameter import cast, get_parameter, scalar_parameter
from jaxfil.model.system import System
from jaxfil.orbits.implicit import solve_implicit
from jaxfil.orbits.newton import Root
from jaxfil.orbits.orbit import Orbit
from jaxfil.xla.kernel import tree_in_kernel
from jaxfil.xla.known import array_of, compiled_if_traced, is_known, without_derivatives
from jaxfil.xla.select import select

_Result = TypeVar("_Result", bound=eqx.Module)

BIFURCATION_KINDS = tuple(FAMILIES)
"""The kinds of bifurcation that `find_bifurcation` locates, in the order of `Bifurcation.code`.

- `"grazing"`: the orbit is tangent to a surface from one side, without a sliding region there; also
  an impact on a wall at zero velocity.
- `"grazing-sliding"`: it is tangent at a sliding region; beyond, a piece of the orbit slides.
- `"adding-sliding"`: a sliding piece is tangent to the end of the sliding region; beyond, it leaves
  the surface for a while and returns.
- `"crossing-sliding"`: the orbit arrives on the surface at the end of the sliding region, where the
  field leaves it; beyond, it slides before it crosses.
- `"switching-sliding"`: it arrives there, where the field returns to the surface; beyond, it
  crosses before it slides.
"""


class Bifurcation(eqx.Module):
    """A located grazing or sliding bifurcation of a periodic orbit."""

    value: Float[Array, ""]
    """The parameter value; NaN without a start."""
    orbit: Orbit
    """The orbit at this value. It starts at or before the start of the flight around the tangency.
    Its `events` are the contacts of the given orbit; those at the tangency itself would depend on
    rounding."""
    t: Float[Array, ""]
    """The time of the tangency."""
    x: Float[Array, " n"]
    """The state at time `t`."""
    code: Int[Array, ""]
    """The number of its kind in `BIFURCATION_KINDS`; −1 if the conditions fit no kind, or
    if the search has failed."""
    conditions: Conditions
    """The conditions that define the kind."""
    residual: Float[Array, ""]
    """The largest scaled residual of the defining system."""
    result: RESULTS
    """The outcome of the search."""
    tangency: Tangency
    """The tangency, in the form for continuation."""
    parameter: str = eqx.field(static=True)
    """The name of the parameter."""
    family: str = eqx.field(static=True)
    """The equations that define it: "flight", "slide" or "arrival"."""

    @property
    def kind(self) -> str | np.ndarray:
        """The name of the kind, determined by the conditions; an array of names for a batch."""
        names = np.array([*BIFURCATION_KINDS, "undecided"])[np.asarray(self.code)]
        return str(names) if names.ndim == 0 else names

    def __repr__(self) -> str:
        told = precision(self.x)
        if isinstance(self.value, jax.core.Tracer) or self.value.ndim:
            return f"Bifurcation{told}: a batch of shape {self.value.shape} in {self.parameter}"
        c, show = self.conditions, ft.partial(np.array2string, precision=8, separator=", ")
        surface, side = int(self.tangency.surface), int(self.tangency.side)
        return (
            f"Bifurcation{told}: {self.kind} at {self.parameter} = {float(self.value):.15g}, "
            f"{outcome(self.result)}\n"
            f"  touches surface {surface} from side {side:+d} at "
            f"t = {float(self.t):.10g}, x = {show(np.asarray(self.x))}\n"
            f"  H {float(c.h):.1e}, dH/dt {float(c.rate):.1e}, d²H/dt² {float(c.bend):.6g}; dH/dt "
            f"of the other side {float(c.other_rate):.6g}; along the slide "
            f"{float(c.slide_rate):.3g}, {float(c.slide_bend):.6g}\n"
            f"  residual {float(self.residual):.1e}"
        )


def find_bifurcation(
    system: System,
    parameter: str,
    orbit: Orbit,
    kind: str,
    *,
    newton_steps: int = 40,
    throw: bool = True,
) -> Bifurcation:
    """Find the value of a parameter at which an orbit near `orbit` has a bifurcation.

        x(t0 + T; x0) = x0,  H = Ḣ_s = 0  (for a slide Ḣ_s = 0 = dḢ_s/dt along the slide)

    Ḣ_s is dH/dt along the field of the side s from which the orbit comes.
    Newton's method solves for a state on the orbit, the phase of the tangency (or the period of an
    autonomous system) and the parameter together. A contact whose reset is not the identity where
    H = Ḣ = 0, such as a spike, is searched with that reset.

    **Arguments**

    - `system`: the `System`.
    - `parameter`: the name of a scalar parameter.
    - `orbit`: a periodic orbit of `system` near the bifurcation, on either side of it; a batch (as
      from `equinox.filter_vmap`) is searched in one call. It must not be traced. The search starts
      from the value that `parameter` has in the orbit's system.
    - `kind`: one of `BIFURCATION_KINDS`.
    - `newton_steps`: the largest number of evaluations.
    - `throw`: whether to raise an error unless the outcome is `successful`.

    **Returns** a `Bifurcation`. The derivative of its `value` with respect to the other float
    leaves of the system follows from the implicit function theorem, forward and reverse.

    **Outcomes**: `successful`; `no_tangency_found` if the orbit itself failed or comes near no
    surface in that way; `other_kind` for a bifurcation of the kind `.kind` instead; `orbit_lost`
    where the flight around the tangency reaches another surface; `newton_stalled`,
    `newton_singular` or `newton_max_steps_reached` where there is perhaps no bifurcation; and where
    the flow cannot be followed from the guess, `nonfinite`, `max_steps_reached`, `mode_undecided`,
    `zeno`, `nonunique`, `reset_undecided`, `undeclared_sliding` or `step_too_long`.

    **Source**: kinds and conditions: M. di Bernardo, C. Budd, A. Champneys, P. Kowalczyk,
    Piecewise-smooth Dynamical Systems (2008), chapter 8, with time as a state.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> system = jf.systems.SDOscillator(omega=0.84)
    >>> orbit = jf.periodic_orbit(system, jnp.array([1.9, 0.0]))
    >>> b = jf.find_bifurcation(system, "omega", orbit, "grazing")
    >>> print(b.kind, round(float(b.value), 12))
    grazing 0.866716581971
    """
    check.system("system", system)
    scalar_parameter(system, parameter)
    check.one_of("kind", kind, BIFURCATION_KINDS)
    check.instance("orbit", orbit, Orbit)
    check.flags(throw=throw)
    system = cast(system, orbit.x0.dtype)
    most = array_of(check.count("newton_steps", newton_steps))
    family, code = FAMILIES[kind], BIFURCATION_KINDS.index(kind)

    def search(system_of: Callable[[Orbit], System], most: Array) -> Callable:
        def one(orbit: Orbit, tangency: Tangency, missing: Array) -> tuple[Bifurcation, Array]:
            # Numbers instead of names, so that one program serves all kinds.
            asked = array_of(family), array_of(code)
            there = system_of(orbit), parameter, *asked, most, orbit, tangency, missing
            found, away = _find(*there)
            return Bifurcation(**found, parameter=parameter, family=FAMILY_NAMES[family]), away

        return one if orbit.x0.ndim == 1 else eqx.filter_vmap(one)

    # Candidates are compared on the known orbit, also while the system is traced.
    known = without_derivatives(system)
    first = search(lambda orbit: known if is_known(known) else orbit.system, array_of(1))
    every = guesses(orbit, kind, away=lambda *guess: first(*guess)[1])
    found = _nearest_found(orbit, every, search(lambda _: system, most))
    return raise_if_failed(found, found.result) if throw else found


def _nearest_found(orbit: Orbit, lanes: list[list[Guess]], search: Callable) -> Bifurcation:
    """The nearest bifurcation from the candidates of each lane."""
    found = None
    for guess in attempts(orbit, lanes):
        # Under jit all candidates are tried.
        if found is not None and is_known(found.result) and _is_nearest(orbit, found, guess):
            break
        now, _ = search(orbit, guess.tangency, guess.missing)
        found = now if found is None else _better(orbit, found, now)
    assert found is not None
    return found


def _is_nearest(orbit: Orbit, found: Bifurcation, guess: Guess) -> bool:
    """Whether no lane has a further candidate that may be nearer."""
    distance = np.asarray(without_derivatives(_distance(orbit, found)))
    return is_successful(found.result) and bool(np.all(distance <= guess.away))


def _distance(orbit: Orbit, found: Bifurcation) -> Array:
    return abs(found.value - get_parameter(orbit.system, found.parameter))


def _better(orbit: Orbit, a: Bifurcation, b: Bifurcation) -> Bifurcation:
    """For each lane the successful result, of two the nearer one, or otherwise one that is a
    bifurcation."""

    def rank(found: Bifurcation) -> Array:
        named = (found.result == RESULTS.other_kind).astype(jnp.int32)
        return 2 * (found.result == RESULTS.successful).astype(jnp.int32) + named

    nearer = (rank(b) == rank(a)) & (_distance(orbit, b) < _distance(orbit, a))
    return lane_by_lane((rank(b) > rank(a)) | nearer, b, a)


@eqx.filter_jit
def lane_by_lane(take: Array, a: _Result, b: _Result) -> _Result:
    """The lanes of a where `take` is true, of b elsewhere."""

    def pick(u: Array, v: Array) -> Array:
        return select(jnp.reshape(take, take.shape + (1,) * (v.ndim - take.ndim)), u, v)

    arrays, rest = eqx.partition(a, eqx.is_array)
    return eqx.combine(jax.tree.map(pick, arrays, eqx.filter(b, eqx.is_array)), rest)


@compiled_if_traced
def _find(
    system: System,
    parameter: str,
    family: Array,
    code: Array,
    newton_steps: Array,
    orbit: Orbit,
    tangency: Tangency,
    missing: Array,
) -> tuple[dict[str, Any], Array]:
    """The fields of a `Bifurcation`, except names, and the change of the parameter since the guess,
    including one more step of Newton's method."""
    equations, guess = _first_guess(system, parameter, family, newton_steps, orbit, tangency)
    z, root = solve_implicit(equations, system, guess)
    found = bifurcation_at(equations, system, orbit, z, root)
    return _of_kind(found, code, missing), first_order(root, abs((z + root.step - guess)[-1]))


@jax.jit
def first_order(root: Root, distance: Array) -> Array:
    """A distance of the parameters after the step at a root; inf where there is no step."""
    lost = (root.result != RESULTS.successful) & (root.result != RESULTS.newton_max_steps_reached)
    return select(lost | jnp.isnan(distance), jnp.inf, distance)


@eqx.filter_jit
def _first_guess(
    system: System,
    parameter: str,
    family: Array,
    newton_steps: Array,
    orbit: Orbit,
    tangency: Tangency,
) -> tuple[DefiningSystem, Array]:
    """The equations and a guess of their unknowns."""
    equations = defining_system(system, orbit, tangency, family, (parameter,), newton_steps)
    value = jnp.asarray(get_parameter(orbit.system, parameter), tangency.starts.dtype)
    return equations, equations.unknowns(orbit, [value])


@eqx.filter_jit
def _of_kind(found: dict[str, Any], code: Array, missing: Array) -> dict[str, Any]:
    """The located bifurcation, with its outcome relative to the requested kind."""
    # Each line overrides the one before it.
    other = RESULTS.where(found["code"] == code, RESULTS.successful, RESULTS.other_kind)
    result = RESULTS.where(found["result"] == RESULTS.successful, other, found["result"])
    result = RESULTS.where(missing, RESULTS.no_tangency_found, result)
    value = select(missing, jnp.nan, found["value"])
    return found | {"value": value, "result": result}


def bifurcation_at(
    equations: DefiningSystem, system: System, near: Orbit, z: Array, root: Root
) -> dict[str, Any]:
    """The fields, except names, of the bifurcation of any kind at a root of a defining system,
    reached from an orbit near it. Its parameter is the first free one."""
    at, closing = equations.there(system, z), root.at.aux
    found = conditions(at.system, closing.t, closing.x, equations.tangency)
    return _fields(equations, at, near, z, root, found)


@eqx.filter_jit
def _fields(
    equations: DefiningSystem, at: Placed, near: Orbit, z: Array, root: Root, found: Conditions
) -> dict[str, Any]:
    return tree_in_kernel(lambda: _fields_of(equations, at, near, z, root, found))


def _fields_of(
    equations: DefiningSystem, at: Placed, near: Orbit, z: Array, root: Root, found: Conditions
) -> dict[str, Any]:
    closing: Closing = root.at.aux
    tangency = equations.residual_at.tangency_at(at)
    located = kind_of(equations.family, found)
    result = RESULTS.where(closing.holds, RESULTS.successful, RESULTS.orbit_lost)
    result = RESULTS.where(root.result == RESULTS.successful, result, root.result)
    return dict(
        value=z[tangency.starts.size + 1],
        orbit=Orbit(
            x0=tangency.starts[0],
            period=at.period,
            monodromy=equations.monodromy(root.at.jacobian),
            residual=root.size,
            events=near.events,
            num_events=near.num_events,
            first_mode=closing.first_mode.astype(jnp.int8),
            result=root.result,
            system=at.system,
            starts=tangency.starts,
            num_steps=root.num_steps,
            options=dataclasses.replace(equations.options, t0=tangency.node * at.period),
        ),
        t=closing.t,
        x=closing.x,
        code=select(root.result == RESULTS.successful, located, -1),
        conditions=found,
        residual=root.size,
        result=result,
        tangency=tangency,
    )
