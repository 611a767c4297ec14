"""Results of drive and response, with their cards and pictures."""

import equinox as eqx
import jax
import jax.core
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfil.exponents.card import average_card
from jaxfil.model.card import precision
from jaxfil.model.drawing import draw
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.types import Axes


class Synchronization(eqx.Module):
    """The couplings that synchronise drive and response.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall = jf.systems.ImpactOscillator(damping=1.0)  # λ1 = λ2 = −1/2 away from it
    >>> found = jf.synchronization_exponent(
    ...     wall, jnp.array([0.1, 0.0]), jnp.array([-0.55, -0.3]), periods=20, transient=0,
    ...     steps=20, stepper=jf.RK4())
    >>> found.synchronized.tolist()
    [False, True]
    """

    exponent: Float[Array, ""]
    """The smallest of `couplings` that synchronises, an estimate of λ1; NaN without one."""
    couplings: Float[Array, " c"]
    """The values of ε, as passed."""
    distances: Float[Array, " c"]
    """The smallest distance |x − y| at the ends of periods, until it fell to `tolerance`; NaN where
    the lane failed."""
    synchronized: Bool[Array, " c"]
    """Whether that distance fell to `tolerance`."""
    tolerance: Float[Array, ""]
    """The distance that counts as synchronised."""
    time: Float[Array, ""]
    """The time of the run of drive and response."""
    bias: Float[Array, ""]
    """Expected excess of the estimate over λ1: half a step of the grid, and log(d0/tolerance)/time,
    because the distance must fall from its initial d0 within that time. NaN if the lowest coupling
    synchronises, or no coupling does; λ1 is then outside the grid."""
    x0: Float[Array, " n"]
    """The drive's state before the transient."""
    results: RESULTS
    """An outcome for each coupling, shape (c,)."""
    compact: bool = eqx.field(static=True, default=False)
    """Whether the stages of a step were a loop in the program (see `solve`)."""

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the distances against the couplings; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        told = precision(self.exponent)
        if isinstance(self.exponent, jax.core.Tracer) or self.exponent.ndim > 0:
            return f"Synchronization{told}: a batch of shape {self.exponent.shape}"
        state = np.array2string(np.asarray(self.x0), precision=6, separator=", ")
        low, high = float(self.couplings[0]), float(self.couplings[-1])
        if not np.any(self.synchronized):
            exponent = "no exponent, for no coupling synchronises"
        elif self.synchronized[0]:
            exponent = f"exponent at most {low:.5g}, the lowest of the couplings"
        else:
            bias = f"biased by about {float(self.bias):.2g}"
            exponent = f"exponent {float(self.exponent):.5g}, {bias}"
        return "\n".join(
            [
                f"Synchronization{told}: {exponent}",
                f"  {int(np.sum(self.synchronized))} of {self.couplings.size} couplings from "
                f"{low:g} to {high:g} synchronise to {float(self.tolerance):.1g} within a time of "
                f"{float(self.time):.6g}, from x0 = {state}",
            ]
        )


class TransverseExponent(eqx.Module):
    """λ1 from the rate at which a small distance between drive and response grows.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> wall = jf.systems.ImpactOscillator(damping=1.0)  # λ1 = λ2 = −1/2 away from it
    >>> found = jf.transverse_exponent(
    ...     wall, jnp.array([0.1, 0.0]), periods=20, transient=0, steps=20, stepper=jf.RK4())
    >>> found.times.shape, bool(found.settled)
    ((20,), True)
    """

    exponent: Float[Array, ""]
    """The rate plus the coupling, per unit time. NaN where the distance fell below the resolution
    of rounding within one interval."""
    standard_error: Float[Array, ""]
    """Standard error of the exponent, by batch means."""
    running: Float[Array, " batches"]
    """The estimates at `times`."""
    times: Float[Array, " batches"]
    """The times of the running average."""
    separation: Float[Array, ""]
    """The distance to which the response was reset after every interval."""
    x0: Float[Array, " n"]
    """The drive's state before the transient."""
    x_final: Float[Array, " n"]
    """The drive's state at the end."""
    settled: Bool[Array, ""]
    """False if the growth changed permanently within the average; use a longer transient."""
    result: RESULTS
    """The lane's outcome."""
    compact: bool = eqx.field(static=True, default=False)
    """Whether the stages of a step were a loop in the program (see `solve`)."""

    @property
    def exponents(self) -> Float[Array, " 1"]:
        """The exponent as an array, like `LyapunovSpectrum.exponents`."""
        return self.exponent[..., None]

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the running estimate; returns the matplotlib axes."""
        return draw(self, ax=ax)

    def __repr__(self) -> str:
        return average_card(self, self.exponent)
