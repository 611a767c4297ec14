"""Step halving: the same lanes at half the step, and how far apart the two runs are.

Samples and outcomes of both enter; an estimate of the error of each lane leaves.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from jaxfil.model.outcomes import RESULTS, code

# Where the run at half the step has its checkpoint, in that of its sweep.
FOLDER = "half_step"


def errors(
    xs: Float[np.ndarray, "p samples n"],
    codes: Int[np.ndarray, " p"],
    half_xs: Float[np.ndarray, "p samples n"],
    half_codes: Int[np.ndarray, " p"],
    num_steps: int,
) -> Float[np.ndarray, "p n"]:
    """The largest distance of each lane's samples from those at half the step, shape (p, n).
    `num_steps`: steps that a lane takes at half the step.

    As for one solution (`integrate.solution.errors`): with a global error C·dtᵖ the distance is
    (1 − 2⁻ᵖ) of it, and rounding, which two runs may share, is taken to be one unit a step at
    random. A lane that failed in one of the runs has an unknown error, NaN.
    """
    good = code(RESULTS.successful)
    known = ((codes == good) & (half_codes == good))[:, None]
    size = np.max(abs(xs), axis=(1, 2))[:, None]  # of all components: they feed each other
    # Errors of one unit at random add up as a walk does: √(number of steps) units.
    units = math.sqrt(num_steps)
    rounding = np.finfo(xs.dtype).eps * size * units
    distance = np.max(abs(xs - half_xs), axis=1)
    return np.where(known, np.maximum(distance, rounding), np.nan).astype(xs.dtype)
