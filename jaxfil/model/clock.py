"""Known times at which a field, a surface or the state jumps."""

import equinox as eqx
from jaxtyping import Array, Float

from jaxfil.model.argument import leaf


class Clock(eqx.Module):
    r"""Known times, independent of the state, at which the field, a switching function or the state
    (`System.tick`) may jump.

    $$t_k = \mathrm{phase} + k \cdot \mathrm{period}, \qquad k \in \mathbb{Z}$$

    A `System` lists its clocks in `clocks`. Steps end on ticks. A step up to a tick evaluates the
    functions of the system just before it, and the next step just after it, by a shift of times of
    the order of rounding. A ramp `jnp.mod(t, period)` or a sampled signal
    `u[jnp.floor(t / period)]` may therefore be written directly. Derivatives with respect to the
    period and the phase are exact.

    **Arguments**

    - `period`: the time from one tick to the next, positive. In a run for which it is traced, as in
      a sweep over it, any other period is an outcome, `invalid_period` or `nonfinite`.
    - `phase`: the time of a tick.

    **Source**: M. di Bernardo, F. Garofalo, L. Glielmo and F. Vasca, Switchings, bifurcations and
    chaos in DC/DC converters, IEEE Transactions on Circuits and Systems I 45 (1998) 133–141.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> class Sawtooth(jf.System):
    ...     period_of_ramp: jax.Array
    ...
    ...     def vector_field(self, t, x, side):
    ...         return jnp.mod(t, self.period_of_ramp)[None]
    ...
    ...     @property
    ...     def clocks(self):
    ...         return (jf.Clock(self.period_of_ramp),)
    >>> def end(T):
    ...     return jf.solve(Sawtooth(T), jnp.zeros(1), 0.0, 1.0, 0.25, stepper=jf.RK4()).xs[0, 0]
    >>> T = jnp.array(0.3)  # three whole teeth of area T²/2, and a part of 1 − 3T
    >>> print(round(float(end(T)), 12), round(float(jax.grad(end)(T)), 12))
    0.14 0.6
    """

    period: Float[Array, ""] | float
    """The time from one tick to the next."""
    phase: Float[Array, ""] | float = 0.0
    """The time of a tick."""

    def __check_init__(self):
        # In a batch they are arrays; a run checks the values of one lane.
        leaf("period", self.period, positive=True)
        leaf("phase", self.phase)


Clocks = tuple[Clock, ...]
"""The clocks of a system."""

Ticks = tuple[Array, ...]
"""The number of the next tick of each clock."""
