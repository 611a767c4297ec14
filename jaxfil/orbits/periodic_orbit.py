"""`periodic_orbit`: a stable or unstable periodic orbit by Newton shooting."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.lane.forcing_phase import differs
from jaxfil.integrate.run.step_choice import StepCount, steps_and_stepper
from jaxfil.integrate.steppers.explicit import Stepper, checked_stepper
from jaxfil.integrate.system.closed_over import with_closed_numbers
from jaxfil.integrate.system.grade import is_compact_run
from jaxfil.model import check
from jaxfil.model.argument import concrete
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.model.types import Scalar, State
from jaxfil.orbits.closing import ClosedOrbit
from jaxfil.orbits.implicit import solve_implicit
from jaxfil.orbits.newton import Root
from jaxfil.orbits.one_sided import is_behind
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.shooting import ShootingOptions, flow_map, starts_from
from jaxfil.xla.known import array_of, compiled_if_traced, without_derivatives
from jaxfil.xla.select import select

# Clocks are whole turns on if they are to this part.
_WHOLE = 1e-6


def periodic_orbit(
    system: System,
    x0: State,
    *,
    periods: int = 1,
    period: Scalar | None = None,
    t0: Scalar = 0.0,
    steps: StepCount = 40,
    stepper: Stepper | None = None,
    segments: int = 1,
    transient: int = 0,
    newton_steps: int = 50,
    max_events: int = 64,
    throw: bool = True,
    compact: bool | None = None,
) -> Orbit:
    """Find the periodic orbit near `x0` by Newton's method, whether it is stable or not.

        x(t0 + T; x0) = x0

    The Jacobian is the derivative of the flow map, exact through every contact. A forced system has
    T = `periods` · `system.period`; for an autonomous one T is an unknown too, with the condition
    that x0 moves at right angles to the field at the guess. A component whose field is zero, such
    as a latch, keeps the value of the guess if no event of the orbit changes it.

    **Arguments**

    - `system`: the `System`.
    - `x0`: a guess of the state at `t0`, shape (n,). For an autonomous system it must lie between
      two contacts: just after an impact, neighbouring states are behind the surface.
    - `periods`: forcing periods after which the orbit closes.
    - `period`: a guess of the period of an autonomous system; None for a forced one. If Newton's
      method converges to a multiple of the period, the prime one is returned; in a batch or under
      `jit` the multiple.
    - `t0`: the initial time, and so the phase of the forcing.
    - `steps`: steps per forcing period, or per period of an autonomous system; or `Adaptive`, a
      tolerance; or the result of `choose_step` for a forced one, which has its own `stepper`.
    - `stepper`: as in `solve`; None is `diffrax.Dopri8()`.
    - `segments`: arcs of multiple shooting, more than one for very unstable orbits.
    - `transient`: forcing periods integrated from `x0` before Newton's method starts, for a poor
      guess of a stable orbit.
    - `newton_steps`: the largest number of evaluations of the period map.
    - `max_events`: the largest number of contacts in a period, the length of the table
      `Orbit.events`.
    - `throw`: whether to raise an error unless the outcome is `successful`.
    - `compact`: as in `solve`.

    **Returns** an `Orbit`. For a batch use `equinox.filter_vmap` with `throw=False`; each lane then
    has its own outcome. The first and second derivatives of `orbit.x0` and `orbit.period` with
    respect to the float leaves of the system follow from the implicit function theorem, forward and
    reverse; all other derivatives are NaN. The phase of an autonomous orbit is arbitrary, and in
    derivatives `x0` stays in the plane through the guess that the search has used, although a new
    search with other parameters uses another one; what does not depend on the phase is exact.

    **Raises** `ValueError` for a `system.period` after which its field, or a clock, is not the same
    as before, if the numbers are known.

    **Outcomes**: `successful`; `newton_stalled`, `newton_singular` or `newton_max_steps_reached`
    without an orbit; `behind_surface` for an orbit with H < 0 at a surface that reflects; and if
    the guess itself cannot be integrated for a period, `nonfinite`,
    `max_steps_reached`, `max_events_reached`, `mode_undecided`, `zeno`, `nonunique`,
    `reset_undecided`, `undeclared_sliding`, `step_too_long` or `invalid_period`.

    **Source**: (multiple) shooting is textbook: R. Seydel, Practical Bifurcation and Stability
    Analysis (2010). Its Jacobian through contacts: R. Leine, H. Nijmeijer, Dynamics and
    Bifurcations of Non-Smooth Mechanical Systems (2004).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> orbit = jf.periodic_orbit(jf.systems.SDOscillator(omega=0.7), jnp.array([3.0, 0.6]))
    >>> print(round(float(orbit.x0[0]), 4), int(orbit.num_events), bool(orbit.stable))
    2.9729 2 True
    """
    x = check.state("x0", x0)
    check.flags(throw=throw)
    if throw:
        check.finite("x0", x)
    dtype = x.dtype
    check.system("system", system)
    system = with_closed_numbers(cast(system, dtype), x)
    autonomous = system.period is None
    if autonomous and system.clocks:
        raise ValueError(
            f"`system` must have a `period`, a common one of its clocks; that of "
            f"{type(system).__name__} is None."
        )
    if autonomous and period is None:
        raise ValueError(
            f"`period` must be a guess of the period, since {type(system).__name__} is autonomous; "
            "got None."
        )
    if not autonomous and period is not None:
        raise ValueError(
            f"`period` must be None, since {type(system).__name__} has a forcing period (use "
            f"`periods`); got {check.told(period)}."
        )
    if not autonomous:
        check.period(system, dtype)
    periods = check.count("periods", periods)
    transient = check.count("transient", transient, least=0)
    if autonomous and (periods > 1 or transient > 0):
        raise ValueError(
            "`periods` and `transient` count forcing periods, and must be 1 and 0 for an "
            f"autonomous system; got {periods} and {transient}."
        )
    guess = jnp.ones((), dtype)
    if autonomous:
        guess = check.scalar("period", period, dtype, positive=True)
    steps, stepper = steps_and_stepper(steps, stepper, system)
    check.number_of_steps(steps, periods=periods, transient=transient)
    stepper = checked_stepper(stepper)
    if not autonomous:
        _check_repeats(system, periods, x)
    options = ShootingOptions(
        t0=check.scalar("t0", t0, dtype),
        steps=steps * periods,
        arcs=check.count("segments", segments),
        stepper=stepper,
        max_events=check.count("max_events", max_events),
        compact=is_compact_run(compact, system, x),
    )
    # Traced, so that another number does not recompile.
    budget = array_of(check.count("newton_steps", newton_steps), jnp.int32)
    settle = array_of(transient, jnp.int32) if transient else None
    orbit = _find(system, x, guess, options, periods, settle, budget)
    return raise_if_failed(orbit, orbit.result) if throw else orbit


def _check_repeats(system: System, periods: int, x: Array) -> None:
    """An error for a period after which the system is not the same, where its numbers are known."""
    name, period = type(system).__name__, concrete(check.period(system, x.dtype))
    if period is None or not np.isfinite(period):
        return
    length = periods * period
    clocks = [concrete(clock.period) for clock in system.clocks]
    turns = np.array([length / clock for clock in clocks if clock is not None])
    if np.any(abs(turns - np.round(turns)) > _WHOLE * turns):
        raise ValueError(
            f"`period` of {name} must be a common one of its clocks, got {period:.6g}; after "
            f"{length:.6g} they have made {', '.join(f'{v:.6g}' for v in turns)} turns."
        )
    if concrete(differs(system, jnp.asarray(length, x.dtype), x)):
        raise ValueError(
            f"`period` of {name} must be a period of its functions, got {period:.6g}; they differ "
            f"after {length:.6g}."
        )


@compiled_if_traced
def _find(
    system: System,
    x0: Array,
    guess: Array,
    options: ShootingOptions,
    periods: int,
    transient: Array | None,
    newton_steps: Array,
) -> Orbit:
    equations = ClosedOrbit(options, newton_steps, periods)
    still, x0, guess = without_derivatives((system, x0, guess))
    z = _first_unknowns(equations, still, x0, guess, transient)
    return _orbit(equations, system, *solve_implicit(equations, system, z))


@eqx.filter_jit
def _first_unknowns(
    equations: ClosedOrbit, system: System, x0: Array, guess: Array, transient: Array | None
) -> Array:
    """The guess, after `transient` periods."""
    options, q = equations.options, jnp.zeros((0,), x0.dtype)
    if system.period is None:
        q = guess[None]
    if transient is not None:
        # One forcing period after the other, so that the phase stays exact.
        steps = options.steps // equations.periods
        one = dataclasses.replace(
            equations, options=dataclasses.replace(options, steps=steps, arcs=1), periods=1
        )
        forward = flow_map(one.problem(system).setting, one.options, q, 1.0)
        x0 = jax.lax.fori_loop(0, transient, lambda i, x: forward(x, i.astype(x.dtype)), x0)
    # The trajectory from the guess gives the other starts; only the last arc does not close.
    starts = starts_from(equations.problem(system).setting, options, x0, q)
    return jnp.append(starts.ravel(), q)


@eqx.filter_jit
def _orbit(equations: ClosedOrbit, system: System, z: Array, root: Root) -> Orbit:
    """The orbit of a solution."""
    problem, shot = equations.problem(system), root.at.aux
    starts, q = problem.split(z)
    _, period = problem.setting(q)
    options, x0 = equations.options, starts[0]
    first_arc = options.problem(system, x0, options.t0, period, arcs=1)
    behind = is_behind(first_arc, x0, shot.first_mode, shot.events)
    found = root.result == RESULTS.successful
    result = RESULTS.where(found & behind, RESULTS.behind_surface, root.result)
    return Orbit(
        x0=x0,
        period=jnp.asarray(period, z.dtype),
        # A shot that ended early has no monodromy matrix.
        monodromy=select(shot.result == RESULTS.successful, shot.monodromy, jnp.nan),
        residual=root.size,
        events=shot.events,
        num_events=shot.num_events,
        first_mode=shot.first_mode,
        result=result,
        system=system,
        starts=starts,
        num_steps=root.num_steps,
        options=options,
    )
