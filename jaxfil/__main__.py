"""The command line: arguments enter, a picture or a table, its numbers and one line leave.

    python -m jaxfil --list
    python -m jaxfil diagram sd-oscillator --parameter omega --from 0.6 --to 1.3 --points 2000 \
        --out sd.png
    python -m jaxfil simulate mine.py:Valve --x0 1,0 --time 40 --out motion.png

Whatever cannot be done is answered by one line on stderr that says what is allowed, and exit code
2, before any computing starts. Exit code 1: no run or lane of a sweep reached its end. Ctrl-C is
answered by one line too, and exit code 130: a diagram of the lanes that are finished is drawn and
saved. A second one, or one that nothing could be kept of, ends the process at once.
"""

import argparse
import functools as ft
import importlib
import signal
import sys
import traceback
from collections.abc import Callable
from typing import Any

from jaxfil.command.arguments import read
from jaxfil.command.misuse import Misuse


def main(argv: list[str] | None = None) -> int:
    """Do what `argv` (or the command line) asks; the exit code leaves."""
    return _prepared(argv)()


def _prepared(argv: list[str] | None) -> Callable[[], int]:
    """What is to be done, with everything imported that it takes."""
    try:
        args = read(argv)
        # JAX comes with what follows, a second after what needs none of it has been answered.
        import jax

        from jaxfil.command import chosen

        if args.list:
            return ft.partial(_told, chosen.listing())
        # Nobody asks for a picture in float32; an own file may make arrays when it is imported.
        jax.config.update("jax_enable_x64", True)
        command = importlib.import_module(f"jaxfil.command.{args.module}")
        of = None if args.command == "show" else chosen.chosen(args)
        command.check(args, of)
    except Misuse as misuse:
        return ft.partial(_refused, str(misuse))
    return ft.partial(_done, command.run, args, of)


def _told(text: str) -> int:
    print(text)
    return 0


def _refused(why: str) -> int:
    print(f"jaxfil: {why}", file=sys.stderr)
    return 2


def _done(run: Callable[..., int], args: argparse.Namespace, of: Any) -> int:
    from jaxfil.command.interruption import EndsTheProcess
    from jaxfil.sweep.interrupt import counted
    from jaxfil.xla.disk_cache import keep_compiled_programs

    if not args.no_cache:
        keep_compiled_programs("jaxfil")
    interrupts = EndsTheProcess()
    with counted(interrupts):
        try:
            return run(args, of, interrupts)
        except ValueError as error:
            # The library's are sentences; one from within a file of the user's own is shown whole.
            file = (args.system or "").rpartition(":")[0]
            frames = traceback.extract_tb(error.__traceback__)
            if file and any(frame.filename.endswith(file) for frame in frames):
                raise
            return _refused(str(error))


def script() -> int:
    """`main` of a process that does nothing else."""
    heeded = callable(signal.getsignal(signal.SIGINT))  # and not ignored, as in the background
    todo = _prepared(None)
    if heeded:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # until here it is `jaxfil`'s own
    exit_code = todo()
    if heeded:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # there is nothing left to interrupt
    return exit_code


if __name__ == "__main__":
    sys.exit(script())
