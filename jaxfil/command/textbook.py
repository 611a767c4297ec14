"""The textbook systems as the command line knows them: names enter, classes and states leave."""

import argparse
import dataclasses
import difflib
from collections.abc import Iterable
from typing import Any

from jaxfil.command.arguments import Misuse
from jaxfil.model.system import System
from jaxfil.systems import TEXTBOOK


def listing() -> str:
    """Every system with its parameters, their defaults and its initial state."""
    lines = []
    for name, (cls, x0) in TEXTBOOK.items():
        parameters = " ".join(f"{p}={value:.10g}" for p, value in defaults(name).items())
        kind = "" if is_forced(cls) else " (not forced: no diagram)"
        lines.append(f"{name}{kind}\n    {parameters or 'no parameters'}, from {text(x0)}")
    return "\n".join(lines)


def defaults(name: str) -> dict[str, float]:
    """The parameters of a system and their defaults."""
    given: dict[str, Any] = {f.name: f.default for f in dataclasses.fields(TEXTBOOK[name][0])}
    return {parameter: float(value) for parameter, value in given.items()}


def is_forced(cls: type[System]) -> bool:
    """Whether a system has a period."""
    return cls().period is not None


def check_diagram(args: argparse.Namespace) -> None:
    """Refuse names and values that do not fit a forced system."""
    forced = [name for name, (cls, _) in TEXTBOOK.items() if is_forced(cls)]
    if args.system in TEXTBOOK and args.system not in forced:
        raise Misuse(f"{args.system} has no forcing to sample at; {', '.join(forced)} have")
    _one_of("NAME", args.system, forced)
    own = defaults(args.system)
    _one_of("--parameter", args.parameter, own)
    for name, _ in args.set:
        _one_of("--set", name, [p for p in own if p != args.parameter])
    n = len(state(args))
    if args.component >= n:
        raise Misuse(f"--component must be from 0 to {n - 1}, it was {args.component}")


def check_table(args: argparse.Namespace) -> None:
    """Refuse names and values that do not fit a system."""
    _one_of("NAME", args.system, TEXTBOOK)
    for name, _ in args.set:
        _one_of("--set", name, defaults(args.system))
    state(args)
    if args.time is not None and args.time <= 0:
        raise Misuse(f"--time must be positive, it was {args.time:g}")


def state(args: argparse.Namespace) -> tuple[float, ...]:
    """The initial state asked for, or the system's own."""
    default = TEXTBOOK[args.system][1]
    x0 = args.x0 or default
    if len(x0) != len(default):
        raise Misuse(f"--x0 must be {len(default)} numbers for {args.system}, it was {len(x0)}")
    return x0


def text(x0: tuple[float, ...]) -> str:
    """A state in a title."""
    return f"({', '.join(f'{value:.10g}' for value in x0)})"


def _one_of(what: str, name: str, allowed: Iterable[str]) -> None:
    if name not in allowed:
        told = f"{what} must be one of {', '.join(allowed)}; it was {name!r}"
        raise Misuse(f"{told}{_suggestion(name, allowed)}")


def _suggestion(name: str, allowed: Iterable[str]) -> str:
    """A question after the name that was probably meant, if one is near."""
    plain = {_folded(known): known for known in allowed}
    near = difflib.get_close_matches(_folded(name), plain, n=1)
    return f"; did you mean {plain[near[0]]!r}?" if near else ""


def _folded(name: str) -> str:
    return name.lower().replace("_", "-")
