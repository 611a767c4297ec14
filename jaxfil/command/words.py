"""Conversion of single arguments of the command line, without JAX."""

import argparse
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

PICTURES = (".png", ".pdf", ".svg")
# The keys of `steppers.STEPPERS`, here without JAX.
STEPPERS = ("RK4", "Tsit5", "Dopri8", "Taylor", "Rodas5P")


class Axis(NamedTuple):
    """Evenly spaced values of a parameter, or of a component of the state."""

    name: str
    start: float
    stop: float
    points: int


class SectionWords(NamedTuple):
    """A section at a value of a component, or at its maxima or minima."""

    kind: str
    """"at", "max" or "min"."""
    component: int
    value: float
    direction: int


def number(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a finite number, it was {text!r}")
    return value


def positive(text: str) -> float:
    """A finite number above 0."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"must be positive, it was {text!r}")
    return value


def whole(least: int) -> Callable[[str], int]:
    """An integer of at least `least`."""

    def parse(text: str) -> int:
        # `int` alone would also accept "1_000", " 5" and "+5".
        if not re.fullmatch(r"\d+", text) or int(text) < least:
            message = f"must be a whole number of {least} or more, it was {text!r}"
            raise argparse.ArgumentTypeError(message)
        return int(text)

    return parse


def state(text: str) -> tuple[float, ...]:
    """Numbers between commas."""
    return tuple(number(part) for part in text.split(","))


def setting(text: str) -> tuple[str, float]:
    """P=VALUE."""
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"must be P=VALUE, it was {text!r}")
    return name, number(value)


def axis(text: str) -> Axis:
    """P=A:B:N, N values of P from A to B."""
    name, _, rest = text.partition("=")
    parts = rest.split(":")
    if not name or len(parts) != 3:
        raise argparse.ArgumentTypeError(f"must be P=A:B:N, it was {text!r}")
    return Axis(name, number(parts[0]), number(parts[1]), whole(2)(parts[2]))


def section(text: str) -> SectionWords:
    """xI=C, with ",up" or ",down" after it, or max:xI, or min:xI."""
    extreme = re.fullmatch(r"(max|min):x(\d+)", text)
    if extreme:
        return SectionWords(extreme[1], int(extreme[2]), 0.0, 0)
    crossing = re.fullmatch(r"x(\d+)=([^,]+)(?:,(up|down))?", text)
    if not crossing:
        message = f"must be xI=C, xI=C,up, xI=C,down, max:xI or min:xI, it was {text!r}"
        raise argparse.ArgumentTypeError(message)
    direction = {None: 0, "up": 1, "down": -1}[crossing[3]]
    return SectionWords("at", int(crossing[1]), number(crossing[2]), direction)


def picture(text: str) -> Path:
    """The file of a picture."""
    # An unwritable path is reported before hours of computation.
    path = Path(text)
    if path.suffix not in PICTURES:
        raise argparse.ArgumentTypeError(f"must end in {', '.join(PICTURES)}; it was {text!r}")
    if not os.access(path.parent, os.W_OK):
        raise argparse.ArgumentTypeError(f"must be in a folder to write to, it was {text!r}")
    return path
