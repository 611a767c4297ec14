"""Common parts of the cards of results."""

import numpy as np
from jaxtyping import Array

from jaxfil.model.outcomes import RESULTS, outcome_names


def precision(numbers: Array | np.ndarray) -> str:
    """The precision of numbers for a card; empty for float64."""
    # JAX computes in float32 by default. Digits beyond the seventh are then meaningless, and a card
    # that shows more of them must say so.
    return "" if numbers.dtype == np.float64 else f" in {numbers.dtype}"


def counted(results: RESULTS) -> dict[str, int]:
    """Numbers of lanes per outcome, successful ones first, then by frequency."""
    names, counts = np.unique(outcome_names(results), return_counts=True)
    told = dict(zip(names.tolist(), counts.tolist(), strict=True))
    return {n: told[n] for n in sorted(told, key=lambda n: (n != "successful", -told[n]))}


def outcome(result: RESULTS) -> str:
    """The name and the sentence of one outcome."""
    name, sentence = str(outcome_names(result)), RESULTS[result]
    return f"{name}: {sentence}" if sentence else name


def duration(seconds: float) -> str:
    """A time with its unit: three digits of s, ms or µs."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"
