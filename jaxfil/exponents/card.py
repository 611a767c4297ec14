"""The card of an averaged exponent."""

from typing import Protocol, runtime_checkable

import jax
import jax.core
import numpy as np
from jaxtyping import Array

from jaxfil.model.card import outcome, precision
from jaxfil.model.outcomes import RESULTS


@runtime_checkable
class Average(Protocol):
    """A result that was averaged over time."""

    @property
    def x0(self) -> Array:
        """The state before the transient."""
        ...

    @property
    def times(self) -> Array:
        """The times of the running average."""
        ...

    @property
    def settled(self) -> Array:
        """Whether the motion was the same throughout."""
        ...

    @property
    def result(self) -> RESULTS:
        """The outcome."""
        ...


def average_card(
    name: str, found: Average, exponents: Array | np.ndarray, errors: Array | np.ndarray
) -> str:
    """The average, its time, and its reliability, in a few lines."""
    name += precision(found.x0)
    if isinstance(found.result._value, jax.core.Tracer) or found.times.ndim > 1:
        return f"{name}: a batch of shape {found.times.shape[:-1]}"
    numbers, spreads = np.atleast_1d(exponents), np.atleast_1d(errors)
    pairs = zip(numbers, spreads, strict=True)
    # −inf and NaN have no error; the first is exact, the second unknown.
    told = ", ".join(f"{a:.5g} ± {b:.1g}" if np.isfinite(a) else f"{a}" for a, b in pairs)
    state = np.array2string(np.asarray(found.x0), precision=6, separator=", ")
    lines = [
        f"{name}: {outcome(found.result)}",
        f"  {told} per unit time, over a time of {float(found.times[-1]):.6g} from x0 = {state}",
    ]
    if not found.settled:
        lines.append(
            "  not settled: the growth changed for good on the way; take a longer transient"
        )
    return "\n".join(lines)
