"""Execution: chunks of lanes, compiled once, run on every core, kept as soon as they are finished.

A job, the rows of parameters of its lanes and their initial states enter; samples and outcomes of
all lanes leave. A job is called as `job(rows, states, lanes, followed=..., whole=...)`: with
lanes side by side, or, `followed`, one after the other each from the last one's end; compiled into
one kernel if `whole`. It answers with samples, outcomes and last states, of which the first `lanes`
count: none are computed if that is 0.
"""

import functools as ft
import os
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxfil.model.outcomes import RESULTS, code
from jaxfil.sweep import multiprocess
from jaxfil.sweep.checkpoint import Checkpoint, FinishedChunk
from jaxfil.sweep.interrupt import counted
from jaxfil.xla.kernel import DoesNotFitError

# Lanes that share a loop, on a CPU: few enough for all of their numbers to stay in the first-level
# cache, and to wait for few others.
BLOCK = 64
# Chunks that a sweep is cut into at least, if it has the blocks, so that many cores get some each;
# and blocks of a chunk at most, to be a stroke of the progress bar.
_CHUNKS, _BLOCKS = 64, 16
# Lanes of a chunk when each starts from the last one's end: one after the other, they gain nothing
# from being many, and are kept and counted as often as chunks are.
_FOLLOW = 16
# Seconds until Ctrl-C is heeded at the latest, where it has not woken what waits for a chunk.
_HEED = 0.1
# Vectors as wide as the machine has them. (XLA's fast math would be a fifth faster still, but NaN
# goes unnoticed under it, whatever its options promise.)
_CPU_OPTIONS = {"xla_cpu_prefer_vector_width": "512"}


@ft.cache
def compiled(run: Callable) -> Callable:
    """`run`, compiled for this machine."""
    # Cached by function: a jitted function of its own for each sweep would compile each time.
    options = _CPU_OPTIONS if jax.default_backend() == "cpu" else None
    # Equinox's overloads leave out the keywords that it hands on to `jax.jit`.
    return eqx.filter_jit(run, compiler_options=options)  # pyright: ignore[reportCallIssue]


# Jobs that are known not to fit into one kernel: see `one_kernel`.
_IN_PARTS: set[Any] = set()


def _compiled_job(
    job: ft.partial, rows: np.ndarray, n: int, followed: bool
) -> tuple[Callable, int]:
    """`job` compiled, as one kernel where that can be, and the lanes of its calls.

    Their number depends on the sweep and not on the machine's cores, and a call is filled up with
    copies of a lane: a lane's last bits may depend on the shape that it was compiled in.
    """
    what = jax.tree.structure((job.args, job.keywords))
    whole = jax.default_backend() == "cpu" and what not in _IN_PARTS
    lanes = _FOLLOW if followed else _lanes(len(rows), whole)
    call = ft.partial(job, followed=followed, whole=whole)
    nowhere = np.zeros((lanes, rows.shape[1]), rows.dtype)
    try:
        call(nowhere, np.zeros((n,) if followed else (lanes, n), rows.dtype), np.int32(0))
    except DoesNotFitError:
        _IN_PARTS.add(what)
        return _compiled_job(job, rows, n, followed)
    return call, lanes


def _lanes(p: int, whole: bool) -> int:
    """Lanes of a chunk of p. Without a single kernel every operation of the loop starts its own,
    and only many lanes make up for that."""
    blocks = -(-p // BLOCK)  # rounded up
    return BLOCK * min(-(-blocks // _CHUNKS) if whole else blocks, _BLOCKS)


def _cores() -> int:
    """How many chunks run at a time."""
    if jax.default_backend() != "cpu":
        return 1  # an accelerator runs one program after the other
    # What a scheduler or `taskset` grants, which `os.cpu_count` does not know.
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


_UNFINISHED = code(RESULTS.interrupted)


class _Lanes:
    """All lanes of a sweep, unfinished at first, and the progress bar that counts them."""

    def __init__(
        self, p: int, shape: tuple[int, int], dtype: np.dtype, checkpoint: Checkpoint | None
    ):
        self.xs = np.full((p, *shape), np.nan, dtype)
        self.codes = np.full((p,), _UNFINISHED, np.int32)
        self.checkpoint = checkpoint

    def finish(
        self, start: int, lanes: int, run: Callable[[], tuple[Any, ...]]
    ) -> tuple[FinishedChunk, bool]:
        """The chunk from lane number `start` on as `run` gives it, or as the checkpoint holds it;
        and whether that held it."""
        stop = min(start + lanes, len(self.codes))
        kept = self.checkpoint.read(start, stop) if self.checkpoint else None
        if kept is None:
            xs, results, end = run()
            (codes,) = jax.tree.leaves(results)
            here = slice(stop - start)  # without the lanes that fill the last chunk up
            chunk = FinishedChunk(np.asarray(xs)[here], np.asarray(codes)[here], np.asarray(end))
            if self.checkpoint:
                self.checkpoint.write(start, stop, chunk)
        else:
            chunk = kept
        self.xs[start:stop] = chunk.xs
        self.codes[start:stop] = chunk.codes  # last: these say that the lanes are finished
        return chunk, kept is not None

    def finished(self) -> tuple[np.ndarray, np.ndarray]:
        """Samples and codes of outcomes as they are now; NaN where a lane is not finished."""
        if self.checkpoint:
            self.checkpoint.tell_damaged()  # not in a chunk's thread, which has no caller's line
        codes = self.codes.copy()
        missing = codes == _UNFINISHED
        if missing.any():  # a chunk under way may still be written
            return np.where(missing[:, None, None], np.nan, self.xs), codes
        return self.xs, codes


class _Bar:
    """A progress bar that says that it compiles, and then counts lanes; those of a checkpoint
    leave its rate alone."""

    def __init__(self, total: int, progress: bool):
        from tqdm.auto import tqdm

        shown = progress and jax.process_index() == 0
        self._bar = tqdm(desc="compiling", total=total, unit="lane", disable=not shown)

    def __enter__(self) -> "_Bar":
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.close()

    def start(self, total: int) -> None:
        """Lanes run from now on."""
        self._bar.set_description(refresh=False)
        self._bar.reset(total)

    def count(self, lanes: int, kept: bool) -> None:
        """So many more are finished."""
        # tqdm takes the rate from what is beyond `initial`.
        if kept and not self._bar.disable:
            self._bar.initial += lanes
        self._bar.update(lanes)


def side_by_side(
    job: ft.partial,
    rows: np.ndarray,
    states: np.ndarray,
    shape: tuple[int, int],
    checkpoint: Checkpoint | None,
    progress: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Samples, of this shape (samples, k), and outcomes of all lanes, a chunk at a time on each
    core of each process."""
    (p, _), n = rows.shape, states.shape[1]
    with counted() as interrupts, _Bar(p, progress) as bar:
        call, size = _compiled_job(job, rows, n, False)
        interrupts.keeps = True
        rows, states = _filled_up(rows, size), _filled_up(np.broadcast_to(states, (p, n)), size)
        lanes = _Lanes(p, shape, rows.dtype, checkpoint)

        def chunk(start: int) -> tuple[int, bool]:
            if interrupts.count:  # before this chunk has begun
                return 0, False
            here = slice(start, start + size)
            real = np.int32(min(size, p - start))
            done, kept = lanes.finish(start, size, lambda: call(rows[here], states[here], real))
            return len(done.codes), kept

        starts = multiprocess.share(range(0, p, size))
        bar.start(sum(min(size, p - s) for s in starts))  # the lanes of this process alone
        # Threads and not devices: XLA releases Python's lock while it computes, and a core that has
        # finished a chunk takes the next one without waiting for the others.
        pool = ThreadPoolExecutor(_cores())
        running = {pool.submit(chunk, start) for start in starts}
        try:
            # Of a second Ctrl-C: chunks under way are not waited for.
            while running and interrupts.count < 2:
                done, running = wait(running, _HEED, FIRST_COMPLETED)
                for each in done:
                    bar.count(*each.result())
        finally:
            pool.shutdown(wait=interrupts.count < 2, cancel_futures=True)
    xs, codes = lanes.finished()
    return multiprocess.gather(xs, size), multiprocess.gather(codes, size)


def one_after_another(
    job: ft.partial,
    rows: np.ndarray,
    state: np.ndarray,
    shape: tuple[int, int],
    checkpoint: Checkpoint | None,
    progress: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Samples, of this shape (samples, k), and outcomes of all lanes, each from the last one's end.

    Every process computes all of them, for none could help another, and then takes the first one's.
    """
    p, n = len(rows), len(state)
    lanes = _Lanes(p, shape, rows.dtype, checkpoint)
    with counted() as interrupts, _Bar(p, progress) as bar:
        call, size = _compiled_job(job, rows, n, True)
        interrupts.keeps = True
        rows = _filled_up(rows, size)
        bar.start(p)
        for start in range(0, p, size):
            if interrupts.count:
                break
            here, real = rows[start : start + size], np.int32(min(size, p - start))
            done, kept = lanes.finish(start, size, ft.partial(call, here, state, real))
            state = done.end
            bar.count(len(done.codes), kept)
    xs, codes = lanes.finished()
    return multiprocess.from_first(xs), multiprocess.from_first(codes)


def _filled_up(rows: np.ndarray, size: int) -> np.ndarray:
    """The last row again behind, up to a multiple of `size`."""
    # All calls have one shape, so that one program serves. A copy takes as long as its lane, beside
    # which it runs, and nothing that a field checks can fail in it and not in its lane.
    return np.pad(rows, [(0, -len(rows) % size), (0, 0)], mode="edge")
