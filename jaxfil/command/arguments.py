"""The words of the command line: words enter, their values or a misuse leave.

Nothing here needs JAX or the names of systems, so that it is answered at once.
"""

import argparse
import math
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from jaxfil.version import __version__

PICTURES = (".png", ".pdf", ".svg")
STEPPERS = ("RK4", "Tsit5", "Dopri8", "Taylor", "Rodas5P")

_EXAMPLES = """\
examples:
  python -m jaxfil --list
  python -m jaxfil diagram sd-oscillator --parameter omega --from 0.6 --to 1.3 --points 2000 \\
      --out sd.png
  python -m jaxfil work-precision belt-friction --out belt.png
"""
_DIAGRAM = """\
examples:
  python -m jaxfil diagram sd-oscillator --parameter omega --from 0.6 --to 1.3 --points 2000 \\
      --out sd.png
  python -m jaxfil diagram belt-friction --parameter omega --from 4.6 --to 4.4 --points 500 \\
      --follow down --set f0=9 gamma1=1 --x0 -0.1,0.5 --component 1 --out belt.pdf
  python -m jaxfil diagram impact-oscillator --parameter amplitude --from 0.3 --to 0.9 \\
      --points 800 --title "A mass and a wall" --dpi 300 --out wall.png

Beside FILE.png its numbers are saved as FILE.npz, for jaxfil.load and numpy.load.
"""
_WORK_PRECISION = """\
examples:
  python -m jaxfil work-precision belt-friction --out belt.png
  python -m jaxfil work-precision slip-stick --time 50 --steps 10 20 40 --steppers RK4 Tsit5
"""


class Misuse(Exception):
    """A command line that cannot be carried out; its one-line message says what is allowed."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        # argparse would print its usage, which is longer than a line, and end the process.
        raise Misuse(message)


def read(argv: list[str] | None) -> argparse.Namespace:
    """The values of the words, those of the process by default; `Misuse` if they have none."""
    words = _join_negatives(sys.argv[1:] if argv is None else argv)
    args = _parser().parse_args(words or ["--help"])
    if args.command is None and not args.list:
        raise Misuse("what to do is missing: diagram, work-precision, or --list")
    return args


def _parser() -> _Parser:
    shape: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter}
    about = "Nonsmooth dynamical systems in JAX."
    top = _Parser(prog="python -m jaxfil", description=about, epilog=_EXAMPLES, **shape)
    top.add_argument("--list", action="store_true", help="systems, their parameters and defaults")
    top.add_argument("--version", action="version", version=f"jaxfil {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND")
    shape["allow_abbrev"] = False
    does = "draw a bifurcation diagram"
    _add_diagram(commands.add_parser("diagram", help=does, epilog=_DIAGRAM, **shape))
    does = "error against run time over steppers and steps"
    _add_table(commands.add_parser("work-precision", help=does, epilog=_WORK_PRECISION, **shape))
    return top


def _add_diagram(parser: _Parser) -> None:
    add: Callable[..., Any] = parser.add_argument
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
    add("--stepper", choices=STEPPERS, help="the method of a step: Dopri8")
    add("--checkpoint", metavar="FOLDER", type=Path, help="keep finished lanes, and go on there")
    add("--follow", choices=("up", "down"), help="start each value where its neighbour ended")
    grade = "a program that compiles fast or one that runs fast, as in jaxfil.solve"
    add("--compact", action=argparse.BooleanOptionalAction, help=grade)
    add("--component", metavar="I", type=whole, default=0, help="of the state: %(default)s")
    add("--quiet", action="store_true", help="no progress bar and no summary")
    _add_common(add)


def _add_table(parser: _Parser) -> None:
    add: Callable[..., Any] = parser.add_argument
    positive = _whole(1)
    add("system", metavar="NAME", help="a system that --list names")
    add("--time", metavar="T", type=_number, help="time span: 10 periods, or 10 unforced")
    several = {"nargs": "+", "action": "extend", "default": []}
    add("--steps", metavar="N", type=positive, help="a period (or unit of time)", **several)
    add("--steppers", metavar="S", choices=STEPPERS, help=", ".join(STEPPERS), **several)
    add("--lanes", metavar="N", type=positive, default=1, help="timed at once: %(default)s")
    add("--out", metavar="FILE", type=_picture, help="a picture, FILE.png say: none")
    _add_common(add)


def _add_common(add: Callable[..., Any]) -> None:
    several = {"nargs": "+", "action": "extend", "default": []}
    add("--set", metavar="P=VALUE", type=_setting, help="other parameters", **several)
    add("--x0", metavar="A,B", type=_state, help="initial state: the one that --list shows")
    add("--title", metavar="TEXT", help="over the picture: what was asked for")
    add("--dpi", metavar="N", type=_whole(1), help="dots per inch of the picture: 200")
    add("--no-cache", action="store_true", help="compile anew, and keep nothing compiled on disk")


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
