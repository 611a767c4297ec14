"""A trial step whose motion is a polynomial, which ends at the first contact.

The polynomial of a step is cut at the first zero of a guard. This only gives a better length; the
relation of the step's end to a surface is decided in `contacts.locate`, as for every other step.
"""

import dataclasses
import functools as ft

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.contacts.cubic import NEVER
from jaxfil.integrate.contacts.guards import NOISE
from jaxfil.integrate.contacts.locate import met_together
from jaxfil.integrate.contacts.polynomial import first_zero, stays_positive
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import ContactSearch, LoopState
from jaxfil.integrate.lane.step_length import Length
from jaxfil.integrate.loop.tail import known_part
from jaxfil.integrate.steppers.explicit import Trial, trial_of
from jaxfil.integrate.steppers.taylor import TaylorTableau
from jaxfil.integrate.surfaces.filippov import ModeField
from jaxfil.integrate.system.components import Components, any_of, least, on_each, where
from jaxfil.integrate.system.smooth_field import Polynomial, horner
from jaxfil.xla.select import select


def path_of(problem: Problem, state: LoopState, length: Length, field: ModeField) -> Polynomial:
    """The motion in a step, for a Taylor tableau."""
    assert isinstance(problem.tableau, TaylorTableau)
    t, x = problem.grid.t0 + state.motion.tau, state.motion.x
    return field.polynomial(problem.tableau.order, t, x, length.h, ends_at_kinks(problem))


def may_be_cut(problem: Problem) -> bool:
    """Whether steps may end on their polynomial."""
    return problem.system.m > 0 or problem.tableau.tolerance is not None or ends_at_kinks(problem)


def ends_at_kinks(problem: Problem) -> bool:
    """Whether steps end at kinks, which a tolerance needs: the error at the end of a step does not
    show a kink that has been passed twice. Without a tolerance the grid has the steps, except where
    H has a kink, beyond which the polynomial of its guard would hide a contact."""
    structure, tableau = problem.system.structure, problem.tableau
    with_series = isinstance(tableau, TaylorTableau)
    kinked = structure.folded if tableau.tolerance is None else structure.kinked
    return with_series and kinked


def guards_of(problem: Problem, state: LoopState, length: Length, path: Polynomial) -> tuple:
    """The coefficients of the guards within a step, with the loop's own values at its start."""
    # A guard that is not armed starts at exactly zero, with a rate that does not fall. The series
    # has the rounding of both, which could be a contact at the start.
    known = state.motion.g, length.h * state.motion.rate
    guards = stop_gradient((*known, *path.guards[2:]))
    if problem.kept is None:
        return guards
    # A guard that is constantly 1 has no contact, as in `unguarded`.
    on = problem.kept.on
    return tuple(where(on, float(k == 0), c) for k, c in enumerate(guards))


def is_clear(problem: Problem, state: LoopState, length: Length, path: Polynomial) -> Components:
    """The surfaces whose guard has no zero in a step, and comes near none."""
    return _clear(state, path, guards_of(problem, state, length, path))


def _clear(state: LoopState, path: Polynomial, guards: tuple) -> Components:
    clear = on_each(lambda noise, *c: stays_positive(c, noise), state.motion.noise, *guards)
    # A path that is right only at its end has unknown guards.
    return clear & ~path.ends


def step_along(
    problem: Problem, state: LoopState, length: Length, path: Polynomial
) -> tuple[LoopState, Length, Trial]:
    """A trial step along a path up to the first zero of a guard in it, and the lane, which then
    aims at the contact there."""
    s, length, search, searched = _cut_at_contact(problem, state, length, path)
    assert isinstance(problem.tableau, TaylorTableau)
    start = problem.grid.t0 + state.motion.tau
    forcing = problem.system.forcing(start, length.h, problem.tableau.times)
    trial = trial_of(problem.tableau, path, s, forcing)
    x, error = problem.system.hold((trial.x, trial.error))
    trial = dataclasses.replace(trial, x=x, error=error, searched=searched)
    return dataclasses.replace(state, search=search), length, trial


def _cut_at_contact(
    problem: Problem, state: LoopState, length: Length, path: Polynomial
) -> tuple[Array, Length, ContactSearch, Components]:
    """The fraction of a path up to the first zero of a guard in it, the length to there, the
    contact, and the surfaces whose guards are known to have no zero before."""
    system, waits = problem.system, state.pending.waits
    guards, noise = guards_of(problem, state, length, path), state.motion.noise
    clear = system.hold(_clear(state, path, guards).astype(system.dtype)) > 0
    seeks = jnp.zeros((), bool) if problem.look is None else problem.look.seeking
    # A switch has length zero, and the length of a probe for a section is given. A guard that is
    # not finite goes to the search of every step, whose θ is then NaN.
    near = ~clear & ~(waits | seeks | path.ends) & on_each(_are_finite, *guards)

    def searched(noise: Components, *guards: Components) -> tuple[Components, ...]:
        found = [
            first_zero(system, own, *c)
            for own, *c in zip(noise.parts, *(v.parts for v in guards), strict=True)
        ]
        return tuple(map(Components, zip(*found, strict=True)))

    def nothing(noise: Components, *_: Components) -> tuple[Components, Components, Components]:
        never = noise.like(jnp.full_like(length.h, NEVER))
        return never, never, 0.0 * never

    if system.m == 0:
        thetas, contact = noise, jnp.full_like(length.h, NEVER)
        lowest = contact
    else:
        found = system.where_any(any_of(near), searched, nothing, noise, *guards)
        thetas, looks, known = found
        # A guard whose zeros stay unknown does not cut the step. It is missing in the surfaces
        # returned as searched, so that the search of every step examines it.
        near = near & (known > 0)
        thetas, looks = where(near, thetas, NEVER), where(near, looks, NEVER)
        contact, lowest = system.hold((least(thetas), least(looks)))
    whole = waits | seeks | path.ends
    if path.kinks is not None:
        beyond = _beyond_kink(problem, state, length, path.kinks)
        lowest = jnp.minimum(lowest, select(whole, NEVER, beyond))
    if problem.tableau.tolerance is not None:
        lowest = jnp.minimum(lowest, select(whole, NEVER, known_part(problem, path)))
    s = jnp.minimum(contact, lowest)
    # A cut shorter than the rounding of times is omitted; the search of every step handles it.
    h = s * length.h
    cuts = (s < 1) & (abs(h) > problem.same_time(state.motion.tau))
    # The motion may turn back within the step, beyond the surface that it has passed at its start.
    omitted = (s < 1) & ~cuts
    s, h = system.hold((select(cuts, s, 1.0), select(cuts, h, length.h)))
    # At a minimum there is no contact to aim at.
    aimed = cuts & (contact <= lowest) & met_together(thetas, contact)
    search = ContactSearch(
        length=select(cuts, h, state.search.length),
        surfaces=where(cuts, aimed, state.search.surfaces),
        rejections=state.search.rejections,
    )
    # The room is measured from the end of the step, so the part that is cut off is added to it.
    shorter = Length(
        h=h,
        end=select(cuts, state.motion.tau + h, length.end),
        room=length.room + (length.h - h),
        cutting=cuts | length.cutting,
        gridded=length.gridded & ~cuts,
        saving=length.saving & ~cuts,
        ticking=None if length.ticking is None else length.ticking & ~cuts,
    )
    # These guards have no zero before the end, in the whole step or since it is cut at the first.
    return s, shorter, search, clear | (near & ~omitted)


def _beyond_kink(
    problem: Problem, state: LoopState, length: Length, kinks: tuple[Array, ...]
) -> Array:
    """The fraction of a path up to the first kink of the field in it, and beyond it by the rounding
    of what is compared and of the time; `NEVER` without one.

    The coefficients belong to one side of each kink. The next step starts on the other side.
    """
    system = problem.system
    first, *others = stop_gradient(kinks)
    noise = NOISE * system.eps * ft.reduce(jnp.add, map(abs, others), abs(first))
    shifted = first + noise, *others
    # A value that is compared with itself has no kink.
    near = (noise > 0) & ~stays_positive(shifted, 0.0 * noise)

    def searched(*c: Array) -> tuple[Array, Array]:
        # The second is the end of the part in which zeros are known.
        found, known, _ = first_zero(system, 0.0 * noise, *c)
        return select(near, found, NEVER), select(near, known, NEVER)

    def nowhere(*c: Array) -> tuple[Array, Array]:
        never = jnp.full_like(noise, NEVER)
        return never, never

    found, known = system.where_any(jnp.any(near), searched, nowhere, *shifted)
    s = jnp.minimum(jnp.min(found), jnp.min(known))
    moves = select(length.h == 0, 1.0, abs(length.h))
    beyond = stop_gradient(2 * problem.same_time(state.motion.tau) / moves)
    return _with_derivative(problem, s, (found == s) & (s < 1), kinks) + beyond


def _with_derivative(problem: Problem, s: Array, ends: Array, kinks: tuple[Array, ...]) -> Array:
    """The fraction s of a path up to the kinks that it `ends` at, with the derivatives of their
    zero."""
    # Of kinks at one place, such as those of |x| and of its sign, the sum has the same zero.
    own = tuple(jnp.sum(select(ends, v, 0.0)) for v in kinks)
    slope = tuple(k * v for k, v in enumerate(own) if k > 0)
    # Two of Newton's steps from a constant have the first and second derivatives of a simple zero.
    found = s
    for _ in range(2):
        rate = horner(slope, found)
        found = found - horner(own, found) / select(rate == 0, 1.0, rate)
    # At a kink that is only touched the next steps go far, and its time has no derivative.
    simple = abs(found - s) <= problem.system.eps**0.5
    return s + select(simple, found - stop_gradient(found), 0.0)


def _are_finite(*c: Array) -> Array:
    """Whether all coefficients of a guard are finite."""
    # NaN fails this comparison, as inf does.
    return jnp.asarray(sum(map(abs, c)) < jnp.inf)
