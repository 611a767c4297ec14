"""Many problems of one shape, solved side by side.

Pytrees of numbers and a step for each enter; what a compiled function of a batch makes of them, in
their order, leaves. Lanes of like steps go together: a batch lasts as long as its longest lane.
`counts` says how many problems there are of each shape.
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


def counts(parts, systems, least=5):
    """How many systems of each shape, given its part of all; of few systems all are of the first
    shape, for each is compiled."""
    found = {shape: round(part * systems) for shape, part in parts.items()}
    large = {shape: count for shape, count in found.items() if count >= least}
    return large or {next(iter(parts)): min(systems, least)}
