"""."""

from typing import Any

import numpy as np

from jaxfil.model.outcomes import RESULTS, outcome_names


def precision(numbers: Any) -> str:
    """What a card says of the precision of numbers: nothing in float64."""
    return "" if numbers.dtype == np.float64 else f" in {numbers.dtype}"


def outcome(result: RESULTS) -> str:
    """The name of one outcome and its sentence."""
    name, sentence = str(outcome_names(result)), RESULTS[result]
    return f"{name}: {sentence}" if sentence else name
