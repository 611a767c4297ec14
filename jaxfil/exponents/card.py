"""The card of an averaged exponent."""

from typing import Any

import jax
import jax.core
import numpy as np
from jaxtyping import Array

from jaxfil.model.card import outcome, precision


def average_card(
    name: str, found: Any, exponents: Array | np.ndarray, errors: Array | np.ndarray
) -> str:
    """The average, its time, and its reliability, in a few lines, of a `LyapunovSpectrum` or a
    `TransverseExponent`."""
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
