"""Run times of a call: a function of no arguments enters, what it gives and seconds leave."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax


def timed(call: Callable[[], Any], repeats: int) -> tuple[Any, float]:
    """What the call gives, and the median of its run times after a first one, which compiles."""
    out, spent = jax.block_until_ready(call()), []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        spent.append(time.perf_counter() - begun)
    return out, statistics.median(spent)


def processor_timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """What a call gives, and its processor time."""
    start = time.process_time()
    found = jax.block_until_ready(call())
    return found, time.process_time() - start
