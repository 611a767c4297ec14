"""Several processes at one sweep, through JAX's own runtime.

What each process has done enters and the whole leaves, the same in all of them. Without
`jax.distributed.initialize` there is one process, and everything is left as it is.
"""

from collections.abc import Sequence

import jax
import numpy as np


def share(chunks: Sequence[int]) -> Sequence[int]:
    """The chunks of this process: one in so many, in turn, for neighbours cost alike.

    A chunk is given by the number of its first lane.
    """
    return chunks[jax.process_index() :: jax.process_count()]


def gather(rows: np.ndarray, size: int) -> np.ndarray:
    """The rows of all processes, of which each has set those of its share of chunks of `size`."""
    if jax.process_count() == 1:
        return rows
    from jax.experimental import multihost_utils

    # As many rows in each process, for a gathering is of equal shapes: (round, process, row in the
    # chunk) is the order of `share`, so that transposing puts every row where it belongs.
    count, p = jax.process_count(), len(rows)
    rounds = -(-p // (size * count))
    every = np.zeros((rounds * count * size, *rows.shape[1:]), rows.dtype)
    every[:p] = rows
    mine = every.reshape(rounds, count, size, *rows.shape[1:])[:, jax.process_index()]
    by_process = np.asarray(multihost_utils.process_allgather(mine))
    return by_process.swapaxes(0, 1).reshape(every.shape)[:p]


def from_first(rows: np.ndarray) -> np.ndarray:
    """The rows that the first process has."""
    if jax.process_count() == 1:
        return rows
    from jax.experimental import multihost_utils

    # Not `broadcast_one_to_all`: it adds zeros, and makes 0.0 of -0.0.
    return np.asarray(multihost_utils.process_allgather(rows))[0]


def same(digest: bytes) -> None:
    """Refuse to go on unless all processes have come here with the same arguments."""
    from jax.experimental import multihost_utils

    multihost_utils.assert_equal(
        np.frombuffer(digest, np.uint8), "All processes must call with the same arguments."
    )
