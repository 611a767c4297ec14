"""`choose_step`: the cheapest stepper and step that satisfy a tolerance for a given system.

The steps of each stepper are doubled until its error is small enough and its ends are those of the
others; numbers of steps between the last two are then tried. All errors are relative to one
reference, finer than all runs.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.run.solve import solve
from jaxfil.integrate.run.step_choice import StepChoice
from jaxfil.integrate.steppers.explicit import RK4, Stepper, checked_steppers, tableau_of
from jaxfil.model import check
from jaxfil.model.outcomes import (
    RESULTS,
    outcome_codes,
    outcome_names,
    outcomes,
    raise_if_failed,
)
from jaxfil.model.parameter import cast, replace_parameter, scalar_parameter
from jaxfil.model.system import System
from jaxfil.model.types import Scalar, State, States, SweptValues
from jaxfil.studies.timing import median_seconds
from jaxfil.xla.thresholds import SAME_END

# Initial number of steps of a search, in a forcing period or the whole span.
_FIRST = 4
# Numbers of steps tried between two that differ by a factor of two. At order eight the errors of
# neighbours also differ by a factor of two.
_BETWEEN = 7
# The reference is refined until doubling its steps changes it by this fraction of the tolerance.
_FINE = 1e-2
# Number of calls of which the median run time is taken.
_REPEATS = 3
# The largest number of steps of a lane.
_MOST = 2**22
_STEPPERS = (RK4(), diffrax.Tsit5(), diffrax.Dopri8())


@dataclasses.dataclass(frozen=True)
class _Run:
    """All lanes at one number of steps: their ends, the first outcome other than `successful`, and
    the run time of one lane."""

    xs: np.ndarray
    outcome: str
    seconds: float

    def distance(self, other: "_Run") -> float:
        """The largest distance between the ends of two runs, relative to the size of the other's;
        inf if a lane of either has no end."""
        if {self.outcome, other.outcome} != {"successful"}:
            return np.inf
        size = np.max(abs(other.xs), axis=1)
        apart = np.max(abs(self.xs - other.xs), axis=1)
        return float(np.max(apart / np.where(size == 0, 1, size)))


class _Ladder:
    """The runs of one stepper, by their numbers of steps."""

    def __init__(self, stepper: Stepper, run: Callable[[int], _Run], most: int):
        self.stepper, self.most, self.runs = stepper, most, dict[int, _Run]()
        self._run = run

    def at(self, steps: int) -> _Run:
        """The run with this number of steps."""
        if steps not in self.runs:
            self.runs[steps] = self._run(steps)
        return self.runs[steps]

    @property
    def finest(self) -> int:
        """The largest number of steps so far."""
        return max(self.runs)

    def change(self, steps: int) -> float:
        """The change of the ends when the number of steps was doubled to `steps`."""
        return self.runs[steps // 2].distance(self.runs[steps]) if steps > _FIRST else np.inf

    def double_until(self, small: float) -> None:
        """Double the steps until this changes the ends by at most `small` or by rounding, or
        reaches the largest number."""
        steps = max(self.runs, default=_FIRST // 2)
        while 2 * steps <= self.most:
            steps *= 2
            self.at(steps)
            change, before = self.change(steps), self.change(steps // 2)
            # A change that is at least half of the previous one may consist of rounding.
            rounding = SAME_END * float(np.finfo(self.runs[steps].xs.dtype).eps)
            if change <= small or 0.5 * before <= change <= rounding:
                return

    def settled(self, small: float) -> list[int]:
        """The numbers of steps from which on each doubling changed the ends by at most `small`, or
        all if the last one changed them more. A single small change among large ones is a
        coincidence."""
        doubled = sorted(s for s in self.runs if s > _FIRST)
        large = [k for k, steps in enumerate(doubled) if not self.change(steps) <= small]
        return doubled[max(large, default=-1) + 1 :] or doubled

    def enough(self, reference: _Run, tolerance: float) -> int | None:
        """The least number of steps from which on all runs satisfy the tolerance, or None."""
        found = None
        for steps in sorted(self.runs, reverse=True):
            if not self.runs[steps].distance(reference) <= tolerance:
                break
            found = steps
        return found

    def refine(self, reference: _Run, tolerance: float) -> None:
        """Try numbers of steps just below the sufficient one."""
        found = self.enough(reference, tolerance)
        if found is None or found == _FIRST:
            return
        between = 0.5 * found * 2 ** (np.arange(1, _BETWEEN + 1) / (_BETWEEN + 1))
        for steps in sorted({round(v) for v in between} - {found // 2, found}, reverse=True):
            if not self.at(steps).distance(reference) <= tolerance:
                return


def choose_step(
    system: System,
    x0: State | States,
    t0: Scalar,
    t1: Scalar,
    *,
    tolerance: float = 1e-8,
    steppers: Sequence[Stepper] | None = None,
    parameter: str | None = None,
    values: SweptValues | None = None,
    throw: bool = True,
) -> StepChoice:
    """Find the cheapest stepper and number of steps whose error at t1 is below a tolerance.

        max_i |x_i(t1) − reference_i|  ≤  tolerance · max_i |reference_i|   in every lane

    Errors are measured instead of estimated from step to step, and include the errors of
    contacts. A number of steps is chosen only if all larger ones that were tried also satisfy the
    tolerance. Steppers that end in different states are refined until they agree, since the ends
    of one whose steps miss a brief pulse do not change. Each stepper is compiled once.

    **Arguments**

    - `system`: a `System`, forced or not.
    - `x0`: the initial state, shape (n,), or one for each lane, shape (p, n).
    - `t0`, `t1`: the span of time. Errors grow with it; choose a span similar to the intended runs,
      but short enough that a chaotic motion still depends on its initial state.
    - `tolerance`: the largest error, relative to the size of x(t1), positive.
    - `steppers`: candidates, as in `solve`; by default `RK4()`, and `Tsit5()` and `Dopri8()` of
      diffrax. For stiff fields `[jf.Rodas5P()]`.
    - `parameter`, `values`: a parameter and a few of its values, shape (p,), one lane each, such as
      values of an intended sweep that include its ends.
    - `throw`: whether to raise an error unless the outcome is `successful`.

    **Returns** a `StepChoice`, accepted by other functions as `dt` or `steps`.

    **Outcomes**: `successful`; `tolerance_not_met`, with the most accurate run; if no run reached
    t1, the outcome of the last run: `max_steps_reached`, `zeno`,
    `nonunique`, `mode_undecided`, `reset_undecided`, `undeclared_sliding`, `nonfinite` or
    `step_too_long`.

    **Source**: work–precision diagrams: Hairer, Nørsett and Wanner, Solving Ordinary Differential
    Equations I, Springer 1993, section II.10.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> scene, x0 = jf.systems.RotatingOscillator(), jnp.array([0.36787944117144233, 0.0])
    >>> choice = jf.choose_step(scene, x0, 0.0, 2.0, tolerance=1e-4, steppers=[jf.RK4()])
    >>> sol = jf.solve(scene, x0, 0.0, 2.0, choice)
    >>> bool(abs(sol.xs[-1] - jnp.array([jnp.e, 0.0])).max() < 1e-4 * jnp.e)
    True
    """
    check.system("system", system)
    check.flags(throw=throw)
    wanted = float(check.scalar("tolerance", tolerance, float, positive=True))
    lanes = _Lanes(system, x0, t0, t1, parameter, values)
    ladders = [_Ladder(s, lanes.runner(s), lanes.most) for s in _checked(steppers)]
    for ladder in ladders:
        ladder.double_until(wanted)
    apart = _agreement(ladders, wanted)
    # The reference uses the stepper that got there with the fewest steps, of the highest order.
    best = min(ladders, key=lambda v: (min(v.change(v.finest), wanted), v.finest))
    best.double_until(_FINE * wanted)
    fine = min(best.settled(wanted), key=best.change)
    reference, known = best.runs[fine], max(best.change(fine), apart)
    for ladder in ladders:
        ladder.refine(reference, wanted)
    choice = _choice(ladders, lanes, reference, known, wanted)
    if throw:
        raise_if_failed(choice.errors, choice.result)
    return choice


def _agreement(ladders: list[_Ladder], small: float) -> float:
    """Double the steps of the coarser of two steppers whose ends have settled to `small`, but not
    on each other's, until all agree; the remaining distance where that needs too many steps,
    otherwise 0."""
    while True:
        settled = [v for v in ladders if v.change(v.finest) <= small]
        # Each is off by at most the change of its last doubling, if that shows its error.
        apart = [
            (distance, min(a, b, key=lambda v: v.finest))
            for a, b in itertools.combinations(settled, 2)
            if (distance := a.runs[a.finest].distance(b.runs[b.finest])) > 2 * small
        ]
        finer = [ladder for _, ladder in apart if 2 * ladder.finest <= ladder.most]
        if not finer:
            return max((distance for distance, _ in apart), default=0.0)
        min(finer, key=lambda v: v.finest).double_until(small)


def _checked(steppers: Any) -> tuple[Stepper, ...]:
    if steppers is None:
        return _STEPPERS
    return checked_steppers("steppers", steppers)


class _Lanes:
    """The lanes for which the choice must be good: parameters, initial states and the span."""

    def __init__(
        self,
        system: System,
        x0: Any,
        t0: Any,
        t1: Any,
        parameter: Any,
        values: Any,
    ):
        states = jnp.atleast_2d(check.states("x0", x0))
        n, dtype = states.shape[-1], states.dtype
        self.system = cast(system, dtype)
        self.forced = system.period is not None
        if parameter is not None:
            scalar_parameter(self.system, parameter)
        if (parameter is None) != (values is None):
            raise ValueError(
                "`values` must be given together with `parameter`, got "
                f"{check.told(values)} and {check.told(parameter)}."
            )
        swept = jnp.zeros(1, dtype)
        if values is not None:
            must = "real numbers of shape (p,) with p ≥ 1"
            swept = jnp.atleast_1d(check.numbers("values", values, dtype, must))
        count = max(swept.shape[0], states.shape[0])
        if swept.ndim > 1 or states.ndim > 2 or {swept.shape[0], states.shape[0]} - {1, count}:
            raise ValueError(
                "`values` must be of shape (p,), as many as there are states, got "
                f"{swept.shape} and states of shape {states.shape}."
            )
        self.parameter = parameter
        self.x0 = jnp.broadcast_to(states, (count, n))
        self.values = jnp.broadcast_to(swept, (count,))
        self.span = check.scalar("t0", t0, dtype), check.scalar("t1", t1, dtype)
        length = abs(float(self.span[1] - self.span[0]))
        if not 0 < length < np.inf:
            raise ValueError(f"`t1` must differ from `t0` and be finite, got {t1} and {t0}.")
        units = np.asarray(jax.vmap(self._unit)(self.values))
        # Steps are counted per period; a lane of many periods has a multiple of them.
        self.most = int(_MOST / max(1.0, float(np.max(length / units))))

    def _of(self, value: Array) -> System:
        if self.parameter is None:
            return self.system
        return replace_parameter(self.system, self.parameter, value)

    def _unit(self, value: Array) -> Array:
        """The unit of time in which steps are counted."""
        period = self._of(value).period
        return abs(self.span[1] - self.span[0]) if period is None else jnp.asarray(period)

    def dt(self, steps: int) -> float:
        """The length of a step for the parameters of the system itself."""
        period = self.system.period
        unit = abs(self.span[1] - self.span[0]) if period is None else period
        return float(unit) / steps

    def runner(self, stepper: Stepper) -> Callable[[int], _Run]:
        """A compiled program of all lanes, as a function of the number of steps."""

        def one(value: Array, x0: Array, steps: Array) -> tuple[Array, RESULTS]:
            system = self._of(value)
            dt = self._unit(value) / steps
            sol = solve(system, x0, *self.span, dt, stepper=stepper, max_events=None, throw=False)
            return sol.x_final, sol.result

        program = eqx.filter_jit(eqx.filter_vmap(one, in_axes=(0, 0, None)))
        dtype = self.x0.dtype

        def run(steps: int) -> _Run:
            number = jnp.asarray(steps, dtype)
            # The first call compiles, or warms up.
            xs, results = program(self.values, self.x0, number)
            seconds = median_seconds(lambda: program(self.values, self.x0, number), _REPEATS)
            names = outcome_names(results)
            failed = [str(name) for name in names if name != "successful"]
            return _Run(np.asarray(xs), (failed or ["successful"])[0], seconds / len(names))

        return run


def _choice(
    ladders: list[_Ladder], lanes: _Lanes, reference: _Run, known: float, tolerance: float
) -> StepChoice:
    """The cheapest sufficient run; otherwise the most accurate run."""
    width = max(len(ladder.runs) for ladder in ladders)
    counts = np.zeros((len(ladders), width), int)
    errors, times = np.full((2, len(ladders), width), np.nan)
    for i, ladder in enumerate(ladders):
        for k, steps in enumerate(sorted(ladder.runs)):
            run = ladder.runs[steps]
            away = run.distance(reference)
            counts[i, k], times[i, k] = steps, run.seconds
            errors[i, k] = away if np.isfinite(away) else np.nan
    enough = [(ladder, ladder.enough(reference, tolerance)) for ladder in ladders]
    good = [(v.runs[s].seconds, k, s) for k, (v, s) in enumerate(enough) if s is not None]
    met = bool(good) and known <= tolerance
    if good:
        _, which, steps = min(good)
    else:
        ranks = np.where(np.isnan(errors), np.inf, errors)
        which, column = np.unravel_index(int(np.argmin(ranks)), ranks.shape)
        steps = int(counts[which, column])
    chosen = ladders[which]
    why = "successful" if met else "tolerance_not_met"
    if not met and np.isnan(errors).all():
        why = chosen.runs[chosen.finest].outcome
    return StepChoice(
        stepper=chosen.stepper,
        steps=steps,
        dt=lanes.dt(steps),
        error=chosen.runs[steps].distance(reference),
        seconds=chosen.runs[steps].seconds,
        tolerance=tolerance,
        result=outcomes(outcome_codes(np.array(why))),
        forced=lanes.forced,
        steppers=tuple(tableau_of(ladder.stepper).name for ladder in ladders),
        counts=counts,
        errors=errors,
        times=times,
        reference=reference.xs,
        reference_error=known,
    )
