"""Chunks of lanes: compiled once, run on every core, collected.

A job, the values of its lanes and their initial states enter; samples and outcomes of all lanes
leave. A job is called as `job(values, states, followed=..., whole=...)`: with lanes side by side,
or, `followed`, one after the other each from the last one's end; compiled into one kernel if
`whole`. It answers with samples, outcomes and last states.
"""

import functools as ft
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

import equinox as eqx
import jax
import numpy as np

# Lanes of one call: a stroke of the progress bar.
_CHUNK = 1024
# Values of one call when each starts from the last one's end.
_FOLLOW = 16
# Vectors as wide as the machine has them. (XLA's fast math would be a fifth faster still, but NaN
# goes unnoticed under it, whatever its options promise.)
_CPU_OPTIONS = {"xla_cpu_prefer_vector_width": "512"}


@ft.cache
def compiled(run: Callable) -> Callable:
    """`run`, compiled for this machine."""
    options = _CPU_OPTIONS if jax.default_backend() == "cpu" else None
    # Equinox's overloads leave out the keywords that it hands on to `jax.jit`.
    return eqx.filter_jit(run, compiler_options=options)  # pyright: ignore[reportCallIssue]


# Systems that XLA has refused to compile into one kernel: see `one_kernel`.
_REFUSED: set[type] = set()


def _compiled_job(job: Callable, values: np.ndarray, states: np.ndarray, followed: bool):
    """`job` for arguments of these shapes, compiled: as one kernel where that can be."""
    system, nowhere = job.args[0], np.full_like(values, np.nan)  # lanes that fail at once
    whole = jax.default_backend() == "cpu" and type(system) not in _REFUSED
    job = ft.partial(job, followed=followed)
    try:
        job(nowhere, states, whole=whole)
    except jax.errors.JaxRuntimeError:
        if not whole:
            raise
        _REFUSED.add(type(system))
        return ft.partial(job, whole=False)
    return ft.partial(job, whole=whole)


def _cores() -> int:
    if jax.default_backend() != "cpu":
        return 1
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def chunks(job: Callable, values: np.ndarray, states: np.ndarray) -> Iterator[tuple]:
    """Chunks of equal size, the last one padded, one at a time on each core."""
    p, cores = values.shape[0], _cores()
    size = min(_CHUNK, -(-p // cores))
    states = np.broadcast_to(states, (p, states.shape[1]))

    def chunk(start: int):
        pick = np.minimum(np.arange(start, start + size), p - 1)
        xs, results, _ = job(values[pick], states[pick])
        keep = min(size, p - start)
        return start, jax.tree.map(lambda v: np.asarray(v)[:keep], (xs, results))

    # Compiled here, and not on every core.
    job = _compiled_job(job, values[:1].repeat(size), states[:1].repeat(size, axis=0), False)
    with ThreadPoolExecutor(cores) as pool:
        starts = list(range(0, p, size))
        for done in as_completed([pool.submit(chunk, start) for start in starts]):
            yield done.result()


def one_after_another(job: Callable, values: np.ndarray, state: np.ndarray) -> Iterator[tuple]:
    """Runs of values, each value from the last one's end."""
    p, size = values.shape[0], min(_FOLLOW, values.shape[0])
    job = _compiled_job(job, values[:1].repeat(size), state, True)
    for start in range(0, p, size):
        pick = np.minimum(np.arange(start, start + size), p - 1)
        xs, results, state = job(values[pick], state)
        keep = min(size, p - start)
        yield start, jax.tree.map(lambda v, keep=keep: np.asarray(v)[:keep], (xs, results))


def collect(pieces: Iterator[tuple], p: int, samples: int, n: int, dtype: Any, progress: bool):
    """All chunks in one array, with a progress bar that counts lanes."""
    from tqdm.auto import tqdm

    xs = np.full((p, samples, n), np.nan, dtype)
    codes = np.zeros((p,), np.int32)
    outcomes = None
    with tqdm(total=p, unit="lane", disable=not progress) as bar:
        for start, (piece, outcomes) in pieces:
            (code,) = jax.tree.leaves(outcomes)
            xs[start : start + len(code)] = piece
            codes[start : start + len(code)] = code
            bar.update(len(code))
    return xs, jax.tree.map(lambda _: codes, outcomes)
