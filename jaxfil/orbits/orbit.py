"""`periodic_orbit`: a periodic orbit by Newton shooting.

A system and a guess of a state on the orbit enter; an `Orbit` leaves, with its monodromy matrix,
Floquet multipliers, contacts and outcome. Stable or unstable makes no difference.
"""

import dataclasses
import functools as ft
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient
from jaxtyping import Array, Complex, Float, Int

from jaxfil.integrate.solution import Dense, Events, Solution
from jaxfil.integrate.solve import solve
from jaxfil.integrate.stepper import checked
from jaxfil.model import check
from jaxfil.model.card import outcome, precision
from jaxfil.model.deprecation import renamed_attribute
from jaxfil.model.outcomes import RESULTS, EventKind
from jaxfil.model.parameter import cast, is_parameter
from jaxfil.model.system import System
from jaxfil.orbits.extremum import largest
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.orbits.shooting import (
    Setting,
    ShootingOptions,
    Shot,
    flow_map,
    shoot,
    starts_from,
    velocity,
)

# An autonomous period below this part of the guess is not looked for.
_SHORTEST = 1 / 16


class Orbit(eqx.Module):
    """A periodic orbit, x(t0 + period) = x(t0) = `x0`.

    `residual` is the largest mismatch of any arc's end with the next one's start, each component
    relative to its largest value on the orbit. Only `x0`, `starts` and `period` have derivatives
    (with respect to the float leaves of the system); those of all else are NaN.
    """

    x0: Float[Array, " n"]
    period: Float[Array, ""]
    monodromy: Float[Array, "n n"]
    residual: Float[Array, ""]
    events: Events | None
    num_events: Int[Array, ""]
    first_mode: Int[Array, " m"]
    result: RESULTS
    system: System
    starts: Float[Array, "M n"]
    num_steps: Int[Array, ""]
    options: ShootingOptions

    plan = renamed_attribute("plan", "options")

    @property
    def multipliers(self) -> Complex[Array, " n"]:
        """Floquet multipliers, the eigenvalues of the monodromy matrix, shape (n,). One of an
        autonomous system's is 1; a sticking orbit has one that is 0."""
        # Where the orbit was not found there are none; LAPACK must not see a NaN.
        fine = jnp.all(jnp.isfinite(self.monodromy), axis=(-2, -1))
        values = jnp.linalg.eigvals(jnp.where(fine[..., None, None], self.monodromy, 0))
        return jnp.where(fine[..., None], values, jnp.nan)

    @property
    def stable(self) -> Array:
        """Whether all multipliers, but an autonomous system's 1, are inside the unit circle."""
        values = self.multipliers
        size = abs(values)
        if self.system.period is None:
            trivial = jnp.argmin(abs(values - 1), axis=-1)[..., None]
            size = jnp.where(jnp.arange(size.shape[-1]) == trivial, 0, size)
        return (jnp.max(size, axis=-1) < 1) & (self.result == RESULTS.successful)

    def states(self, ts: Float[Array, " k"]) -> Float[Array, "k n"]:
        """The states at times of the first period, in order, shape (k, n)."""
        sol = self._solved(1, diffrax.SaveAt(ts=ts))
        assert sol.xs is not None
        return sol.xs

    def extremes(self) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The smallest and the largest value of each component on the orbit, between the steps
        too, each of shape (n,)."""
        return _extremes(self)

    def dense(self) -> Dense:
        """Every step of the first period."""
        return self._solved(1, diffrax.SaveAt(dense=True))._dense

    def trajectory(self, periods: int = 1) -> Solution:
        """The orbit as a `Solution` that holds ten states for each step: a step of high order is
        too long for a straight line."""
        end = self.options.t0 + periods * self.period
        ts = jnp.linspace(self.options.t0, end, 10 * self.options.steps * periods + 1)
        return self._solved(periods, diffrax.SaveAt(ts=ts))

    def plot(self, ax: Any = None) -> Any:
        """Draw the orbit in the plane of its first two components; returns the matplotlib axes."""
        return self.trajectory().plot(ax)

    def _solved(self, periods: int, saveat: diffrax.SaveAt) -> Solution:
        # An array of that length is kept where every step is.
        budget = (self.options.steps + 6 * self.options.max_events) * periods
        return solve(
            self.system,
            self.x0,
            self.options.t0,
            self.options.t0 + periods * self.period,
            self.period / self.options.steps,
            stepper=self.options.stepper,
            saveat=saveat,
            max_events=self.options.max_events * periods,
            max_steps=budget if saveat.dense or saveat.subs.steps else None,
            throw=False,
        )

    def __repr__(self) -> str:
        return _card(self)


def periodic_orbit(
    system: System,
    x0: Float[Array, " n"],
    *,
    periods: int = 1,
    period: Array | float | None = None,
    t0: Array | float = 0.0,
    steps: int = 40,
    stepper: Any = None,
    segments: int = 1,
    transient: int = 0,
    newton_steps: int = 50,
    max_events: int = 64,
    throw: bool = True,
) -> Orbit:
    """The periodic orbit near `x0`, by Newton's method on x(t0 + T; x0) = x0.

    The Jacobian is the derivative of the flow, exact through every contact. A forced system has
    T = `periods` · `system.period`; of an autonomous one T is found too, with the condition that
    x0 moves at right angles to the field at the guess.

    **Arguments**

    - `x0`: a guess of the state at `t0`, shape (n,).
    - `periods`: forcing periods after which the orbit closes.
    - `period`: a guess of the period of an autonomous system.
    - `t0`: the phase of the forcing at which the orbit is looked at.
    - `steps`: steps per forcing period, or per period of an autonomous system.
    - `stepper`: as in `solve`; by default `diffrax.Dopri8()`.
    - `segments`: arcs of multiple shooting, for orbits that are very unstable.
    - `transient`: forcing periods integrated from `x0` before Newton starts, for a poor guess of
      a stable orbit.
    - `newton_steps`: evaluations of the period map at most.
    - `max_events`: contacts in one arc at most.
    - `throw`: raise an error unless the outcome is successful; otherwise return it.

    **Returns** an `Orbit`. For a batch use `equinox.filter_vmap` with `throw=False`: each lane
    then has its own outcome. The derivatives of `orbit.x0` and `orbit.period` with respect to the
    parameters are those of the implicit function theorem, forward and reverse.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> orbit = jf.periodic_orbit(jf.systems.SDOscillator(omega=0.7), jnp.array([3.0, 0.6]))
    >>> print(round(float(orbit.x0[0]), 4), int(orbit.num_events), bool(orbit.stable))
    2.9729 2 True
    """
    x = check.state("x0", x0)
    dtype = x.dtype
    check.system("system", system)
    system = cast(system, dtype)
    autonomous = system.period is None
    if autonomous and period is None:
        raise ValueError(
            f"`period` must be a guess of the period: {type(system).__name__} is autonomous; "
            "got None."
        )
    if not autonomous and period is not None:
        raise ValueError(
            f"`period` must be None: that of {type(system).__name__} is known (use `periods`); "
            f"got {period!r}."
        )
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
    stepper = checked(stepper)
    options = ShootingOptions(
        t0=check.scalar("t0", t0, dtype),
        steps=check.count("steps", steps) * periods,
        arcs=check.count("segments", segments),
        stepper=stepper,
        max_events=check.count("max_events", max_events),
    )
    # Traced: another number compiles nothing.
    budget = jnp.asarray(check.count("newton_steps", newton_steps), jnp.int32)
    settle = jnp.asarray(transient, jnp.int32) if transient else None
    orbit = _find(system, x, guess, options, periods, settle, budget)
    if not throw:
        return orbit
    return orbit.result.error_if(orbit, orbit.result != RESULTS.successful)


@eqx.filter_jit
def _extremes(orbit: Orbit) -> tuple[Array, Array]:
    dense = orbit.dense()
    n = orbit.x0.shape[-1]
    numbers, signs = np.repeat(np.arange(n), 2), np.tile([-1.0, 1.0], n)

    def extreme(i: Array, sign: Array) -> Array:
        return sign * largest(dense, lambda t, x: sign * x[i]).value

    both = jax.vmap(extreme)(jnp.asarray(numbers), jnp.asarray(signs, orbit.x0.dtype))
    return both[0::2], both[1::2]


@eqx.filter_jit
def _find(
    system,
    x0,
    guess,
    options: ShootingOptions,
    periods: int,
    transient: Array | None,
    newton_steps: Array,
) -> Orbit:
    autonomous = system.period is None
    setting = ft.partial(_setting, system, periods)
    q = guess[None] if autonomous else jnp.zeros((0,), x0.dtype)
    if transient is not None:
        # One forcing period after the other: the phase stays exact.
        one = dataclasses.replace(options, steps=options.steps // periods, arcs=1)
        forward = flow_map(ft.partial(_setting, system, 1), one, q, 1.0)
        x0 = jax.lax.fori_loop(0, transient, lambda i, x: forward(x, i.astype(x.dtype)), x0)
    starts = starts_from(setting, options, x0, q)
    z, root = converge(system, options, periods, jnp.append(starts.ravel(), q), newton_steps)
    shot: Shot = root.at.aux
    starts = z[: starts.size].reshape(starts.shape)
    _, period = setting(z[starts.size :])
    return Orbit(
        x0=starts[0],
        period=jnp.asarray(period, x0.dtype),
        # Of a shot that ended early there is none.
        monodromy=jnp.where(shot.result == RESULTS.successful, shot.monodromy, jnp.nan),
        residual=root.at.size,
        events=shot.events,
        num_events=shot.num_events,
        first_mode=shot.first_mode,
        result=root.result,
        system=system,
        starts=starts,
        num_steps=root.num_steps,
        options=options,
    )


def _setting(system: System, periods: int, q: Array) -> tuple[System, Array]:
    if system.period is None:
        return system, q[0]
    return system, jnp.asarray(system.period) * periods


def closing(shot: Shot, starts: Array) -> tuple[Array, Array]:
    """The mismatch of every arc's end with the next one's start, shape (M n,), and its derivative
    with respect to all starts and the global unknowns, shape (M n, M n + k)."""
    m, n = starts.shape
    residual = shot.ends - jnp.roll(starts, -1, axis=0)
    eye = jnp.eye(m, dtype=starts.dtype)
    own = jnp.einsum("ij,iab->iajb", eye, shot.by_start)
    next_ = jnp.einsum("ij,ab->iajb", jnp.roll(eye, 1, axis=1), jnp.eye(n, dtype=starts.dtype))
    by_starts = (own - next_).reshape(m * n, m * n)
    by_global = shot.by_global.reshape(m * n, -1)
    return residual.ravel(), jnp.concatenate([by_starts, by_global], axis=1)


def not_vanished(shot: Shot, period: Array, guess: Array) -> RESULTS:
    """The outcome of an autonomous shot. Every state closes after no time at all: a period far
    below the guess is no answer, and a step towards it is too long."""
    vanished = (shot.result == RESULTS.successful) & (period < _SHORTEST * guess)
    return RESULTS.where(vanished, RESULTS.newton_stalled, shot.result)


def _evaluation(
    setting: Setting, options: ShootingOptions, anchor: Array, normal: Array, guess: Array, z: Array
) -> Evaluation:
    """The closing of all arcs, and for an autonomous system the condition on the phase."""
    m, n = options.arcs, anchor.shape[0]
    starts, q = z[: m * n].reshape(m, n), z[m * n :]
    shot = shoot(setting, options, starts, q)
    residual, jacobian = closing(shot, starts)
    equations = unknowns = jnp.tile(shot.size, m)
    result = shot.result
    if q.shape[0]:
        result = not_vanished(shot, q[0], guess[0])
        row = jnp.concatenate([normal, jnp.zeros(m * n - n + 1, z.dtype)])
        residual = jnp.append(residual, normal @ (starts[0] - anchor))
        jacobian = jnp.concatenate([jacobian, row[None]])
        equations = jnp.append(equations, abs(normal) @ shot.size)
        unknowns = jnp.append(unknowns, abs(q[0]))
    return Evaluation(residual, jacobian, equations, unknowns, result, shot)


def converge(
    system, options: ShootingOptions, periods: int, z: Array, newton_steps: Array
) -> tuple[Array, Root]:
    """Newton's iteration from z. Its end has the derivative of the implicit function; the rest of
    the `Root` has none."""
    theta, unravel = ravel_pytree(eqx.filter(system, is_parameter))
    rest = eqx.filter(system, is_parameter, inverse=True)
    return _implicit(
        theta,
        stop_gradient(z),
        unravel=unravel,
        rest=rest,
        options=options,
        periods=periods,
        newton_steps=newton_steps,
    )


@eqx.filter_custom_jvp
def _implicit(theta, z, *, unravel, rest, options, periods, newton_steps):
    system = eqx.combine(unravel(theta), rest)
    setting = ft.partial(_setting, system, periods)
    autonomous = system.period is None
    n = (z.shape[0] - autonomous) // options.arcs
    normal = velocity(setting, options, z[:n], z[n * options.arcs :]) if autonomous else z[:n]
    size = jnp.sqrt(normal @ normal)
    normal = normal / jnp.where(size == 0, 1, size)
    evaluate = ft.partial(_evaluation, setting, options, z[:n], normal, z[n * options.arcs :])
    root = newton(evaluate, z, newton_steps)
    return root.z, root


@_implicit.def_jvp
def _implicit_jvp(primals, tangents, *, unravel, rest, options, periods, newton_steps):
    theta, z0 = primals
    z, root = _implicit(
        theta,
        z0,
        unravel=unravel,
        rest=rest,
        options=options,
        periods=periods,
        newton_steps=newton_steps,
    )
    nothing = jax.tree.map(
        lambda v: jnp.full_like(v, jnp.nan) if eqx.is_inexact_array(v) else None, root
    )
    if tangents[0] is None:
        return (z, root), (jnp.zeros_like(z), nothing)
    k = int(eqx.combine(unravel(theta), rest).period is None)
    n = (z.shape[0] - k) // options.arcs

    def setting(q):
        return _setting(eqx.combine(unravel(q[k:]), rest), periods, q[:k])

    starts = z[: n * options.arcs].reshape(options.arcs, n)
    shot = shoot(setting, options, starts, jnp.concatenate([z[n * options.arcs :], theta]))
    by_theta = shot.by_global[:, :, k:].reshape(n * options.arcs, -1)
    by_theta = jnp.concatenate([by_theta, jnp.zeros((k, theta.shape[0]), theta.dtype)])
    # All leaves at once, so that the rule is a matrix product, which reverse mode can transpose.
    sensitivity = -jnp.linalg.solve(root.at.jacobian, by_theta)
    return (z, root), (sensitivity @ tangents[0], nothing)


def _card(orbit: Orbit) -> str:
    told = precision(orbit.x0)
    if isinstance(orbit.x0, jax.core.Tracer) or orbit.x0.ndim > 1:
        *batch, n = orbit.x0.shape
        return f"Orbit{told}: a batch of shape {tuple(batch)}, states of {n}"
    show = ft.partial(np.array2string, precision=10, separator=", ")
    lines = [
        f"Orbit of {type(orbit.system).__name__}{told}: {outcome(orbit.result)}",
        f"  period {float(orbit.period):.12g}, x0 = {show(np.asarray(orbit.x0))} at t = "
        f"{float(orbit.options.t0):g}",
        f"  multipliers {show(np.asarray(orbit.multipliers))}: "
        + ("stable" if bool(orbit.stable) else "unstable"),
        f"  {_sequence(orbit)}, residual {float(orbit.residual):.1e} "
        f"after {int(orbit.num_steps)} Newton steps",
    ]
    return "\n".join(lines)


def _sequence(orbit: Orbit) -> str:
    if orbit.events is None or int(orbit.num_events) == 0:
        return "no contacts"
    kinds = np.asarray(orbit.events.kinds)
    return ", ".join(EventKind(k).name for k in kinds[kinds != EventKind.none])
