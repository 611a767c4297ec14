"""The card of an averaged exponent."""

from typing import Any

import numpy as np
from jaxtyping import Array

from jaxfil.model.card import outcome, precision
from jaxfil.xla.known import is_known


def average_card(found: Any, exponents: Array | np.ndarray) -> str:
    """The exponents with their errors, the time of the average and its reliability, in a few lines,
    of a `LyapunovSpectrum` or a `TransverseExponent`."""
    name = f"{type(found).__name__}{precision(found.x0)}"
    if not is_known(found.result) or found.times.ndim > 1:
        return f"{name}: a batch of shape {found.times.shape[:-1]}"
    exponents, errors = np.atleast_1d(exponents), np.atleast_1d(found.standard_error)
    pairs = zip(exponents, errors, strict=True)
    # An exponent of −inf is exact, and NaN is unknown; neither has an error.
    values = ", ".join(f"{a:.5g} ± {b:.1g}" if np.isfinite(a) else f"{a}" for a, b in pairs)
    state = np.array2string(np.asarray(found.x0), precision=6, separator=", ")
    lines = [
        f"{name}: {outcome(found.result)}",
        f"  {values} per unit time, over a time of {float(found.times[-1]):.6g} after the "
        f"transient, from x0 = {state}",
    ]
    # A lane without an exponent has no growth that could have settled.
    if not found.settled and not np.isnan(exponents).any():
        lines.append("  not settled: the growth rate changed permanently; use a longer transient")
    return "\n".join(lines)
