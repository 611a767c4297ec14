"""Execution of a sweep: chunks of lanes, compiled once, run on every core, stored when finished."""

import functools as ft
import os
import sys
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

import equinox as eqx
import jax
import numpy as np

from jaxfil.model.outcomes import RESULTS, code, outcomes
from jaxfil.sweep import multiprocess
from jaxfil.sweep.checkpoint import Checkpoint, FinishedChunk
from jaxfil.sweep.chunk import Chunk, run_chunk
from jaxfil.sweep.interrupt import counted
from jaxfil.sweep.plan import SweepPlan
from jaxfil.sweep.sampling import Samples
from jaxfil.xla.compiler import makes_whole_kernels
from jaxfil.xla.kernel import BLOCK

# Minimum number of chunks of a sweep, if it has the blocks, so that many cores get some each; and
# maximum number of blocks of a chunk, one stroke of the progress bar.
_CHUNKS, _BLOCKS = 64, 16
# The same on an accelerator: an iteration of ten thousand lanes takes an H100 as long as one of a
# single lane, and more than a hundred thousand lanes gain no more speed.
_BLOCKS_ON_ACCELERATOR = 2048
# Lanes of a chunk when each starts from the end of the previous one. Sequential lanes gain no speed
# from larger chunks, and are stored and counted once per chunk.
_FOLLOW = 16
# Longest delay in seconds of the response to Ctrl-C, if it does not wake the waiting thread.
_HEED = 0.1
# The widest vectors of the machine. (XLA's fast math would be a fifth faster still, but does not
# preserve NaN, whatever its options promise.)
_CPU_OPTIONS = {"xla_cpu_prefer_vector_width": "512"}


@ft.cache
def compiled(run: Callable) -> Callable:
    """`run`, compiled for this machine."""
    # Cached by function, or each sweep would compile again.
    options = _CPU_OPTIONS if jax.default_backend() == "cpu" else None
    # Equinox's overloads lack the keywords that it passes to `jax.jit`.
    return eqx.filter_jit(_traced(run), compiler_options=options)  # pyright: ignore[reportCallIssue]


@ft.cache
def _traced(run: Callable) -> Callable:
    """`run`, whose trace for arguments of the same shapes JAX caches."""
    # Without compiler options, because JAX refuses to trace a function with options inside a trace.
    return eqx.filter_jit(run)


def _compiled_chunk(plan: SweepPlan) -> tuple[Callable[..., Chunk], int]:
    """The compiled program of a chunk, a function of points in parameter space, initial states, and
    the number of lanes to run; and its number of lanes.

    The number of lanes of a chunk depends on the sweep and not on the machine's cores, and a chunk
    is padded with copies of a lane, because the last bits of a lane may depend on the shape for
    which it was compiled.
    """
    (p, k), n, dtype = plan.grid.rows.shape, plan.start.shape[-1], plan.x0.dtype
    followed = plan.follow is not None

    def nowhere(lanes: int) -> tuple[np.ndarray, np.ndarray, np.int32]:
        states = np.zeros((n,) if followed else (lanes, n), dtype)
        return np.zeros((lanes, k), dtype), states, np.int32(0)

    traced, call = (
        ft.partial(function(run_chunk), plan.sampling, followed=followed)
        for function in (_traced, compiled)
    )
    lanes = _FOLLOW if followed else _lanes(p, makes_whole_kernels())
    many = _FOLLOW if followed else _lanes(p, False)
    # Known after tracing, before compilation. JAX caches the trace for the calls.
    if lanes != many and not eqx.filter_eval_shape(traced, *nowhere(lanes)).in_kernels:
        lanes = many
    call(*nowhere(lanes))
    return call, lanes


def _lanes(p: int, in_kernels: bool) -> int:
    """The number of lanes of a chunk. Without single kernels every operation of the loop launches
    its own, and only many lanes compensate for that."""
    blocks = -(-p // BLOCK)  # rounded up
    most = _BLOCKS if jax.default_backend() == "cpu" else _BLOCKS_ON_ACCELERATOR
    return BLOCK * min(-(-blocks // _CHUNKS) if in_kernels else blocks, most)


def _cores() -> int:
    """The number of chunks that run at a time."""
    if jax.default_backend() != "cpu":
        return 1  # an accelerator runs one program after the other
    # The cores granted by a scheduler or `taskset`, which `os.cpu_count` does not know.
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


_UNFINISHED, _SUCCESSFUL = code(RESULTS.interrupted), code(RESULTS.successful)


class _Lanes:
    """All lanes of a sweep, and the progress bar that counts the finished ones."""

    def __init__(self, unfinished: Samples[np.ndarray], checkpoint: Checkpoint | None):
        self.samples = unfinished
        self.codes = np.full((len(unfinished.xs),), _UNFINISHED, np.int32)
        self.checkpoint = checkpoint

    def finish(
        self, start: int, lanes: int, run: Callable[[], Chunk]
    ) -> tuple[FinishedChunk, bool]:
        """The chunk from lane number `start` on, from the checkpoint or from `run`; and whether the
        checkpoint had it."""
        stop = min(start + lanes, len(self.codes))
        kept = self.checkpoint.read(start, stop) if self.checkpoint else None
        if kept is None:
            chunk = _finished(run(), stop - start)
            if self.checkpoint:
                self.checkpoint.write(start, stop, chunk)
        else:
            chunk = kept
        for own, new in zip(*map(jax.tree.leaves, (self.samples, chunk.samples)), strict=True):
            own[start:stop] = new
        self.codes[start:stop] = chunk.codes  # last, because they mark the lanes as finished
        return chunk, kept is not None

    def finished(self) -> tuple[Samples[np.ndarray], np.ndarray]:
        """Current samples and codes of outcomes; NaN for an unfinished lane."""
        if self.checkpoint:
            self.checkpoint.tell_damaged()  # here, because threads of chunks have no caller's line
        codes = self.codes.copy()
        missing = codes == _UNFINISHED
        if not missing.any():
            return self.samples, codes

        def known(own: np.ndarray) -> np.ndarray:  # a running chunk may still be written
            unknown = np.nan if np.issubdtype(own.dtype, np.floating) else 0
            return np.where(missing.reshape(-1, *[1] * (own.ndim - 1)), unknown, own)

        return jax.tree.map(known, self.samples), codes


def _finished(chunk: Chunk, lanes: int) -> FinishedChunk:
    """A chunk without its padding."""
    (codes,) = jax.tree.leaves(chunk.results)
    samples, codes = jax.tree.map(lambda v: np.asarray(v)[:lanes], (chunk.samples, codes))
    return FinishedChunk(samples, codes, np.asarray(chunk.end))


class _Bar:
    """A progress bar that announces compilation and then counts lanes. Lanes of a checkpoint do not
    affect its rate."""

    def __init__(self, total: int, progress: bool):
        from tqdm.auto import tqdm

        shown = progress and jax.process_index() == 0
        self._bar = tqdm(desc="compiling", total=total, unit="lane", disable=not shown)
        self._begun = False

    def __enter__(self) -> "_Bar":
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.close()

    def start(self, total: int) -> None:
        """Begin to count lanes."""
        self._bar.set_description(refresh=False)
        self._bar.reset(total)

    def count(self, codes: np.ndarray, kept: bool) -> None:
        """Count finished lanes with these outcomes. If all of the first lanes have failed, report
        it at once, because the others may fail too."""
        if codes.size and not self._begun and not self._bar.disable:
            self._begun = True
            if not np.any(codes == _SUCCESSFUL):
                why = RESULTS[outcomes(codes[0])]
                told = f"All of the first {codes.size} lanes have failed. The first one: {why}"
                self._bar.write(told, file=sys.stderr)
        # tqdm computes the rate from the count beyond `initial`.
        if kept and not self._bar.disable:
            self._bar.initial += len(codes)
        self._bar.update(len(codes))


def side_by_side(
    plan: SweepPlan, checkpoint: Checkpoint | None, progress: bool
) -> tuple[Samples[np.ndarray], np.ndarray]:
    """Samples and outcomes of all lanes, a chunk at a time on each core of each process."""
    rows = plan.grid.rows
    p, n = len(rows), plan.x0.shape[-1]
    with counted() as interrupts, _Bar(p, progress) as bar:
        call, size = _compiled_chunk(plan)
        interrupts.keeps = True
        states = _filled_up(np.broadcast_to(plan.x0.reshape(-1, n), (p, n)), size)
        rows = _filled_up(rows, size)
        lanes = _Lanes(plan.unfinished(), checkpoint)

        def chunk(start: int) -> tuple[np.ndarray, bool]:
            if interrupts.count:  # before this chunk begins
                return np.zeros(0, np.int32), False
            here = slice(start, start + size)
            real = np.int32(min(size, p - start))
            done, kept = lanes.finish(start, size, lambda: call(rows[here], states[here], real))
            return done.codes, kept

        starts = multiprocess.share(range(0, p, size))
        bar.start(sum(min(size, p - s) for s in starts))  # the lanes of this process alone
        # Threads instead of devices: XLA releases Python's lock while it computes, and a core that
        # has finished a chunk takes the next one without waiting for the others.
        pool = ThreadPoolExecutor(_cores())
        running = {pool.submit(chunk, start) for start in starts}
        try:
            # At a second Ctrl-C, do not wait for running chunks.
            while running and interrupts.count < 2:
                done, running = wait(running, _HEED, FIRST_COMPLETED)
                for future in done:
                    bar.count(*future.result())
        finally:
            pool.shutdown(wait=interrupts.count < 2, cancel_futures=True)
    return jax.tree.map(lambda v: multiprocess.gather(v, size), lanes.finished())


def one_after_another(
    plan: SweepPlan, checkpoint: Checkpoint | None, progress: bool
) -> tuple[Samples[np.ndarray], np.ndarray]:
    """Samples and outcomes of all lanes, each from the end of the previous one.

    Every process computes all of them, because the work cannot be divided, and then uses the
    results of the first process.
    """
    rows, state = plan.grid.rows, plan.start
    # Stable, so that equal values remain in order and a repeated call gives the same diagram.
    order = np.argsort(rows[:, 0], kind="stable")
    order = order if plan.follow == "up" else order[::-1]
    p, lanes = len(rows), _Lanes(plan.unfinished(), checkpoint)
    with counted() as interrupts, _Bar(p, progress) as bar:
        call, size = _compiled_chunk(plan)
        interrupts.keeps = True
        rows = _filled_up(rows[order], size)
        bar.start(p)
        for start in range(0, p, size):
            if interrupts.count:
                break
            here, real = rows[start : start + size], np.int32(min(size, p - start))
            done, kept = lanes.finish(start, size, ft.partial(call, here, state, real))
            state = done.end
            bar.count(done.codes, kept)
    back = np.argsort(order, kind="stable")
    return jax.tree.map(lambda v: multiprocess.from_first(v)[back], lanes.finished())


def _filled_up(rows: np.ndarray, size: int) -> np.ndarray:
    """Rows padded with the last row to a multiple of `size`."""
    # All calls have one shape, so that one program serves. A copy takes as long as its lane and
    # runs next to it, and no check of a field can fail in the copy alone.
    return np.pad(rows, [(0, -len(rows) % size), (0, 0)], mode="edge")
