"""Outcomes and events.

`RESULTS` is the enumeration of outcomes of all functions; each member has a sentence for the user.
`EventKind` has the codes of the event table.
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
    """The metaclass of `RESULTS`, which lists its members."""

    def __dir__(cls) -> list[str]:
        return [*super().__dir__(), *cls._name_to_item]  # pyright: ignore[reportAttributeAccessIssue]

    def names(cls, results: Any) -> np.ndarray:
        """The names of outcomes, an array of strings in their shape (see `RESULTS`)."""
        return outcome_names(results)


class RESULTS(eqx.Enumeration, metaclass=_Outcomes):
    """The way a lane ended. `successful` is the only good outcome, except `section_reached` of a
    run that was requested to end at a section.

    A result has its outcome in `result`, or one for each lane in `results`. The value of a member
    is a sentence for the user: `jf.RESULTS[sol.result]`. Compare outcomes by `==`, under `jit` too.
    `jf.RESULTS.names(diagram.results)` is an array of the names of all lanes, in their shape.
    Outcomes themselves cannot be indexed.

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
    - Of sweeps, orbits and exponents, which count forcing periods, and of every integration with
      clocks: `invalid_period`.

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
        "`max_steps`, or, if steps are halved (`stats`) because the field is stiff, "
        "`stepper=jf.Rodas5P()`."
    )
    max_events_reached = (
        "The event table, or the table of crossings of sections, is full. Try a larger "
        "`max_events`, or `max_events=None` for no table."
    )
    mode_undecided = (
        "No mode of motion continues the solution at a contact, since neither side nor sliding "
        "is consistent with the vector fields there."
    )
    zeno = (
        "Infinitely many contacts happen in a finite time (Zeno behaviour), without a rule for the "
        "motion after them. The solution was followed up to that time."
    )
    nonunique = (
        "The solution is not unique from here: a repelling sliding region, a two-fold or a corner "
        "from which several motions leave (in backward time every attracting slide is one)."
    )
    undeclared_sliding = (
        "The solution reaches an attracting sliding region, but the system says `slides = False`."
    )
    newton_stalled = (
        "Newton's method cannot reduce the residual any further. Perhaps there is no solution near "
        "the guess. Try a better guess, more `steps`, or more `segments`."
    )
    newton_singular = (
        "The Jacobian of Newton's method is singular: a fold, a bifurcation point, or a family of "
        "solutions (one more equation is needed)."
    )
    newton_max_steps_reached = (
        "Newton's method has not converged in its number of steps. Try a larger `newton_steps`."
    )
    behind_surface = (
        "The orbit lies behind a surface that throws back, where H < 0, which no motion reaches "
        "from H ≥ 0. Start from a guess with H > 0."
    )
    no_tangency_found = (
        "The orbit has no approach to a surface, or no contact with it, that could become a "
        "bifurcation of the requested kind."
    )
    other_kind = "A bifurcation was located, but it is of another kind than requested."
    orbit_lost = (
        "Newton's method has converged to a point that is not an orbit of the system. It reaches a "
        "surface elsewhere, so that the orbit ends or changes before its tangency."
    )
    not_nearest = (
        "The point is on the grazing set, but does not minimise the distance, since neighbouring "
        "points of the set are nearer. Start from an orbit closer to the set."
    )
    tolerance_not_met = (
        "No number of steps that was tried meets the tolerance, which is below the limit set by "
        "rounding or by a sensitive motion. Try a larger `tolerance` or a shorter span."
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
        "No step from here can be trusted, however often it is halved, since the error that the "
        "stepper estimates is too large relative to the change of the state. The field is stiff "
        "(try `stepper=jf.Rodas5P()`), or jumps where no surface is declared. A kink of a "
        "switching function is such a jump for a slide on it. For `harmonic_balance` more "
        "contacts or ticks are in one part of its grid than it resolves (try more `harmonics`)."
    )
    interrupted = "The sweep was interrupted before this lane was finished."
    irreversible_reset = (
        "The motion has reached a reset in backward time, which cannot be reversed, since the "
        "state before it does not follow from the state after it."
    )
    reset_undecided = (
        "No admissible motion continues from the state after the reset, since on its surface "
        "neither a side, nor sliding, nor rest is consistent with the vector fields there; or the "
        "derivative of the reset, from which a rest follows, is not finite there."
    )
    invalid_period = (
        "The period of the forcing or of a clock is negative, zero or infinite, so that the motion "
        "cannot be sampled once per period, or has no ticks."
    )
    section_reached = "The run has ended at a section, as requested."
    out_of_bounds = "The motion has left the region that a bound allows."
    section_not_reached = (
        "The motion has not come back to its section as often as requested within the given time. "
        "It has come to rest, or stays on one side of it. Try a larger `max_return`."
    )


def is_good(result: RESULTS) -> jax.Array:
    """Whether a run has reached its requested end."""
    return (result == RESULTS.successful) | (result == RESULTS.section_reached)


def is_successful(result: RESULTS) -> bool:
    """Whether a known outcome, or all of a batch, is `successful`. Compared in NumPy, because JAX
    would compile a program for each shape."""
    return bool(np.all(np.asarray(_codes(result)) == code(RESULTS.successful)))


def raise_if_failed(value: _Tree, result: RESULTS) -> _Tree:
    """The same value, or an error with the sentence of an outcome other than `successful`; for a
    batch the last one in the list of members."""
    if is_known(result) and is_successful(result):
        return value
    return raise_outcome(value, result, RESULTS.successful)


def raise_outcome(value: _Tree, result: RESULTS, *good: RESULTS) -> _Tree:
    """The same value, or an error with the sentence of an outcome that is not in `good`; for a
    batch the last one in the list of members."""
    members = [getattr(RESULTS, name) for name in RESULTS._name_to_item]
    # Compared as numbers, because each comparison of arrays would be a program.
    codes, fine = in_numpy(_codes(result)), {code(member) for member in good}
    bad = [member for member in members if code(member) not in fine]
    return raise_first(value, [(codes == code(member), RESULTS[member]) for member in bad])


def outcome_names(results: RESULTS) -> np.ndarray:
    """The names of outcomes, an array of strings in their shape."""
    # Files and tables hold names, because the integers depend on the order of the members above.
    names = np.empty(np.shape(results == RESULTS.successful), dtype="<U32")
    for name in RESULTS._name_to_item:
        names[np.asarray(results == getattr(RESULTS, name))] = name
    return names


def outcome_codes(names: np.ndarray) -> np.ndarray:
    """The integers of outcomes with these names, an array in their shape."""
    codes = np.empty(np.shape(names), np.int32)
    for name in np.unique(names):  # by name instead of lane: few outcomes, many lanes
        if name not in RESULTS._name_to_item:
            raise ValueError(
                f"An outcome must be one of {', '.join(RESULTS._name_to_item)}, got {str(name)!r}."
            )
        codes[names == name] = code(getattr(RESULTS, name))
    return codes


def code(outcome: RESULTS) -> int:
    """The integer of an outcome."""
    return int(_codes(outcome))


def _codes(outcome: RESULTS) -> jax.Array:
    (numbers,) = jax.tree.leaves(outcome)  # the one leaf that equinox gives a member
    return numbers


def outcomes(codes: np.ndarray) -> RESULTS:
    """The outcomes with these integers."""
    # A member holds one integer array of shape (); a batch of outcomes has a larger shape.
    return jax.tree.map(lambda _: jnp.asarray(codes), RESULTS.successful)


class EventKind(enum.IntEnum):
    """The kind of an event, the codes in `Solution.events.kinds`.

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
