"""Outcomes: how a lane ended, and what happened at a contact.

Takes nothing; gives `RESULTS`, the enumeration every verb answers with (each member carries the
sentence the user sees), and `EventKind`, the codes of the event table.
"""

import enum
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfil.model.runtime_error import raise_first
from jaxfil.xla.known import in_numpy, is_known

_Tree = TypeVar("_Tree")


class _Outcomes(type(eqx.Enumeration)):
    """The enumeration's own kind, which lists its members."""

    def __dir__(cls) -> list[str]:
        return [*super().__dir__(), *cls._name_to_item]  # pyright: ignore[reportAttributeAccessIssue]

    def names(cls, results: Any) -> np.ndarray:
        """The names of outcomes, an array of strings in their shape: see `RESULTS`."""
        return outcome_names(results)


class RESULTS(eqx.Enumeration, metaclass=_Outcomes):
    """How a lane ended. `successful` is the only good outcome, besides `section_reached` of a run
    that was asked to end at a section.

    A result has its outcome in `result`, one for each lane in `results`. The value of a member is
    the sentence that the user reads: `jf.RESULTS[sol.result]`. Outcomes are compared by `==`, under
    `jit` too. `jf.RESULTS.names(diagram.results)` is the array of the names of those of all lanes,
    in their shape, to be indexed and counted as any other: outcomes themselves have no index.

    - Of every integration: `successful`, `max_steps_reached`, `max_events_reached`, `zeno`,
      `nonunique`, `mode_undecided`, `undeclared_sliding`, `nonfinite`, `step_too_long`;
      with resets `irreversible_reset`, `reset_undecided`; with sections `section_reached`,
      `out_of_bounds`, and of sweeps with one `section_not_reached`.
    - Of Newton's method, in orbits, branches and bifurcations: `newton_stalled`,
      `newton_singular`, `newton_max_steps_reached`.
    - Of orbits: `behind_surface`.
    - Of the search for a bifurcation: `no_tangency_found`, `other_kind`, `orbit_lost`,
      `not_nearest`.
    - Of the choice of a step: `tolerance_not_met`.
    - Of a fit: `fit_not_converged`.
    - Of a sweep that Ctrl-C ended: `interrupted`.
    - Of sweeps, orbits and exponents, which count forcing periods: `invalid_period`.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> up = jf.piecewise(lambda t, x: x + 1, lambda t, x: x - 1, lambda t, x: x[0])
    >>> run = lambda x0: jf.solve(up, x0, 0.0, 1.0, 0.25, stepper=jf.RK4(), throw=False).result
    >>> results = jax.vmap(run)(jnp.array([[1.0], [0.0], [-1.0]]))
    >>> names = jf.RESULTS.names(results)
    >>> print(names[1], (names == "successful").sum())
    nonunique 2
    >>> (results == jf.RESULTS.nonunique).tolist()
    [False, True, False]
    """

    successful = ""
    max_steps_reached = (
        "The budget of steps was used up before the end of the time span. Try a larger "
        "`max_steps`; or, where steps are halved (`stats`) since the field is stiff, "
        "`stepper=jf.Rodas5P()`."
    )
    max_events_reached = (
        "The event table, or that of crossings of sections, is full. Try a larger `max_events`, or "
        "`max_events=None` to keep no table."
    )
    mode_undecided = (
        "No mode of motion continues the solution at a contact: neither side nor sliding is "
        "consistent with the vector fields there."
    )
    zeno = (
        "Contacts accumulate: infinitely many happen in a finite time (Zeno behaviour), no rule "
        "says what comes after them, and the solution was followed up to that time."
    )
    nonunique = (
        "The solution is not unique from here: a repelling sliding region, a two-fold or a corner "
        "from which several motions leave (in backward time every attracting slide is one)."
    )
    undeclared_sliding = (
        "The solution meets an attracting sliding region, but the system says `slides = False`."
    )
    newton_stalled = (
        "Newton's method cannot reduce the residual any further: there is perhaps no solution near "
        "the guess. Try a better guess, more `steps`, or more `segments`."
    )
    newton_singular = (
        "The Jacobian of Newton's method is singular: a fold, a bifurcation point, or a family of "
        "solutions that an equation more would single out."
    )
    newton_max_steps_reached = (
        "Newton's method has not converged in its number of steps. Try a larger `newton_steps`."
    )
    behind_surface = (
        "The orbit found lies behind a surface that throws back, where H < 0 and no motion comes "
        "from H ≥ 0. Start from a guess with H > 0."
    )
    no_tangency_found = (
        "The orbit has no approach to a surface, or no contact with it, from which a bifurcation "
        "of the kind asked for could come."
    )
    other_kind = "A bifurcation was located, but it is of another kind than the one asked for."
    orbit_lost = (
        "Newton's method has reached a point that is no orbit of the system: it meets a surface "
        "where it is not meant to, so that the orbit ends or changes before the bifurcation."
    )
    not_nearest = (
        "The place found is on the grazing set, but the distance to it is no minimum there: places "
        "next to it on the set are nearer. Start from an orbit closer to the set."
    )
    tolerance_not_met = (
        "No number of steps that was tried meets the tolerance: it is below what rounding, or a "
        "motion that is sensitive to the smallest changes, allows. Try a larger `tolerance` or a "
        "shorter span."
    )
    fit_not_converged = (
        "The fit has not converged in its number of steps, or cannot be improved where its "
        "derivatives jump. Try other `guesses` or a larger `max_steps`."
    )
    nonfinite = (
        "The state, the vector field, the switching function or a reset is not finite (NaN or "
        "inf), or the switching function is too large to be squared."
    )
    step_too_long = (
        "No step from here can be trusted, however often it is halved: the error that the stepper "
        "estimates is too large a part of what the step does to the state. The field is stiff (try "
        "`stepper=jf.Rodas5P()`), or jumps where no surface says so."
    )
    interrupted = "The sweep was interrupted before this lane was finished."
    irreversible_reset = (
        "The motion has met a reset in backward time, which cannot be undone: what was before it "
        "does not follow from what is after it."
    )
    reset_undecided = (
        "No motion goes on from the state that a reset has led to: on its surface, neither a side, "
        "nor sliding, nor rest is consistent with the vector fields there."
    )
    invalid_period = (
        "The forcing period is negative, zero or infinite, so that there is nothing to sample once "
        "in each."
    )
    section_reached = "The run has ended at a section, as it was asked to."
    out_of_bounds = "The motion has left the region that a bound allows."
    section_not_reached = (
        "The motion has not come back to its section as often as asked within the time given: it "
        "has come to rest, or keeps to one side of it. Try a larger `max_return`."
    )


def is_good(result: RESULTS) -> jax.Array:
    """Whether a run has come to the end that it was asked for."""
    return (result == RESULTS.successful) | (result == RESULTS.section_reached)


def is_successful(result: RESULTS) -> bool:
    """Whether a known outcome is `successful`, or all of a batch are: compared in NumPy, as JAX
    would compile a program for each shape."""
    return bool(np.all(np.asarray(_codes(result)) == code(RESULTS.successful)))


def raise_if_failed(value: _Tree, result: RESULTS) -> _Tree:
    """The same value, or an error with the sentence of an outcome that is not `successful`; of a
    batch the one that comes last in the list of members."""
    if is_known(result) and is_successful(result):
        return value
    return raise_outcome(value, result, RESULTS.successful)


def raise_outcome(value: _Tree, result: RESULTS, *good: RESULTS) -> _Tree:
    """The same value, or an error with the sentence of an outcome that is none of the good ones; of
    a batch the one that comes last in the list of members."""
    members = [getattr(RESULTS, name) for name in RESULTS._name_to_item]
    # Compared as numbers: of arrays, each comparison would be a program.
    codes, fine = in_numpy(_codes(result)), {code(member) for member in good}
    bad = [member for member in members if code(member) not in fine]
    return raise_first(value, [(codes == code(member), RESULTS[member]) for member in bad])


def outcome_names(results: RESULTS) -> np.ndarray:
    """The names of outcomes, an array of strings in their shape."""
    # Files and tables hold names: the integers are a matter of the order of the members above.
    names = np.empty(np.shape(results == RESULTS.successful), dtype="<U32")
    for name in RESULTS._name_to_item:
        names[np.asarray(results == getattr(RESULTS, name))] = name
    return names


def outcome_codes(names: np.ndarray) -> np.ndarray:
    """The integers that stand for outcomes of these names, an array in their shape."""
    codes = np.empty(np.shape(names), np.int32)
    for name in np.unique(names):  # by name and not by lane: few outcomes, many lanes
        if name not in RESULTS._name_to_item:
            raise ValueError(
                f"An outcome must be one of {', '.join(RESULTS._name_to_item)}, got {str(name)!r}."
            )
        codes[names == name] = code(getattr(RESULTS, name))
    return codes


def code(outcome: RESULTS) -> int:
    """The integer that stands for an outcome."""
    return int(_codes(outcome))


def _codes(outcome: RESULTS) -> jax.Array:
    (numbers,) = jax.tree.leaves(outcome)  # the one leaf that equinox gives a member
    return numbers


def outcomes(codes: np.ndarray) -> RESULTS:
    """The outcomes that integers stand for."""
    # A member holds one integer array, of shape () itself: a batch of outcomes is one with more.
    return jax.tree.map(lambda _: jnp.asarray(codes), RESULTS.successful)


class EventKind(enum.IntEnum):
    """What happened at a contact: the codes in `Solution.events.kinds`.

    >>> import jaxfil as jf
    >>> jf.EventKind(2).name
    'stick'
    """

    none = 0
    """Padding of the event table."""
    crossing = 1
    """From one side of the surface to the other."""
    stick = 2
    """Onto the surface: sliding begins, or rest after infinitely many impacts."""
    slip = 3
    """Off the surface: sliding or rest ends."""
    impact = 4
    """The state was reset: thrown back, let through, carried off, or brought to rest."""
    graze = 5
    """The surface was touched without a change of mode."""
    tick = 6
    """The state was changed by the tick of a clock."""
    carry = 7
    """The state was carried from one side of the surface to the other, by a reset, a tick or a jump
    of H."""
