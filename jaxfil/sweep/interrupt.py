"""Deferred Ctrl-C.

A `KeyboardInterrupt` that Python raises while XLA compiles passes through code that does not handle
it. It is lost there, or ends the process silently. Signals are therefore counted.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class Interrupts:
    """The number of Ctrl-C signals; called as their handler."""

    def __init__(self) -> None:
        self.count = 0
        self.keeps = False
        """Whether a result is, or soon will be, finished."""

    def __call__(self, number: int, frame: object) -> None:
        """Count one more."""
        self.count += 1


@contextmanager
def counted(interrupts: Interrupts | None = None) -> Iterator[Interrupts]:
    """Count Ctrl-C within the context, instead of raising a `KeyboardInterrupt`. A nested context
    counts in the outer one.

    In a thread other than the main one, or if the signal is ignored or handled elsewhere, the
    context has no effect.
    """
    interrupts = interrupts or Interrupts()
    before = signal.getsignal(signal.SIGINT)
    if isinstance(before, Interrupts):
        yield before
    elif (
        before is not signal.default_int_handler
        or threading.current_thread() is not threading.main_thread()
    ):
        yield interrupts
    else:
        signal.signal(signal.SIGINT, interrupts)
        try:
            yield interrupts
        finally:
            signal.signal(signal.SIGINT, before)
