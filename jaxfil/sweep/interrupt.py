"""Ctrl-C, put off until it can be heeded.

Signals enter; a count of them leaves. A `KeyboardInterrupt` that Python raises while XLA compiles
passes through code that is not made for it: it is lost there, or ends the process without a word.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class Interrupts:
    """How often Ctrl-C has been pressed; called as the handler of its signal."""

    def __init__(self) -> None:
        self.count = 0
        self.keeps = False
        """Whether there is, or soon will be, something finished."""

    def __call__(self, number: int, frame: object) -> None:
        """Count one more."""
        self.count += 1


@contextmanager
def counted(interrupts: Interrupts | None = None) -> Iterator[Interrupts]:
    """Count Ctrl-C within, instead of raising a `KeyboardInterrupt`; within another one of these,
    in that one.

    In a thread that is not the main one, and where somebody else handles the signal, or it is
    ignored, everything stays as it is.
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
