"""Several processes for one sweep, through JAX's own runtime.

Without `jax.distributed.initialize` there is one process, and these functions do not change their
arguments.
"""

from collections.abc import Sequence

import jax
import numpy as np


def share(chunks: Sequence[int]) -> Sequence[int]:
    """The chunks of this process: every n-th for n processes, because neighbours cost alike.

    A chunk is identified by the number of its first lane.
    """
    return chunks[jax.process_index() :: jax.process_count()]


def gather(rows: np.ndarray, size: int) -> np.ndarray:
    """The rows of all processes, each of which has set the rows of its chunks of `size`."""
    if jax.process_count() == 1:
        return rows
    from jax.experimental import multihost_utils

    # Padded to as many rows in each process, because a gathering needs equal shapes. (round,
    # process, row in the chunk) is the order of `share`, so that transposing restores the order.
    count, p = jax.process_count(), len(rows)
    rounds = -(-p // (size * count))
    every = np.zeros((rounds * count * size, *rows.shape[1:]), rows.dtype)
    every[:p] = rows
    mine = every.reshape(rounds, count, size, *rows.shape[1:])[:, jax.process_index()]
    by_process = np.asarray(multihost_utils.process_allgather(mine))
    return by_process.swapaxes(0, 1).reshape(every.shape)[:p]


def from_first(rows: np.ndarray) -> np.ndarray:
    """The rows of the first process."""
    if jax.process_count() == 1:
        return rows
    from jax.experimental import multihost_utils

    # Not `broadcast_one_to_all`, which adds zeros and turns -0.0 into 0.0.
    return np.asarray(multihost_utils.process_allgather(rows))[0]


def same(digest: bytes) -> None:
    """Raise an error unless all processes have the same arguments."""
    from jax.experimental import multihost_utils

    multihost_utils.assert_equal(
        np.frombuffer(digest, np.uint8), "All processes must call with the same arguments."
    )
