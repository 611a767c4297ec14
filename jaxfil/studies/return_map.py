"""The Poincaré map, from a state to the next crossing of a section."""

import dataclasses
import functools as ft

import diffrax
import equinox as eqx
import jax
from jaxtyping import Float, Int

from jaxfil.integrate.run.options import Adjoint
from jaxfil.integrate.run.solution import Solution
from jaxfil.integrate.run.solve import solve
from jaxfil.integrate.run.step_choice import StepLength
from jaxfil.integrate.steppers.explicit import Stepper
from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.runtime_error import raise_first
from jaxfil.model.section import Section
from jaxfil.model.system import System
from jaxfil.model.types import Scalar, States


class Returns(eqx.Module):
    """Crossings at which motions return to a section, for one state or a batch of any shape."""

    xs: Float[jax.Array, "*batch n"]
    """States at the crossings; final states where `result` is not `section_reached`."""
    ts: Float[jax.Array, "*batch"]
    """Times of the crossings."""
    result: RESULTS
    """The outcome of each run."""
    num_events: Int[jax.Array, "*batch"]
    """Number of contacts before the crossing."""


def poincare_map(
    system: System,
    x0: States,
    section: Section,
    dt: StepLength,
    *,
    max_time: Scalar,
    t0: Scalar = 0.0,
    returns: int = 1,
    stepper: Stepper | None = None,
    adjoint: Adjoint = diffrax.ForwardMode(),  # noqa: B008
    throw: bool = True,
) -> Returns:
    r"""Follow motions to their next crossing of a section: the first return map.

    $$P(x_0) = \varphi_{\tau}(x_0), \qquad \tau = \min\{t > 0 : S(\varphi_t(x_0)) = 0\}$$

    Crossings count in the direction of the section. A state on it is mapped to its return, any
    other state to its first arrival. Derivatives, by `jax.jacfwd` or `jax.grad`, are exact: the
    flow's, projected along the field onto the section, through all contacts.

    The limit of steps is no argument here. It grows with the number of steps in `max_time`, so that
    a smaller `dt` raises it where contacts or halved steps are too many; with a tolerance it is
    fixed, and a larger tolerance needs fewer steps, as `Rodas5P()` does for a stiff field.

    **Arguments**

    - `system`, `dt`, `t0`, `stepper`, `adjoint`, `throw`: as in `solve`.
    - `x0`: the state, shape (n,), or a batch of them, shape (…, n).
    - `section`: a `Section`; its `terminal` is ignored.
    - `max_time`: the longest time of a motion; backward if negative.
    - `returns`: the number of the crossing to stop at, such as 2 for the second return.

    **Returns** `Returns`: states `xs`, shape (…, n), and times `ts`.

    **Outcomes**: `section_reached`; `successful` for a motion that did not return in time, an error
    with `throw=True`; for a motion that cannot continue `max_steps_reached`, `nonfinite`,
    `step_too_long`, `nonunique`, `mode_undecided`, `undeclared_sliding`, `zeno`,
    `reset_undecided` and, in backward time, `irreversible_reset`.

    **Source**: J. Guckenheimer and P. Holmes, Nonlinear Oscillations, Dynamical Systems, and
    Bifurcations of Vector Fields, Springer (1983), section 1.5.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> oscillator, top = jf.systems.CoulombOscillator(), jf.maxima(lambda t, x: x[0])
    >>> starts = jnp.array([[3.0, 0.0], [2.5, 0.0]])
    >>> back = jf.poincare_map(oscillator, starts, top, 0.1, max_time=7.0, stepper=jf.RK4())
    >>> [round(float(x), 3) for x in back.xs[:, 0]]
    [1.4, 0.9]
    """
    last = check.count("returns", returns)
    check.instance("section", section, Section)
    check.flags(throw=throw)
    states = check.states("x0", x0)
    # A number is not converted, so that it stays known under `jit`.
    check.scalar("t0", t0, states.dtype)
    check.scalar("max_time", max_time, states.dtype)
    there = dataclasses.replace(section, terminal=last)

    def run(x: jax.Array) -> Returns:
        sol = solve(
            system,
            x,
            t0,
            t0 + max_time,  # pyright: ignore[reportOperatorIssue]
            dt,
            stepper=stepper,
            max_events=None,
            adjoint=adjoint,
            throw=throw,
            sections=there,
        )
        sol = _back(sol) if throw else sol
        return Returns(sol.x_final, sol.t_final, sol.result, sol.num_events)

    return ft.reduce(lambda f, _: jax.vmap(f), range(states.ndim - 1), run)(states)


def _back(sol: Solution) -> Solution:
    """The same solution, or an error if it has not returned."""
    told = "`max_time` must be longer, since a motion has not returned to the section within it."
    return raise_first(sol, [(sol.result == RESULTS.successful, told)])
