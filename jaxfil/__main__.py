"""The command line.

    python -m jaxfil --list
    python -m jaxfil diagram sd-oscillator --parameter omega --from 0.6 --to 1.3 --points 2000 \
        --out sd.png
    python -m jaxfil simulate mine.py:Valve --x0 1,0 --time 40 --out motion.png

An invalid command is answered by one line on stderr that states the valid arguments, and exit code
2, before any computation starts. Exit code 1: no run or lane of a sweep reached its end. Ctrl-C is
answered by one line and exit code 130; a diagram of the finished lanes is drawn and saved. A second
Ctrl-C, or one without finished lanes, ends the process at once.
"""

import argparse
import functools as ft
import importlib
import signal
import sys
import traceback
from collections.abc import Callable
from types import ModuleType
from typing import Any

from jaxfil.command.arguments import read
from jaxfil.command.misuse import Misuse


def main(argv: list[str] | None = None) -> int:
    """Run the command of `argv` (or of the process); returns the exit code."""
    return _prepared(argv)()


def _prepared(argv: list[str] | None) -> Callable[[], int]:
    """The checked command, with all its modules imported."""
    try:
        args = read(argv)
        # The next imports load JAX, which takes a second.
        import jax

        from jaxfil.command import chosen

        if args.list:
            return ft.partial(_told, chosen.listing())
        # Set before a user's file is imported, which may create arrays.
        jax.config.update("jax_enable_x64", True)
        command = importlib.import_module(f"jaxfil.command.{args.module}")
        return _checked(command, args)
    except Misuse as misuse:
        return ft.partial(_refused, str(misuse))


def _checked(command: ModuleType, args: argparse.Namespace) -> Callable[[], int]:
    """The command of these arguments, which fit its system."""
    from jaxfil.command import chosen

    try:
        of = None if args.command == "show" else chosen.chosen(args)
        command.check(args, of)
    except ValueError as error:
        if _is_in_users_file(args, error):
            raise
        return ft.partial(_refused, str(error))
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
            if _is_in_users_file(args, error):
                raise
            return _refused(str(error))


def _is_in_users_file(args: argparse.Namespace, error: ValueError) -> bool:
    """Whether an error is from within a user's file, and is shown in full; those of the library are
    sentences."""
    file = (args.system or "").rpartition(":")[0]
    frames = traceback.extract_tb(error.__traceback__)
    return bool(file) and any(frame.filename.endswith(file) for frame in frames)


def script() -> int:
    """`main` as a process of its own."""
    heeded = callable(signal.getsignal(signal.SIGINT))  # not ignored, as in the background
    todo = _prepared(None)
    if heeded:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # replaces `jaxfil`'s own
    exit_code = todo()
    if heeded:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the work is done
    return exit_code


if __name__ == "__main__":
    sys.exit(script())
