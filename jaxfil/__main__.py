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
import dataclasses
import math
import os
import re
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NoReturn

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxfil.integrate.rosenbrock import Rodas5P
from jaxfil.integrate.stepper import RK4
from jaxfil.integrate.work_precision import work_precision
from jaxfil.model.outcomes import outcome_names
from jaxfil.model.system import System
from jaxfil.sweep import dataset_io
from jaxfil.sweep.diagram import BifurcationDiagram
from jaxfil.sweep.interrupt import Interrupts, counted
from jaxfil.sweep.sweep import bifurcation_diagram
from jaxfil.systems import TEXTBOOK
from jaxfil.xla.disk_cache import keep_compiled_programs

_NO_CACHE = "compile anew, and keep nothing compiled on disk"
PICTURES = (".png", ".pdf", ".svg")
STEPPERS = {
    "RK4": RK4(),
    "Tsit5": diffrax.Tsit5(),
    "Dopri8": diffrax.Dopri8(),
    "Rodas5P": Rodas5P(),
}


def main(argv: list[str] | None = None) -> int:
    """Do what `argv` (or the command line) asks; the exit code leaves."""
    interrupts = _EndsTheProcess()
    with counted(interrupts):
        return _done(argv, interrupts)


class _EndsTheProcess(Interrupts):
    """Ctrl-C that ends the process: the first one if nothing is kept, and the second one."""

    def __call__(self, number: int, frame: object) -> None:
        super().__call__(number, frame)
        if self.count > 1 or not self.keeps:
            print("\njaxfil: interrupted", file=sys.stderr, flush=True)
            # Python's own end would wait for what XLA compiles and computes, or trip over it.
            os._exit(_INTERRUPTED)


_INTERRUPTED = 130


def _done(argv: list[str] | None, interrupts: _EndsTheProcess) -> int:
    jax.config.update("jax_enable_x64", True)  # nobody asks for a picture in float32
    try:
        args = _parser().parse_args(_join_negatives(sys.argv[1:] if argv is None else argv))
        if args.list:
            print(_listing())
            return 0
        if args.command is None:
            raise _Misuse("what to do is missing: diagram, work-precision, or --list")
        if not args.no_cache:
            keep_compiled_programs("jaxfil")
        if args.command == "work-precision":
            return _work_precision(args)
        return _diagram(args, interrupts)
    except _Misuse as misuse:
        print(f"jaxfil: {misuse}", file=sys.stderr)
        return 2


class _Misuse(Exception):
    """A command line that cannot be carried out; its one-line message says what is allowed."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        # argparse would print its usage, which is longer than a line, and end the process.
        raise _Misuse(message)


def _parser() -> _Parser:
    top = _Parser(prog="python -m jaxfil", description="Nonsmooth dynamical systems in JAX.")
    top.add_argument("--list", action="store_true", help="systems, their parameters and defaults")
    commands = top.add_subparsers(dest="command", metavar="COMMAND")
    _work_precision_parser(commands)
    diagram = commands.add_parser("diagram", help="draw a bifurcation diagram", allow_abbrev=False)
    add: Callable[..., Any] = diagram.add_argument
    whole, positive = _whole(0), _whole(1)
    add("system", metavar="NAME", help="a forced system that --list names")
    add("--parameter", metavar="P", required=True, help="the parameter to sweep")
    add("--from", dest="start", metavar="A", type=_number, required=True, help="its first value")
    add("--to", dest="stop", metavar="B", type=_number, required=True, help="its last value")
    add("--points", metavar="N", type=positive, required=True, help="how many values")
    add("--out", metavar="FILE", type=_picture, required=True, help="the picture, FILE.png say")
    add("--transient", metavar="N", type=whole, default=200, help="periods left out: %(default)s")
    add("--samples", metavar="N", type=positive, default=100, help="periods seen: %(default)s")
    add("--steps", metavar="N", type=positive, default=40, help="steps a period: %(default)s")
    add("--x0", metavar="A,B", type=_state, help="initial state: the one that --list shows")
    add("--follow", choices=("up", "down"), help="start each value where its neighbour ended")
    several = {"nargs": "+", "action": "extend", "default": []}
    add("--set", metavar="P=VALUE", type=_setting, help="other parameters", **several)
    add("--component", metavar="I", type=whole, default=0, help="of the state: %(default)s")
    add("--quiet", action="store_true", help="no progress bar and no summary")
    add("--no-cache", action="store_true", help=_NO_CACHE)
    return top


def _work_precision_parser(commands: "argparse._SubParsersAction[_Parser]") -> None:
    help_ = "error against run time over steppers and steps"
    add: Callable[..., Any] = commands.add_parser(
        "work-precision", help=help_, allow_abbrev=False
    ).add_argument
    positive = _whole(1)
    add("system", metavar="NAME", help="a system that --list names")
    add("--time", metavar="T", type=_number, help="time span: 10 periods, or 10 unforced")
    several = {"nargs": "+", "action": "extend", "default": []}
    add("--steps", metavar="N", type=positive, help="a period (or unit of time)", **several)
    add("--steppers", metavar="S", choices=list(STEPPERS), help=", ".join(STEPPERS), **several)
    add("--set", metavar="P=VALUE", type=_setting, help="parameters", **several)
    add("--x0", metavar="A,B", type=_state, help="initial state: the one that --list shows")
    add("--lanes", metavar="N", type=positive, default=1, help="timed at once: %(default)s")
    add("--out", metavar="FILE", type=_picture, help="a picture, FILE.png say: none")
    add("--no-cache", action="store_true", help=_NO_CACHE)


def _work_precision(args: argparse.Namespace) -> int:
    """Print the table, and draw it where --out says so."""
    _one_of("NAME", args.system, TEXTBOOK)
    cls, default = TEXTBOOK[args.system]
    for name, _ in args.set:
        _one_of("--set", name, _defaults(cls))
    x0 = _state_of(args, default)
    system = cls(**dict(args.set))
    unit = 1.0 if system.period is None else float(system.period)
    span = 10 * unit if args.time is None else args.time
    if span <= 0:
        raise _Misuse(f"--time must be positive, it was {span:g}")
    table = work_precision(
        system,
        jnp.array(x0),
        span,
        [STEPPERS[name] for name in args.steppers or STEPPERS],
        [unit / n for n in args.steps or (20, 40, 80, 160)],
        lanes=args.lanes,
    )
    print(table)
    if args.out is not None:
        from jaxfil import plot

        page = plot.page()
        ax = plot.work_precision(table, page.add_subplot())
        ax.set_title(f"{args.system}, from {_text(x0)} to t = {span:.10g}", fontsize="small")
        page.savefig(args.out)
    return 0 if table.reached.any() else 1


def _state_of(args: argparse.Namespace, default: tuple[float, ...]) -> tuple[float, ...]:
    """The initial state asked for, or the system's own."""
    x0 = args.x0 or default
    if len(x0) != len(default):
        raise _Misuse(f"--x0 must be {len(default)} numbers for {args.system}, it was {len(x0)}")
    return x0


def _diagram(args: argparse.Namespace, interrupts: _EndsTheProcess) -> int:
    settings = dict(args.set)
    x0 = _check(args, settings)
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The sweep was interrupted", RuntimeWarning)
        diagram = bifurcation_diagram(
            TEXTBOOK[args.system][0](**{args.parameter: args.start, **settings}),
            args.parameter,
            jnp.asarray(np.linspace(args.start, args.stop, args.points)),
            jnp.array(x0),
            transient=args.transient,
            samples=args.samples,
            steps=args.steps,
            follow=args.follow,
            progress=not args.quiet,
        )
    seconds = time.perf_counter() - start
    outcomes = outcome_names(diagram.results)
    finished = int((outcomes != "interrupted").sum())
    if not finished:
        print("jaxfil: interrupted before a lane was finished", file=sys.stderr)
        return _INTERRUPTED
    _draw(diagram, args, _conditions(args, settings, x0))
    _save(diagram, args, settings)
    if finished < args.points:
        written = f"wrote {args.out} and {args.out.with_suffix('.npz')}"
        lanes = f"{finished} of {args.points} lanes are finished"
        print(f"jaxfil: interrupted: {lanes}; {written}", file=sys.stderr)
        return _INTERRUPTED
    if not args.quiet:
        print(_summary(args, outcomes, seconds))
    if interrupts.count:  # while it was drawn
        return _INTERRUPTED
    return 0 if (outcomes == "successful").any() else 1


def _check(args: argparse.Namespace, settings: dict[str, float]) -> tuple[float, ...]:
    """Refuse names and values that do not fit the system; the initial state leaves."""
    forced = [name for name in TEXTBOOK if TEXTBOOK[name][0]().period is not None]
    if args.system in TEXTBOOK and args.system not in forced:
        raise _Misuse(f"{args.system} has no forcing to sample at; {', '.join(forced)} have")
    _one_of("NAME", args.system, forced)
    cls, default = TEXTBOOK[args.system]
    _one_of("--parameter", args.parameter, _defaults(cls))
    for name in settings:
        _one_of("--set", name, [p for p in _defaults(cls) if p != args.parameter])
    x0 = _state_of(args, default)
    if args.component >= len(x0):
        raise _Misuse(f"--component must be from 0 to {len(x0) - 1}, it was {args.component}")
    return x0


def _one_of(what: str, name: str, allowed: Iterable[str]) -> None:
    if name not in allowed:
        raise _Misuse(f"{what} must be one of {', '.join(allowed)}; it was {name!r}")


def _defaults(cls: type[System]) -> dict[str, float]:
    defaults: dict[str, Any] = {f.name: f.default for f in dataclasses.fields(cls)}
    return {name: float(value) for name, value in defaults.items()}


def _listing() -> str:
    lines = []
    for name, (cls, x0) in TEXTBOOK.items():
        parameters = " ".join(f"{p}={value:.10g}" for p, value in _defaults(cls).items())
        kind = "" if cls().period is not None else " (not forced: no diagram)"
        lines.append(f"{name}{kind}\n    {parameters or 'no parameters'}, from {_text(x0)}")
    return "\n".join(lines)


def _conditions(args: argparse.Namespace, settings: dict[str, float], x0: tuple[float, ...]) -> str:
    """What the picture cannot show and a reader needs to make it again."""
    given = "".join(f", {name} = {value:.10g}" for name, value in settings.items())
    follow = f" and on {args.follow}" if args.follow else ""
    periods = f"{args.transient} + {args.samples} periods of {args.steps} steps"
    return f"{args.system}{given}, from {_text(x0)}{follow}, {periods}"


def _summary(args: argparse.Namespace, outcomes: np.ndarray, seconds: float) -> str:
    names, counts = np.unique(outcomes, return_counts=True)
    ended = ", ".join(f"{count} {name}" for name, count in zip(names, counts, strict=True))
    return (
        f"{args.points} values of {args.parameter} in {seconds:.1f} s: {ended}; "
        f"wrote {args.out} and {args.out.with_suffix('.npz')}"
    )


def _draw(diagram: BifurcationDiagram, args: argparse.Namespace, title: str) -> None:
    from jaxfil import plot  # here, so that mistakes are answered without loading matplotlib

    page = plot.page()
    ax = plot.bifurcation_diagram(diagram, page.add_subplot(), args.component)
    ax.set_title(title, fontsize="small")
    page.savefig(args.out)


def _save(
    diagram: BifurcationDiagram, args: argparse.Namespace, settings: dict[str, float]
) -> None:
    """Everything in the picture, and what it takes to make it again, beside it as .npz."""
    # From the defaults and not from the diagram: a parameter may be None, as alpha = 0 is.
    parameters = _defaults(TEXTBOOK[args.system][0]) | settings
    del parameters[args.parameter]
    asked = {
        "system": args.system,
        "samples": args.samples,
        "follow": args.follow or "",
        "fixed_names": np.array(list(parameters)),
        "fixed_values": np.array(list(parameters.values())),
    }
    data = diagram.named_arrays()
    data = dataclasses.replace(data, attributes={**data.attributes, **asked})
    dataset_io.save(data, args.out.with_suffix(".npz"))


def _join_negatives(argv: list[str]) -> list[str]:
    """Glue `--x0 -1,2` into `--x0=-1,2`: argparse takes what starts with a minus for an option."""
    joined: list[str] = []
    for word in argv:
        if joined and re.fullmatch(r"--[a-z0-9]+", joined[-1]) and re.match(r"-[\d.]", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a finite number, it was {text!r}")
    return value


def _whole(least: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        # `int` alone would also take "1_000", " 5" and "+5".
        if not re.fullmatch(r"\d+", text) or int(text) < least:
            message = f"must be a whole number of {least} or more, it was {text!r}"
            raise argparse.ArgumentTypeError(message)
        return int(text)

    return parse


def _state(text: str) -> tuple[float, ...]:
    return tuple(_number(part) for part in text.split(","))


def _setting(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"must be P=VALUE, it was {text!r}")
    return name, _number(value)


def _picture(text: str) -> Path:
    # What cannot be written is told before hours of computing, not after.
    path = Path(text)
    if path.suffix not in PICTURES:
        raise argparse.ArgumentTypeError(f"must end in {', '.join(PICTURES)}; it was {text!r}")
    if not os.access(path.parent, os.W_OK):
        raise argparse.ArgumentTypeError(f"must be in a folder to write to, it was {text!r}")
    return path


def _text(x0: tuple[float, ...]) -> str:
    return f"({', '.join(f'{value:.10g}' for value in x0)})"


if __name__ == "__main__":
    heeded = callable(signal.getsignal(signal.SIGINT))  # and not ignored, as in the background
    if heeded:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # until here it is `jaxfil`'s own
    exit_code = main()
    if heeded:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # there is nothing left to interrupt
    sys.exit(exit_code)
