"""`Adaptive`: a tolerance in place of a fixed step.

It holds the user's tolerances as constants, which a tableau carries to `loop.controller`.
"""

from typing import Any

import equinox as eqx

from jaxfil.model import check
from jaxfil.model.types import Scalar


class Adaptive(eqx.Module):
    """Step lengths chosen by a tolerance, for use wherever `dt` or `steps` is an argument.

    With the estimated error e of a step from x to x', embedded in the stepper,

        q = ‖e_i / (atol + rtol max(|x_i|, |x'_i|))‖,    the root mean square over components,

    a step with q ≤ 1 is accepted, and any other is repeated with a shorter length. The next length
    is chosen by a PI controller, h' = h · 0.9 q^(−0.7/p) q_last^(0.4/p) for a stepper of order p,
    with the factor limited to [0.2, 10]. Contacts, ticks of clocks and saving times are located as
    with fixed steps, and each lane of a batch has its own steps. In derivatives the lengths are
    constants, apart from times of contacts, and of kinks with `Taylor`. The error of a run exceeds
    the error of its steps; `estimate_error` measures it.

    Suited to motions whose rates differ by orders of magnitude, such as a spike or a stiff contact
    after a slow flight. For other motions a fixed step is faster in a batch.

    **Arguments**

    - `rtol`, `atol`: the relative and the absolute tolerance, as in diffrax, by default 1e-6 and
      1e-9; numbers, not traced, `rtol` positive and `atol` not negative. An `rtol` below 16 eps of
      the precision is replaced by that value. With an `atol` of 0 the rounding of a number that is
      zero, as the speed of a mass that sticks, is no error. A number that grows from zero as a
      power of time above the order of the stepper, such as the last mass of a chain, then has no
      relative accuracy, and the run ends `step_too_long`.
    - `dtmax`: the longest step, in units of t; None for no limit. Contacts are located on the cubic
      through a step's ends, so a step may hide two of them if H oscillates faster than the state.

    **Raises** `ValueError` for other values.

    **Source**: E. Hairer, S. P. Nørsett and G. Wanner, Solving Ordinary Differential Equations I,
    Springer (1993), II.4; K. Gustafsson, Control theoretic techniques for stepsize selection in
    explicit Runge–Kutta methods, ACM Transactions on Mathematical Software 17 (1991).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> ball = jf.systems.BouncingBall(restitution=0.5)
    >>> sol = jf.solve(ball, jnp.array([1.0, 0.0]), 0.0, 1.0, jf.Adaptive(rtol=1e-8))
    >>> int(sol.num_events)
    2
    """

    rtol: float = eqx.field(static=True)
    """The relative tolerance."""
    atol: float = eqx.field(static=True)
    """The absolute tolerance."""
    dtmax: float | None = eqx.field(static=True)
    """The longest step; None for no limit."""

    def __init__(self, rtol: Scalar = 1e-6, atol: Scalar = 1e-9, dtmax: Scalar | None = None):
        self.rtol = _known("rtol", rtol, positive=True)
        self.atol = _known("atol", atol)
        self.dtmax = None if dtmax is None else _known("dtmax", dtmax, positive=True)
        if self.atol < 0:
            raise ValueError(f"`atol` must not be negative, got {self.atol}.")

    def __repr__(self) -> str:
        # A part of a tableau's name in files, from which the numbers are read back
        # (`files.solution`).
        longest = "" if self.dtmax is None else f", dtmax={self.dtmax!r}"
        return f"Adaptive(rtol={self.rtol!r}, atol={self.atol!r}{longest})"


def _known(name: str, value: Any, *, positive: bool = False) -> float:
    """A number of a tolerance, which is a constant of the program."""
    check.scalar(name, value, float, positive=positive)
    known = check.concrete(value)
    if known is None:
        raise ValueError(f"`{name}` must be a constant of the program, got a traced number.")
    return float(known)
