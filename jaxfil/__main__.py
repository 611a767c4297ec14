"""The command line: arguments enter, a picture or a table, its numbers and one line leave.

    python -m jaxfil --list
    python -m jaxfil diagram sd-oscillator --parameter omega --from 0.6 --to 1.3 --points 2000 \
        --out sd.png
    python -m jaxfil work-precision belt-friction --out belt.png

Whatever cannot be done is answered by one line on stderr that says what is allowed, and exit code
2, before any computing starts. Exit code 1: no lane of the sweep reached its end. Ctrl-C is
answered by one line too, and exit code 130: a diagram of the lanes that are finished is drawn and
saved. A second one, or one that nothing could be kept of, ends the process at once.
"""

import argparse
import functools as ft
import signal
import sys
from collections.abc import Callable

from jaxfil.command.arguments import Misuse, read


def main(argv: list[str] | None = None) -> int:
    """Do what `argv` (or the command line) asks; the exit code leaves."""
    return _prepared(argv)()


def _prepared(argv: list[str] | None) -> Callable[[], int]:
    """What is to be done, with everything imported that it takes."""
    try:
        args = read(argv)
        # JAX comes with what follows, a second after what needs none of it has been answered.
        from jaxfil.command import textbook

        if args.list:
            return ft.partial(_told, textbook.listing())
        if args.command == "work-precision":
            textbook.check_table(args)
            from jaxfil.command.table import run
        else:
            textbook.check_diagram(args)
            from jaxfil.command.diagram import run
    except Misuse as misuse:
        return ft.partial(_refused, str(misuse))
    return ft.partial(_done, run, args)


def _told(text: str) -> int:
    print(text)
    return 0


def _refused(why: str) -> int:
    print(f"jaxfil: {why}", file=sys.stderr)
    return 2


def _done(run: Callable[..., int], args: argparse.Namespace) -> int:
    import jax

    from jaxfil.command.interruption import EndsTheProcess
    from jaxfil.sweep.interrupt import counted
    from jaxfil.xla.disk_cache import keep_compiled_programs

    jax.config.update("jax_enable_x64", True)  # nobody asks for a picture in float32
    if not args.no_cache:
        keep_compiled_programs("jaxfil")
    interrupts = EndsTheProcess()
    with counted(interrupts):
        return run(args, interrupts)


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
