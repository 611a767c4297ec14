"""`Adaptive`: a tolerance in place of a step.

What the user asks for enters; numbers leave, which a tableau carries to the loop
(`loop.controller`).
"""

from typing import Any

import equinox as eqx

from jaxfil.model import check
from jaxfil.model.types import Scalar


class Adaptive(eqx.Module):
    """Steps as long as a tolerance allows, wherever `dt` or `steps` is an argument.

    With the estimated error e of a step from x to x', embedded in the stepper,

        q = ‖e_i / (atol + rtol max(|x_i|, |x'_i|))‖,    the root mean square over components,

    the step is taken where q ≤ 1, and is otherwise tried again, shorter. The next one is as long as
    a PI controller says, h' = h · 0.9 q^(−0.7/p) q_last^(0.4/p) for a stepper of order p, by no
    less than a factor of 0.2 and no more than one of 10. Contacts, ticks of clocks and saving times
    are met as ever, and each lane of a batch has its own steps. In derivatives the lengths are
    constants. The error of a run grows beyond that of its steps: `estimate_error` measures it.

    For motions whose rates differ by orders: a spike, a stiff contact after a slow flight. Where
    they do not, a fixed step is faster in a batch.

    **Arguments**

    - `rtol`, `atol`: the relative and the absolute tolerance, as diffrax has them; numbers, not
      traced, `rtol` positive and `atol` not negative. An `rtol` below 16 eps of the precision is
      taken for that.
    - `dtmax`: the longest step, in units of t; None: no limit. A contact is looked for on the cubic
      through a step's ends, and where H oscillates faster than the state a step may hide two.

    **Raises** `ValueError` if one of them is no such number.

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
    """The longest step; None: no limit."""

    def __init__(self, rtol: Scalar = 1e-6, atol: Scalar = 1e-9, dtmax: Scalar | None = None):
        self.rtol = _known("rtol", rtol, positive=True)
        self.atol = _known("atol", atol)
        self.dtmax = None if dtmax is None else _known("dtmax", dtmax, positive=True)
        if self.atol < 0:
            raise ValueError(f"`atol` must not be negative, got {self.atol}.")

    def __repr__(self) -> str:
        longest = "" if self.dtmax is None else f", dtmax={self.dtmax!r}"
        return f"Adaptive(rtol={self.rtol!r}, atol={self.atol!r}{longest})"


def _known(name: str, value: Any, *, positive: bool = False) -> float:
    """A number of a tolerance, which is a constant of the program."""
    check.scalar(name, value, float, positive=positive)
    known = check.concrete(value)
    if known is None:
        raise ValueError(f"`{name}` must be known, for programs are made for it; got one traced.")
    return float(known)
