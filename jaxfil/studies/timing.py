"""The run time of a compiled program."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def median_seconds(call: Callable[[], Any], repeats: int) -> float:
    """The median time of so many calls; NaN of none."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return statistics.median(times) if times else np.nan
