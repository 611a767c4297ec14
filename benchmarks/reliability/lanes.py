"""Many problems of one shape, solved side by side.

Pytrees of numbers and a step for each enter; what a compiled function of a batch makes of them, in
their order, leaves. Lanes of like steps go together: a batch lasts as long as its longest lane.
"""

import jax
import jax.numpy as jnp
import numpy as np

LANES = 128


def stacked(problems):
    """One pytree of arrays with the problems along their first axis."""
    return jax.tree.map(lambda *v: jnp.asarray(np.stack(v)), *problems)


def in_chunks(solve, problems, dts, lanes=LANES):
    """`solve(*problems, dts)` of all problems, by chunks of equal size, as NumPy arrays."""
    lanes = min(lanes, len(problems))
    order = np.argsort(dts, kind="stable")
    chunks = []
    for first in range(0, len(order), lanes):
        chosen = order[first : first + lanes]
        filled = np.resize(chosen, lanes)  # the last chunk is filled with its own
        out = solve(*stacked([tuple(problems[i]) for i in filled]), jnp.asarray(dts[filled]))
        count = len(chosen)
        chunks.append(jax.tree.map(lambda v, k=count: np.asarray(v)[:k], out))
    back = np.argsort(order, kind="stable")
    return jax.tree.map(lambda *v: np.concatenate(v)[back], *chunks)
