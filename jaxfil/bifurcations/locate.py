"""`find_bifurcation`: where an orbit meets a surface tangentially.

A system, the name of a parameter, an orbit nearby and a kind enter; a `Bifurcation` leaves: the
value, the orbit, where and when it touches, and the conditions that define the kind, with their
values. Found by Newton's method on the orbit, the phase of the touch and the parameter together;
nothing there has the square root that grazing puts into the period map.

Kinds and conditions: M. di Bernardo, C. Budd, A. Champneys, P. Kowalczyk, Piecewise-smooth
Dynamical Systems (2008), chapter 8, with time as a state.
"""

import dataclasses
import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from jaxfil.bifurcations.candidates import tangency_candidates
from jaxfil.bifurcations.tangency import (
    FAMILIES,
    Closing,
    Conditions,
    Tangency,
    close,
    conditions,
    defining,
    kind_of,
)
from jaxfil.model import check
from jaxfil.model.card import outcome, precision
from jaxfil.model.deprecation import renamed_argument, renamed_attribute
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.parameter import cast, get_parameter, is_parameter, replace_parameter
from jaxfil.model.system import System
from jaxfil.orbits.newton import Evaluation, newton
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.shooting import ShootingOptions
from jaxfil.xla.kernel import kernel_if_it_fits

BIFURCATION_KINDS = tuple(FAMILIES)


class Bifurcation(eqx.Module):
    """A located bifurcation: at `value` of the parameter the orbit touches `surface` at time `t` in
    state `x`. `orbit` starts where the flight around the touch does. `code` is the number of its
    kind in `BIFURCATION_KINDS`, −1 where the conditions are those of none."""

    value: Float[Array, ""]
    orbit: Orbit
    t: Float[Array, ""]
    x: Float[Array, " n"]
    code: Array
    conditions: Conditions
    residual: Float[Array, ""]
    result: RESULTS
    tangency: Tangency
    parameter: str = eqx.field(static=True)
    family: str = eqx.field(static=True)

    touch = renamed_attribute("touch", "tangency")

    @property
    def kind(self) -> Any:
        """The name of the kind, decided by the conditions; an array of names for a batch."""
        names = np.array([*BIFURCATION_KINDS, "undecided"])[np.asarray(self.code)]
        return str(names) if names.ndim == 0 else names

    def __repr__(self) -> str:
        told = precision(self.x)
        if isinstance(self.value, jax.core.Tracer) or self.value.ndim:
            return f"Bifurcation{told}: a batch of shape {self.value.shape} in {self.parameter}"
        c, show = self.conditions, ft.partial(np.array2string, precision=8, separator=", ")
        return (
            f"Bifurcation{told}: {self.kind} at {self.parameter} = {float(self.value):.15g}, "
            f"{outcome(self.result)}\n"
            f"  touches surface {int(self.tangency.surface)} from side {int(self.tangency.side):+d} at "
            f"t = {float(self.t):.10g}, x = {show(np.asarray(self.x))}\n"
            f"  H {float(c.h):.1e}, dH/dt {float(c.rate):.1e}, d²H/dt² {float(c.bend):.6g}; dH/dt "
            f"of the other side {float(c.other_rate):.6g}; along the slide "
            f"{float(c.slide_rate):.3g}, {float(c.slide_bend):.6g}\n"
            f"  residual {float(self.residual):.1e}"
        )


@renamed_argument("name", "parameter")
def find_bifurcation(
    system: System,
    parameter: str,
    orbit: Orbit,
    kind: str,
    *,
    newton_steps: int = 40,
    throw: bool = True,
) -> Bifurcation:
    """The value of `parameter` at which an orbit near `orbit` has a bifurcation.

    Unknowns are a state on the orbit, the phase of the touch (or the period of an autonomous
    system) and the parameter; equations that the orbit closes, and two at the touch: H = Ḣ_s = 0,
    or for a slide Ḣ_s = 0 and its derivative along the slide.

    **Arguments**

    - `orbit`: a periodic orbit of `system` near the bifurcation, on either side of it; a batch (as
      from `equinox.filter_vmap`) is searched in one call.
    - `kind`: "grazing" (also impacts on a wall), "grazing-sliding", "adding-sliding",
      "crossing-sliding" or "switching-sliding".
    - `newton_steps`: evaluations at most.
    - `throw`: raise an error unless the outcome is successful; otherwise return it.

    **Returns** a `Bifurcation`. Besides Newton's outcomes: `no_tangency_found`, `orbit_lost`, and
    `other_kind` (the place is one, but of the kind that `.kind` names). The derivative of `.value`
    with respect to the other parameters is that of the implicit function, forward and reverse.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system = jf.systems.SDOscillator(omega=0.84)
    >>> orbit = jf.periodic_orbit(system, jnp.array([1.9, 0.0]))
    >>> b = jf.find_bifurcation(system, "omega", orbit, "grazing")
    >>> print(b.kind, round(float(b.value), 12))
    grazing 0.866716581971
    """
    check.system("system", system)
    get_parameter(system, parameter)
    if kind not in FAMILIES:
        raise ValueError(f"`kind` must be one of {', '.join(FAMILIES)}; got {kind!r}.")
    if not isinstance(orbit, Orbit):
        raise ValueError(f"`orbit` must be an Orbit, got {type(orbit).__name__}.")
    system = cast(system, orbit.x0.dtype)
    newton_steps = check.count("newton_steps", newton_steps)
    one = ft.partial(
        _find, system, parameter, FAMILIES[kind], BIFURCATION_KINDS.index(kind), newton_steps
    )
    if orbit.x0.ndim == 1:
        found = _first_real(one, orbit, [guesses(orbit, kind)])
    else:
        lanes = [jax.tree.map(lambda v, i=i: v[i], orbit) for i in range(orbit.x0.shape[0])]
        found = _first_real(eqx.filter_vmap(one), orbit, [guesses(lane, kind) for lane in lanes])
    if not throw:
        return found
    return found.result.error_if(found, found.result != RESULTS.successful)


def guesses(orbit: Orbit, kind: str) -> list[tuple[Tangency, Array]]:
    """The nearest touches, and whether there is none."""
    candidates = (
        tangency_candidates(orbit, kind) if bool(orbit.result == RESULTS.successful) else []
    )
    if candidates:
        return [(tangency, jnp.asarray(False)) for _, tangency in candidates]
    nan = jnp.full_like(orbit.period, jnp.nan)
    nowhere = Tangency(
        orbit.x0, nan, nan, nan, orbit.first_mode.astype(nan.dtype), jnp.zeros((), jnp.int32), nan
    )
    return [(nowhere, jnp.asarray(True))]


def _first_real(search: Any, orbit: Orbit, lanes: list[list]) -> Bifurcation:
    """The bifurcation at the first touch of each lane from which one is found. The touch that is
    nearest now need not be the first to happen."""
    found = None
    for i in range(max(len(lane) for lane in lanes)):
        tried = [lane[min(i, len(lane) - 1)] for lane in lanes]
        single = orbit.x0.ndim == 1
        arrays = tried[0] if single else jax.tree.map(lambda *v: jnp.stack(v), *tried)
        now = search(orbit, *arrays)
        found = now if found is None else _better(found, now)
        try:
            if bool(jnp.all(found.result == RESULTS.successful)):
                break
        except jax.errors.TracerBoolConversionError:  # under jit all of them are tried
            continue
    assert found is not None
    return found


def _better(a: Bifurcation, b: Bifurcation) -> Bifurcation:
    """Lane by lane the one that succeeded, or at least is a bifurcation."""

    def rank(found: Bifurcation) -> Array:
        named = (found.result == RESULTS.other_kind).astype(jnp.int32)
        return 2 * (found.result == RESULTS.successful).astype(jnp.int32) + named

    take = rank(b) > rank(a)

    def pick(u: Any, v: Any) -> Any:
        return jnp.where(jnp.reshape(take, take.shape + (1,) * (v.ndim - take.ndim)), v, u)

    arrays, rest = eqx.partition(a, eqx.is_array)
    return eqx.combine(jax.tree.map(pick, arrays, eqx.filter(b, eqx.is_array)), rest)


class Problem(eqx.Module):
    """The defining system of a touch. q is (phase of the touch, or period; parameters)."""

    system: System
    tangency: Tangency
    options: ShootingOptions
    family: str = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    periods: int | Array

    def placed(self, z: Array) -> tuple[System, Array, Tangency]:
        """System, period and touch for unknowns (x, q)."""
        n = self.tangency.x.shape[0]
        system = self.system
        for name, value in zip(self.names, z[n + 1 :], strict=True):
            system = replace_parameter(system, name, value)
        if system.period is None:
            return system, z[n], dataclasses.replace(self.tangency, x=z[:n])
        period = jnp.asarray(system.period) * self.periods
        return system, period, dataclasses.replace(self.tangency, x=z[:n], phase=z[n])

    def residual(self, z: Array) -> tuple[Array, tuple]:
        """Closing and the two conditions, shape (n + 2,)."""
        system, period, tangency = self.placed(z)
        closing = close(system, period, self.options, self.family, tangency)
        pair = defining(system, self.family, closing.t, closing.x, tangency)
        value = jnp.append(closing.gap, pair)
        return value, (value, stop_gradient(closing))

    def scales(self, z: Array, closing: Closing) -> tuple[Array, Array]:
        """Of the equations and of the unknowns."""
        n = self.tangency.x.shape[0]
        system, period, _ = self.placed(z)
        size = jnp.where(closing.size == 0, 1, closing.size)
        normals = jax.jacfwd(system.switching, argnums=1)(closing.t, closing.x)
        height = jnp.max(abs(jnp.atleast_2d(normals)) @ size)
        height = jnp.where(height == 0, 1, height)
        pace = 2 * jnp.pi / period
        pair = jnp.stack([height * pace, height * pace**2])
        pair = pair if self.family == "slide" else pair / pace
        q = abs(z[n:])
        return jnp.append(size, pair), jnp.append(size, jnp.where(q == 0, 1, q))


def evaluation(problem: Problem, extra: Any, z: Array) -> Evaluation:
    """Residual and Jacobian, with `extra(z)`, equations of order one, appended."""
    jacobian, (value, aux) = kernel_if_it_fits(jax.jacfwd(problem.residual, has_aux=True))(z)
    equations, unknowns = problem.scales(z, aux)
    more, more_by = extra(z), jax.jacfwd(extra)(z)
    return Evaluation(
        jnp.append(value, more),
        jnp.concatenate([jacobian, more_by]),
        jnp.append(equations, jnp.ones_like(more)),
        unknowns,
        aux.result,
        aux,
    )


def _no_more(z: Array) -> Array:
    return jnp.zeros((0,), z.dtype)


@eqx.filter_jit
def _find(system, parameter, family, code, newton_steps, orbit, tangency, missing) -> Bifurcation:
    problem = defining_problem(system, orbit, tangency, family, (parameter,))
    value = jnp.asarray(get_parameter(orbit.system, parameter), tangency.x.dtype)
    phase = orbit.period if system.period is None else tangency.phase
    z = jnp.concatenate([tangency.x, jnp.stack([phase, value])])
    theta, unravel = ravel_pytree(eqx.filter(system, is_parameter))
    rest = eqx.filter(system, is_parameter, inverse=True)
    problem = eqx.tree_at(lambda p: p.system, problem, rest, is_leaf=lambda v: v is None)
    z, root = _implicit(
        theta, stop_gradient(z), problem=problem, unravel=unravel, newton_steps=newton_steps
    )
    problem = eqx.tree_at(lambda p: p.system, problem, eqx.combine(unravel(theta), rest))
    system, period, tangency = problem.placed(z)
    closing = root.at.aux
    found = conditions(system, closing.t, closing.x, tangency)
    eps = float(jnp.finfo(z.dtype).eps)
    flags = jnp.stack(kind_of(family, found, eps))
    located = jnp.where(jnp.any(flags), jnp.argmax(flags), -1)
    result = RESULTS.where(located == code, RESULTS.successful, RESULTS.other_kind)
    result = RESULTS.where(closing.holds, result, RESULTS.orbit_lost)
    result = RESULTS.where(root.result == RESULTS.successful, result, root.result)
    result = RESULTS.where(missing, RESULTS.no_tangency_found, result)
    n = tangency.x.shape[0]
    nan = jnp.full_like(root.at.size, jnp.nan)
    return Bifurcation(
        value=jnp.where(missing, nan, z[-1]),
        orbit=Orbit(
            x0=tangency.x,
            period=period,
            monodromy=root.at.jacobian[:n, :n] + jnp.eye(n, dtype=z.dtype),
            residual=root.at.size,
            events=orbit.events,
            num_events=orbit.num_events,
            first_mode=tangency.mode.astype(jnp.int8),
            result=root.result,
            system=system,
            starts=tangency.x[None],
            num_steps=root.num_steps,
            options=eqx.tree_at(lambda p: p.t0, problem.options, tangency.start * period),
        ),
        t=closing.t,
        x=closing.x,
        code=jnp.where(root.result == RESULTS.successful, located, -1),
        conditions=found,
        residual=root.at.size,
        result=result,
        tangency=tangency,
        parameter=parameter,
        family=family,
    )


def defining_problem(
    system: System, orbit: Orbit, tangency: Tangency, family: str, names: tuple
) -> Problem:
    """The defining system of a touch on an orbit of a forced or an autonomous system."""
    periods = 1
    if system.period is not None:
        periods = jnp.round(stop_gradient(orbit.period / jnp.asarray(orbit.system.period)))
    options = dataclasses.replace(orbit.options, arcs=1)
    return Problem(system, stop_gradient(tangency), options, family, names, periods)


@eqx.filter_custom_jvp
def _implicit(theta, z, *, problem, unravel, newton_steps):
    system = eqx.combine(unravel(theta), problem.system)
    problem = eqx.tree_at(lambda p: p.system, problem, system)
    root = newton(ft.partial(evaluation, problem, _no_more), z, newton_steps)
    return root.z, root


@_implicit.def_jvp
def _implicit_jvp(primals, tangents, *, problem, unravel, newton_steps):
    theta, z0 = primals
    z, root = _implicit(theta, z0, problem=problem, unravel=unravel, newton_steps=newton_steps)
    nothing = jax.tree.map(
        lambda v: jnp.full_like(v, jnp.nan) if eqx.is_inexact_array(v) else None, root
    )
    if tangents[0] is None:
        return (z, root), (jnp.zeros_like(z), nothing)

    def residual(theta):
        system = eqx.combine(unravel(theta), problem.system)
        return eqx.tree_at(lambda p: p.system, problem, system).residual(z)[0]

    sensitivity = -jnp.linalg.solve(root.at.jacobian, jax.jacfwd(residual)(theta))
    return (z, root), (sensitivity @ tangents[0], nothing)
