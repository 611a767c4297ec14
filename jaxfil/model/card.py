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


def outcome(result: RESULTS) -> str:
    """The name of one outcome and its sentence."""
    name, sentence = str(outcome_names(result)), RESULTS[result]
    return f"{name}: {sentence}" if sentence else name
