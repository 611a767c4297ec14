"""The companion of a sweep: the same lanes at half the step, and how far apart the two are.

Samples and outcomes of both enter; an estimate of the error of each lane leaves.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from jaxfil.model.outcomes import RESULTS, code
from jaxfil.sweep.diagram import Conditions

# The companion's folder in the checkpoint of its sweep.
FOLDER = "half_step"


def errors(
    xs: Float[np.ndarray, "p samples n"],
    codes: Int[np.ndarray, " p"],
    companion_xs: Float[np.ndarray, "p samples n"],
    companion_codes: Int[np.ndarray, " p"],
    companion: Conditions,
) -> Float[np.ndarray, "p n"]:
    """The largest distance of each lane's samples from its companion's, shape (p, n).

    As for one solution (`integrate.solution.errors`): with a global error C·dtᵖ the distance is
    (1 − 2⁻ᵖ) of it, and rounding, which two runs may share, is taken to be one unit a step at
    random. A lane that failed, or whose companion did, has an unknown error, NaN.
    """
    good = code(RESULTS.successful)
    known = ((codes == good) & (companion_codes == good))[:, None]
    size = np.max(abs(xs), axis=(1, 2))[:, None]
    units = math.sqrt((companion.transient + xs.shape[1]) * companion.steps)
    rounding = np.finfo(xs.dtype).eps * size * units
    distance = np.max(abs(xs - companion_xs), axis=1)
    return np.where(known, np.maximum(distance, rounding), np.nan).astype(xs.dtype)
