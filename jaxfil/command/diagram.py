"""A bifurcation diagram from the command line: checked arguments enter, a picture, its numbers and
a line leave, and the exit code."""

import argparse
import dataclasses
import sys
import time
import warnings

import jax.numpy as jnp
import numpy as np

from jaxfil.command.interruption import INTERRUPTED
from jaxfil.command.steppers import STEPPERS
from jaxfil.command.textbook import defaults, state, text
from jaxfil.model import dataset_io
from jaxfil.model.card import counted
from jaxfil.model.outcomes import outcome_names
from jaxfil.sweep.diagram import BifurcationDiagram
from jaxfil.sweep.interrupt import Interrupts
from jaxfil.sweep.sweep import bifurcation_diagram
from jaxfil.systems import TEXTBOOK


def run(args: argparse.Namespace, interrupts: Interrupts) -> int:
    """Sweep, draw, save and say so."""
    settings, x0 = dict(args.set), state(args)
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
            stepper=STEPPERS[args.stepper] if args.stepper else None,
            checkpoint=args.checkpoint,
            compact=args.compact,
            progress=not args.quiet,
        )
    seconds = time.perf_counter() - start
    outcomes = outcome_names(diagram.results)
    finished = int((outcomes != "interrupted").sum())
    if not finished:
        print("jaxfil: interrupted before a lane was finished", file=sys.stderr)
        return INTERRUPTED
    _draw(diagram, args)
    _save(diagram, args)
    if finished < args.points:
        written = f"wrote {args.out} and {args.out.with_suffix('.npz')}"
        lanes = f"{finished} of {args.points} lanes are finished"
        print(f"jaxfil: interrupted: {lanes}; {written}", file=sys.stderr)
        return INTERRUPTED
    if not args.quiet:
        print(_summary(args, diagram, seconds))
    if interrupts.count:  # while it was drawn
        return INTERRUPTED
    return 0 if (outcomes == "successful").any() else 1


def _conditions(args: argparse.Namespace) -> str:
    """What the picture cannot show and a reader needs to make it again."""
    symbols = TEXTBOOK[args.system][0].symbols
    set_to = dict(args.set).items()
    given = "".join(f", {symbols.get(name, name)} = {value:.10g}" for name, value in set_to)
    follow = f" and on {args.follow}" if args.follow else ""
    stepper = f" by {args.stepper}" if args.stepper else ""
    periods = f"{args.transient} + {args.samples} periods of {args.steps} steps{stepper}"
    return f"{args.system}{given}, from {text(state(args))}{follow}, {periods}"


def _summary(args: argparse.Namespace, diagram: BifurcationDiagram, seconds: float) -> str:
    ended = ", ".join(f"{count} {name}" for name, count in counted(diagram.results).items())
    return (
        f"{args.points} values of {args.parameter} in {seconds:.1f} s: {ended}; "
        f"wrote {args.out} and {args.out.with_suffix('.npz')}"
    )


def _draw(diagram: BifurcationDiagram, args: argparse.Namespace) -> None:
    from jaxfil import plot  # here, so that mistakes are answered without loading matplotlib

    page = plot.page()
    ax = plot.bifurcation_diagram(diagram, page.add_subplot(), args.component)
    title = _conditions(args) if args.title is None else args.title
    # In the place of what the diagram says of itself.
    ax.set_title(title, loc="left", fontsize="small" if args.title is None else None)
    page.savefig(args.out, dpi=args.dpi or "figure")


def _save(diagram: BifurcationDiagram, args: argparse.Namespace) -> None:
    """Everything in the picture, and what it takes to make it again, beside it as .npz."""
    # From the defaults and not from the diagram: a parameter may be None, as alpha = 0 is.
    parameters = defaults(args.system) | dict(args.set)
    del parameters[args.parameter]
    asked = {
        "system": args.system,
        "samples": args.samples,
        "follow": args.follow or "",
        "fixed_names": np.array(list(parameters)),
        "fixed_values": np.array(list(parameters.values())),
    }
    data = diagram.named_arrays()
    # `system` has the name of the command line here, and the class for `jaxfil.load` beside it.
    names = {**data.npz_names, "system": "system_class"}
    data = dataclasses.replace(data, npz_names=names, npz_extras=asked)
    dataset_io.save(data, args.out.with_suffix(".npz"))
