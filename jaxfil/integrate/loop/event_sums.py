"""Sums over events: a user's function of the states before and after each event, added up.

The sums cover all events in a window of the run.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.lane.extension import Extension, Step, Verdict
from jaxfil.integrate.lane.problem import Problem
from jaxfil.integrate.lane.state import LoopState
from jaxfil.integrate.loop.window import Window
from jaxfil.integrate.system.components import Components, on_each, pack, scalars, where
from jaxfil.integrate.system.lowered import ComponentSystem, ParametrizedFunction
from jaxfil.xla.trace import Traced


class Sums(eqx.Module):
    """The sums so far."""

    numbers: Components


class EventSums(Extension):
    """k sums over events."""

    in_free_steps: ClassVar[bool] = True
    # Events after a jump to the limit of an accumulation would be missed.
    follows_contacts: ClassVar[bool] = True
    function: ParametrizedFunction
    """The contribution of an event to each sum, a function of the time, the components of the state
    before and after it, and flags of surfaces."""
    count: int = eqx.field(static=True)
    """The number k of sums."""
    window: Window

    def begin(self, problem: Problem, state: LoopState) -> tuple[LoopState, Sums]:
        zero = jnp.zeros_like(state.motion.tau)
        return state, Sums(Components((zero,) * self.count))

    def after_step(
        self,
        problem: Problem,
        state: LoopState,
        after: LoopState,
        own: Sums,
        step: Step,
        verdict: Verdict | None,
    ) -> tuple[LoopState, Sums]:
        before, behind = state.motion, step.end.motion
        # A switch that is taken back is not `made`, so each event is added once.
        counts = step.made & self.window.is_open(state)
        # The function was traced with flags that are numbers of the run's precision (`event_sums`).
        members = step.end.members.astype(problem.system.dtype)
        # At a switch `before` is the corrected state of the landing, before its reset.
        at = problem.grid.t0 + before.tau, before.x, behind.x, members

        def added(so_far: Components, *at: Any) -> Components:
            # The branch is common to all lanes of a batch, hence the selection by lane.
            return where(counts, so_far + self.function(*at), so_far)

        def same(so_far: Components, *at: Any) -> Components:
            return so_far

        numbers = problem.system.where_any(counts, added, same, own.numbers, *at)
        if problem.system.ticks and problem.ticked is not None:
            idle = step.switched & ~step.made & (problem.ticked >= 0) & self.window.is_open(state)

            def varied(so_far: Components, *at: Any) -> Components:
                return where(idle, so_far + self._variation(*at), so_far)

            numbers = problem.system.where_any(idle, varied, same, numbers, *at)
        return after, Sums(numbers)

    def _variation(
        self, t: Array, before: Components, after: Components, members: Components
    ) -> Components:
        """Zeros with the derivatives of what a tick adds, for a tick that changes no number and is
        therefore no event, as of a dose of zero."""

        def added(after: Components) -> Components:
            return self.function(t, before, after, members)

        change = after - before
        # A function such as a distance has no derivative where its two states are equal; 0·∞ = NaN.
        equal, slope = jax.jvp(added, (before,), (0.0 * before,))
        variation = added(before + (change - stop_gradient(change))) - equal
        return where(on_each(jnp.isfinite, equal + slope), variation, 0.0)


def event_sums(
    function: Callable[..., Array],
    count: int,
    system: ComponentSystem,
    x0: Array,
    h_shape: tuple[int, ...],
    window: Window,
) -> EventSums:
    """The sums of a function (t, before, after, surfaces) that returns an array of `count` numbers,
    over the events of runs from states like `x0`. `h_shape` is the shape of `System.switching`."""
    # Arrays in the function are parameters, like the arrays of a system, and not constants.
    leaves, static = eqx.partition(function, eqx.is_array)
    dtype, x, t0 = x0.dtype, system.unpack(x0), jnp.zeros((), x0.dtype)

    def on_components(
        leaves: Any, t: Array, before: Components, after: Components, members: Components
    ) -> Components:
        # The function receives arrays, states of shape (n,) and flags of the shape of H.
        flags = pack(members, dtype).reshape(h_shape)
        states = pack(before, dtype), pack(after, dtype)
        numbers = eqx.combine(leaves, static)(t, *states, flags)
        return Components(scalars(jnp.asarray(numbers, dtype)))

    nowhere = system.for_each_surface(jnp.zeros((), dtype))
    traced = Traced(on_components, leaves, t0, x, x, nowhere, fast=not system.compact)
    return EventSums(ParametrizedFunction.of(traced, leaves, system.fence), count, window)
