"""The initial states of a sweep, one for all lanes or one for each."""

from typing import Any

import numpy as np

from jaxfil.model import check
from jaxfil.model.types import States


def state_type(x0: Any) -> np.dtype:
    """The float precision of initial states."""
    return np.dtype(check.states("x0", x0).dtype)


def initial_states(x0: States, shape: tuple[int, ...], follow: bool) -> np.ndarray:
    """One initial state, shape (n,), or one for each lane."""
    states = np.asarray(x0)
    if follow and states.ndim != 1:
        raise ValueError(f"`x0` must be of shape (n,) with `follow`, got {states.shape}.")
    if states.ndim != 1 and states.shape[:-1] != shape:
        lanes = ", ".join(map(str, shape))
        raise ValueError(
            f"`x0` must be of shape (n,), or ({lanes}, n), a state for each lane, got "
            f"{states.shape}."
        )
    return states
