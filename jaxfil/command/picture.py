"""Common output of commands: a figure and its file, the saved numbers, and a summary line."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxfil.command.steppers import STEPPERS
from jaxfil.command.words import SectionWords
from jaxfil.model.section import Section, maxima, minima

if TYPE_CHECKING:  # mistakes are reported without loading matplotlib
    from matplotlib.axes import Axes


def draw(args: argparse.Namespace, title: str, *drawers: "Callable[[Axes], Any]") -> None:
    """Draw panels side by side, under one title, in the requested file."""
    from jaxfil import plot

    page = plot.page()
    for i, drawer in enumerate(drawers):
        drawer(page.add_subplot(1, len(drawers), i + 1))
    text = title if args.title is None else args.title
    size = "small" if args.title is None else "medium"
    if len(drawers) == 1:  # replaces the picture's own title
        page.axes[0].set_title(text, loc="left", fontsize=size)
    else:
        page.suptitle(text, fontsize=size)
    page.savefig(args.out, dpi=args.dpi or "figure")


def numbers(args: argparse.Namespace) -> Path:
    """The file of numbers next to a picture."""
    return args.out.with_suffix(".npz")


def written(args: argparse.Namespace) -> str:
    """The files that a command has written, in words."""
    return f"wrote {args.out} and {numbers(args)}"


def stepper_options(args: argparse.Namespace) -> dict[str, Any]:
    """Step and stepper as keyword arguments of the library."""
    return {"steps": args.steps, "stepper": STEPPERS[args.stepper] if args.stepper else None}


def sweep_options(args: argparse.Namespace) -> dict[str, Any]:
    """Common keyword arguments of diagrams, planes and basins."""
    return {
        **stepper_options(args),
        "transient": args.transient,
        "samples": args.samples,
        "checkpoint": args.checkpoint,
        "compact": args.compact,
        "progress": not args.quiet,
        "section": _section(args.section) if args.section else None,
        "max_return": args.max_return,
    }


def sampled(args: argparse.Namespace) -> str:
    """A description of the sampling of a sweep."""
    if args.section:
        return f"{args.transient} + {args.samples} crossings, {steps_in_words(args)}"
    return f"{args.transient} + {args.samples} periods of {steps_in_words(args)}"


def steps_in_words(args: argparse.Namespace) -> str:
    """A description of the steps and the requested stepper."""
    return f"{args.steps} steps{by_stepper(args)}"


def by_stepper(args: argparse.Namespace) -> str:
    """A description of the requested stepper."""
    return f" by {args.stepper}" if args.stepper else ""


def _section(words: SectionWords) -> Section:
    kind, i, value, direction = words
    if kind == "at":
        return Section(lambda t, x: x[i] - value, direction)
    return (maxima if kind == "max" else minima)(lambda t, x: x[i])
