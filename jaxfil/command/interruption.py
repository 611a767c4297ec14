"""Ctrl-C on the command line: a signal enters, a line on stderr and exit code 130 leave."""

import os
import sys

from jaxfil.sweep.interrupt import Interrupts

INTERRUPTED = 130


class EndsTheProcess(Interrupts):
    """Ctrl-C that ends the process: the first one if nothing is kept, and the second one."""

    def __call__(self, number: int, frame: object) -> None:
        super().__call__(number, frame)
        if self.count > 1 or not self.keeps:
            print("\njaxfil: interrupted", file=sys.stderr, flush=True)
            # Python's own end would wait for what XLA compiles and computes, or trip over it.
            os._exit(INTERRUPTED)
