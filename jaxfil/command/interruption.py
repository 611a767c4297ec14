"""Ctrl-C on the command line, with one line on stderr and exit code 130."""

import os
import sys

from jaxfil.sweep.interrupt import Interrupts

INTERRUPTED = 130


class EndsTheProcess(Interrupts):
    """Ends the process at the second Ctrl-C, or at the first if no result can be saved."""

    def __call__(self, number: int, frame: object) -> None:
        super().__call__(number, frame)
        if self.count > 1 or not self.keeps:
            print("\njaxfil: interrupted", file=sys.stderr, flush=True)
            # A regular exit of Python would wait for XLA's threads, or crash with them.
            os._exit(INTERRUPTED)
