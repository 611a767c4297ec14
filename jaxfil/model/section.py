"""Sections, extrema and bounds, observations that do not change the motion.

A run locates the zeros of a `Section` as it locates contacts.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.model import argument, check
from jaxfil.model.observe import Observe, asked_of
from jaxfil.model.system import System

_DIRECTIONS = (-1, 0, 1)


class Section(eqx.Module):
    r"""A Poincaré section: the zeros of a function of time and state.

    $$\Sigma = \{(t, x) : S(t, x) = 0\}$$

    A crossing is a change of sign of S along the motion, beyond rounding. A start on the section, a
    touch, and an impact that reflects the motion are not crossings. A crossing at t1 belongs to the
    run. If S jumps across zero, by an impact or a change of the field, this is a crossing at that
    time; each reset of an avalanche may be one.

    **Arguments**

    - `function`: S, a function of the time, shape (), and the state, shape (n,), that returns a
      scalar. Arguments named `side`, `reaction` and `mode` receive these, each of the shape of H,
      as in the observed functions of `solve`. On a slide S is the blend of both sides. It may be
      an equinox module, whose float leaves then have derivatives and may change without a new
      program.
    - `direction`: +1 for crossings where S grows with time, −1 where it falls, 0 for both.
    - `terminal`: the number of the crossing of this section at which the run ends, with the outcome
      `section_reached`; None to continue to the end.

    **Raises** `ValueError` for another direction, or a `terminal` that is not a positive integer.

    **Source**: M. Hénon, On the numerical computation of Poincaré maps, Physica D 5 (1982) 412–414.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> oscillator = jf.piecewise(
    ...     lambda t, x: jnp.stack([x[1], -x[0]]), lambda t, x: jnp.stack([x[1], -4 * x[0]]),
    ...     lambda t, x: x[0])
    >>> upward = jf.Section(lambda t, x: x[0], direction=1)
    >>> sol = jf.solve(oscillator, jnp.array([0.0, 1.0]), 0.0, 10.0, 0.1, sections=upward)
    >>> [round(float(t), 4) for t in sol.crossings.ts[:2]]  # multiples of π + π/2
    [4.7124, 9.4248]
    """

    function: Observe
    """The function S."""
    direction: int = eqx.field(static=True, default=0)
    """+1, −1, or 0 for both."""
    terminal: int | None = eqx.field(static=True, default=None)
    """The number of the crossing at which a run ends."""
    of_rate: bool = eqx.field(static=True, default=False, kw_only=True)
    """Whether S is the rate of the function along the motion, as in `maxima`."""
    is_bound: bool = eqx.field(static=True, default=False, kw_only=True)
    """Whether a crossing is a failure, as in `bound`."""

    def __check_init__(self):
        argument.function("function", self.function, "(t, x)")
        if not argument.is_whole(self.direction) or self.direction not in _DIRECTIONS:
            was = argument.told(self.direction)
            raise ValueError(f"`direction` must be +1, −1 or 0, got {was}.")
        argument.count("terminal", self.terminal, optional=True)
        argument.flags(of_rate=self.of_rate, is_bound=self.is_bound)


Sections = Section | Sequence[Section]
"""One section, or several."""


def maxima(function: Observe, terminal: int | None = None) -> Section:
    """The section at which a function of time and state has a maximum along the motion.

        d/dt f(t, x(t)) = ∂f/∂t + ∇f·F = 0, falling

    Where the field or the state jumps, the rate may change its sign at once. Such a corner of f is
    a maximum too.

    **Arguments**

    - `function`: f, as in `Section`.
    - `terminal`: as in `Section`.

    **Returns** a `Section`.

    **Source**: M. Hénon, On the numerical computation of Poincaré maps, Physica D 5 (1982) 412–414.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> sol = jf.solve(
    ...     jf.systems.CoulombOscillator(), jnp.array([-3.0, 0.0]), 0.0, 9.0, 0.1,
    ...     sections=jf.maxima(lambda t, x: x[0]))
    >>> round(float(sol.crossings.xs[0, 0]), 6)  # an amplitude less by 2F, F = 0.4
    2.2
    """
    return Section(function, -1, terminal, of_rate=True)


def minima(function: Observe, terminal: int | None = None) -> Section:
    """The section at which a function of time and state has a minimum along the motion.

        d/dt f(t, x(t)) = ∂f/∂t + ∇f·F = 0, growing

    **Arguments**

    - `function`, `terminal`: as in `maxima`.

    **Returns** a `Section`.

    **Source**: M. Hénon, On the numerical computation of Poincaré maps, Physica D 5 (1982) 412–414.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> sol = jf.solve(
    ...     jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0]), 0.0, 9.0, 0.1,
    ...     sections=jf.minima(lambda t, x: x[0]))
    >>> round(float(sol.crossings.xs[0, 0]), 6)
    -2.2
    """
    return Section(function, 1, terminal, of_rate=True)


def bound(function: Observe) -> Section:
    """A bound of the region f(t, x) ≥ 0. A run that leaves it, forward or backward in time, or
    starts outside, ends there. A start on the bound is inside.

    The outcome is `out_of_bounds`, which is not a success. It distinguishes, for example, an
    overturned block or a diverging voltage from a run that reached its end.

    **Arguments**

    - `function`: f, as in `Section`.

    **Returns** a `Section`.

    **Source**: L. F. Shampine and S. Thompson, Event location for ordinary differential equations,
    Computers & Mathematics with Applications 39 (2000) 43–54.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> growth = jf.piecewise(lambda t, x: x, lambda t, x: x, lambda t, x: x[0] - 1e9)
    >>> inside = jf.bound(lambda t, x: 8 - x[0])
    >>> sol = jf.solve(growth, jnp.ones(1), 0.0, 9.0, 0.1, sections=inside, throw=False)
    >>> sol.result == jf.RESULTS.out_of_bounds, round(float(sol.t_final), 6)  # ln 8
    (Array(True, dtype=bool), 2.079442)
    """
    return Section(function, -1, 1, is_bound=True)


def sections_of(
    name: str, sections: Sections | None, system: System, x0: Array
) -> tuple[Section, ...]:
    """The sections of an argument in runs of a system from a state like x0, () for None, each with
    a scalar function."""
    if sections is None:
        return ()
    several = (sections,) if isinstance(sections, Section) else sections
    if not isinstance(several, (tuple, list)) or not all(isinstance(s, Section) for s in several):
        raise ValueError(
            f"`{name}` must be a jaxfil.Section or a sequence of them, got "
            f"{argument.told(sections)}."
        )
    for number, section in enumerate(several):
        _check_scalar(f"{name}[{number}].function", section, system, x0)
    return tuple(several)


def _check_scalar(name: str, section: Section, system: System, x0: Array) -> None:
    asked = asked_of(section.function)
    given = dict.fromkeys(asked, jnp.ones(check.shapes(system, x0), x0.dtype)) if asked else {}
    t = jnp.zeros((), x0.dtype)
    out = argument.returned(f"`{name}`", section.function, "", t=t, x=x0, **given)
    if getattr(out, "shape", None) != () or out.dtype != x0.dtype:
        was = f"shape {out.shape}, dtype {out.dtype}" if hasattr(out, "shape") else repr(out)
        raise ValueError(
            f"`{name}` must return a real scalar of the state's dtype, {x0.dtype}, got {was}."
        )
