"""What the cards of results have in common.

Numbers or an outcome enter; words for the `repr` of a result leave.
"""

import numpy as np
from jaxtyping import Array

from jaxfil.model.outcomes import RESULTS, outcome_names


def precision(numbers: Array | np.ndarray) -> str:
    """What a card says of the precision of numbers: nothing in float64."""
    # JAX computes in float32 unless told otherwise. Digits beyond the seventh then mean nothing,
    # and a card that shows more of them has to say so.
    return "" if numbers.dtype == np.float64 else f" in {numbers.dtype}"


def counted(results: RESULTS) -> dict[str, int]:
    """How many lanes have ended in which way; the good ones come first, then what is frequent."""
    names, counts = np.unique(outcome_names(results), return_counts=True)
    told = dict(zip(names.tolist(), counts.tolist(), strict=True))
    return {n: told[n] for n in sorted(told, key=lambda n: (n != "successful", -told[n]))}


def outcome(result: RESULTS) -> str:
    """The name of one outcome and its sentence."""
    name, sentence = str(outcome_names(result)), RESULTS[result]
    return f"{name}: {sentence}" if sentence else name


def duration(seconds: float) -> str:
    """A time with its unit: three digits of s, ms or µs."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"
