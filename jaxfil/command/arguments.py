"""The arguments of each command, read without JAX or the names of systems."""

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from jaxfil.command import examples
from jaxfil.command.misuse import Misuse
from jaxfil.command.words import (
    STEPPERS,
    axis,
    number,
    picture,
    positive,
    section,
    setting,
    state,
    whole,
)
from jaxfil.version import __version__

Add = Callable[..., Any]
"""`add_argument` of a parser."""

_SEVERAL: dict[str, Any] = {"nargs": "+", "action": "extend", "default": []}
# The end of a help text, as argparse fills it in.
_DEFAULT = "(default: %(default)s)"
_SPAN = "time span (default: 10 periods, or 10 if unforced)"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        # argparse would print its usage, several lines, and end the process.
        raise Misuse(message)


def read(argv: list[str] | None) -> argparse.Namespace:
    """The parsed arguments, of the process by default; raises `Misuse` if they are invalid."""
    words = _join_negatives(sys.argv[1:] if argv is None else argv)
    args = _parser().parse_args(words or ["--help"])
    if args.command is None and not args.list:
        raise Misuse(f"what to do is missing: {', '.join(_COMMANDS)}, or --list")
    return args


def _parser() -> _Parser:
    shape: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter}
    about = "Nonsmooth dynamical systems in JAX."
    top = _Parser(prog="jaxfil", description=about, epilog=examples.ALL, **shape)
    top.add_argument("--list", action="store_true", help="systems, their parameters and defaults")
    top.add_argument("--version", action="version", version=f"jaxfil {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND")
    for name, (module, does, add_arguments) in _COMMANDS.items():
        epilog = examples.of(name)
        parser = commands.add_parser(name, help=does, epilog=epilog, allow_abbrev=False, **shape)
        # For the code that commands share, where they lack these options.
        parser.set_defaults(module=module, follow=None, error=False, component=0)
        add_arguments(parser.add_argument)
    return top


def _add_simulate(add: Add) -> None:
    _add_system(add)
    add("--time", metavar="T", type=positive, help=_SPAN)
    _add_steps(add)
    _add_picture(add)


def _add_diagram(add: Add) -> None:
    _add_system(add)
    _add_swept(add)
    add("--out", metavar="FILE", type=picture, required=True, help="the picture: FILE.png")
    add("--follow", choices=("up", "down"), help="start each value where its neighbour ended")
    add("--error", action="store_true", help="estimate errors; takes three times as long")
    _add_component(add)
    _add_samples(add, 200, 100)
    _add_section(add)
    _add_sweep(add)
    _add_style(add)


def _add_plane(add: Add) -> None:
    _add_map(add, "P=A:B:N", "two parameters", 200)


def _add_basins(add: Add) -> None:
    _add_map(add, "xI=A:B:N", "two components of the initial state, as x0=-2:2:100", 500)


def _add_map(add: Add, metavar: str, axes: str, transient: int) -> None:
    _add_system(add)
    add("--grid", metavar=metavar, type=axis, nargs=2, required=True, help=axes)
    add("--out", metavar="FILE", type=picture, required=True, help="the picture: FILE.png")
    _add_samples(add, transient, 32)
    _add_section(add)
    _add_sweep(add)
    _add_style(add)


def _add_orbit(add: Add) -> None:
    _add_system(add)
    _add_guess(add)
    _add_steps(add)
    _add_picture(add)


def _add_branch(add: Add) -> None:
    _add_system(add)
    add("--parameter", metavar="P", required=True, help="the parameter to follow the orbit in")
    add("--from", dest="start", metavar="A", type=number, help="its first value (default: as set)")
    add("--to", dest="stop", metavar="B", type=number, required=True, help="its last value")
    _add_guess(add)
    _add_steps(add)
    _add_component(add)
    _add_picture(add)


def _add_spectrum(add: Add) -> None:
    _add_system(add)
    _add_swept(add, required=False)
    add("--periods", metavar="N", type=whole(1), default=1000, help=f"averaged {_DEFAULT}")
    add("--transient", metavar="N", type=whole(0), default=200, help=f"left out {_DEFAULT}")
    add("--interval", metavar="T", type=positive, help="time in place of a period, if unforced")
    _add_steps(add)
    _add_picture(add)


def _add_table(add: Add) -> None:
    _add_system(add)
    add("--time", metavar="T", type=positive, help=_SPAN)
    add("--steps", metavar="N", type=whole(1), help="a period (or unit of time)", **_SEVERAL)
    add("--steppers", metavar="S", choices=STEPPERS, help=", ".join(STEPPERS), **_SEVERAL)
    add("--lanes", metavar="N", type=whole(1), default=1, help=f"timed at once {_DEFAULT}")
    _add_picture(add)


def _add_show(add: Add) -> None:
    add("file", metavar="FILE", type=Path, help="what `save` or a command here has written")
    name = "FILE.py:CLASS of the system of an orbit or a branch, if it is your own"
    add("system", metavar="NAME", nargs="?", help=name)
    _add_picture(add)


def _add_system(add: Add) -> None:
    add("system", metavar="NAME", help="a system that --list names, or FILE.py:CLASS")
    add("--set", metavar="P=VALUE", type=setting, help="other parameters", **_SEVERAL)
    add("--x0", metavar="A,B", type=state, help="initial state (default: that of --list)")


def _add_component(add: Add) -> None:
    meaning = f"of the state {_DEFAULT}"
    add("--component", metavar="I", type=whole(0), default=0, help=meaning)


def _add_swept(add: Add, required: bool = True) -> None:
    add("--parameter", metavar="P", required=required, help="the parameter to sweep")
    add("--from", dest="start", metavar="A", type=number, required=required, help="first value")
    add("--to", dest="stop", metavar="B", type=number, required=required, help="last value")
    add("--points", metavar="N", type=whole(1), required=required, help="how many values")


def _add_samples(add: Add, transient: int, samples: int) -> None:
    add("--transient", metavar="N", type=whole(0), default=transient, help=f"left out {_DEFAULT}")
    add("--samples", metavar="N", type=whole(1), default=samples, help=f"periods seen {_DEFAULT}")


def _add_section(add: Add) -> None:
    where = "sample where x0=0, or x0=0,up, or max:x0, and not once a period"
    add("--section", metavar="S", type=section, help=where)
    add("--max-return", metavar="T", type=positive, help="a time longer than a mean return")


def _add_steps(add: Add) -> None:
    meaning = f"steps a period (or unit of time) {_DEFAULT}"
    add("--steps", metavar="N", type=whole(1), default=40, help=meaning)
    add("--stepper", choices=STEPPERS, help="the method of a step (default: Dopri8)")


def _add_sweep(add: Add) -> None:
    _add_steps(add)
    add("--checkpoint", metavar="FOLDER", type=Path, help="keep finished lanes, and go on there")
    grade = "a program that compiles fast or one that runs fast, as in jaxfil.solve"
    add("--compact", action=argparse.BooleanOptionalAction, help=grade)
    add("--quiet", action="store_true", help="no progress bar and no summary")


def _add_guess(add: Add) -> None:
    add("--periods", metavar="N", type=whole(1), default=1, help=f"of the force {_DEFAULT}")
    add("--period", metavar="T", type=positive, help="a guess of the period, if unforced")
    add("--transient", metavar="N", type=whole(0), default=0, help=f"run first {_DEFAULT}")


def _add_picture(add: Add) -> None:
    add("--out", metavar="FILE", type=picture, help="a picture: FILE.png (default: none)")
    _add_style(add)


def _add_style(add: Add) -> None:
    add("--title", metavar="TEXT", help="over the picture (default: the conditions)")
    add("--dpi", metavar="N", type=whole(1), help="dots per inch of the picture (default: 200)")
    add("--no-cache", action="store_true", help="compile anew, and keep nothing compiled on disk")


# The file of a command in this folder, its description, and its arguments.
_COMMANDS: dict[str, tuple[str, str, Callable[[Add], None]]] = {
    "simulate": ("simulate", "run a system, and draw its motion", _add_simulate),
    "diagram": ("diagram", "draw a bifurcation diagram", _add_diagram),
    "plane": ("diagram", "draw the periods of the motion over two parameters", _add_plane),
    "basins": ("basins", "draw basins of attraction", _add_basins),
    "orbit": ("orbit", "find a periodic orbit", _add_orbit),
    "branch": ("orbit", "follow a periodic orbit in a parameter", _add_branch),
    "bifurcations": ("orbit", "find and name the bifurcations of a periodic orbit", _add_branch),
    "spectrum": ("spectrum", "compute Lyapunov exponents", _add_spectrum),
    "work-precision": ("table", "error against run time over steppers and steps", _add_table),
    "show": ("show", "print, or draw, what a file holds", _add_show),
}


def _join_negatives(argv: list[str]) -> list[str]:
    """Join `--x0 -1,2` to `--x0=-1,2`, because argparse reads a leading minus as an option."""
    joined: list[str] = []
    for word in argv:
        if joined and re.fullmatch(r"--[a-z0-9-]+", joined[-1]) and re.match(r"-[\d.]", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined
