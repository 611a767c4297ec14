"""Step halving: an error estimate of each lane from a second run at half the step."""

import math

import numpy as np
from jaxtyping import Float, Int

from jaxfil.model.outcomes import RESULTS, code

# Folder of the checkpoint of the run at half the step, within the checkpoint of its sweep.
FOLDER = "half_step"


def errors(
    xs: Float[np.ndarray, "p samples n"],
    codes: Int[np.ndarray, " p"],
    half_xs: Float[np.ndarray, "p samples n"],
    half_codes: Int[np.ndarray, " p"],
    num_steps: int,
) -> Float[np.ndarray, "p n"]:
    """The largest distance of each lane's samples from the samples at half the step, shape (p, n).
    `num_steps`: number of steps of a lane at half the step.

    As for one solution (`integrate.solution.errors`), with a global error C·dtᵖ the distance is
    (1 − 2⁻ᵖ) of it, and rounding, which two runs may share, is taken as one unit per step at
    random. A lane that failed in one of the runs has an unknown error, NaN.
    """
    good = code(RESULTS.successful)
    known = ((codes == good) & (half_codes == good))[:, None]
    size = np.max(abs(xs), axis=(1, 2))[:, None]  # of all components, which affect each other
    # Errors of one unit at random add up like a random walk, to √(number of steps) units.
    units = math.sqrt(num_steps)
    rounding = np.finfo(xs.dtype).eps * size * units
    distance = np.max(abs(xs - half_xs), axis=1)
    return np.where(known, np.maximum(distance, rounding), np.nan).astype(xs.dtype)
