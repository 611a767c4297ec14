"""A bifurcation diagram from the command line: checked arguments enter, a picture, its numbers and
a line leave, and the exit code."""

import argparse
import dataclasses
import sys
import time
import warnings

import jax.numpy as jnp
import numpy as np

from jaxfil.command.chosen import Chosen, check_component, check_sampling, starts
from jaxfil.command.interruption import INTERRUPTED
from jaxfil.command.picture import draw, numbers, sampled, sweep_options, written
from jaxfil.model import dataset_io
from jaxfil.model.card import counted
from jaxfil.model.outcomes import outcome_names
from jaxfil.sweep.diagram import BifurcationDiagram
from jaxfil.sweep.interrupt import Interrupts
from jaxfil.sweep.sweep import bifurcation_diagram


def check(args: argparse.Namespace, of: Chosen) -> None:
    """Refuse what does not fit the system."""
    check_component("--component", args.component, len(of.x0))
    check_sampling(args, of)


def run(args: argparse.Namespace, of: Chosen, interrupts: Interrupts) -> int:
    """Sweep, draw, save and say so."""
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The sweep was interrupted", RuntimeWarning)
        diagram = bifurcation_diagram(
            of.system(starts(args)),
            args.parameter,
            jnp.asarray(np.linspace(args.start, args.stop, args.points)),
            jnp.array(of.x0),
            follow=args.follow,
            estimate_error=args.error,
            **sweep_options(args),
        )
    seconds = time.perf_counter() - start
    outcomes = outcome_names(diagram.results)
    finished = int((outcomes != "interrupted").sum())
    if not finished:
        print("jaxfil: interrupted before a lane was finished", file=sys.stderr)
        return INTERRUPTED
    follow = f" and on {args.follow}" if args.follow else ""
    title = f"{of.conditions()}{follow}, {sampled(args)}"
    draw(args, title, lambda ax: diagram.plot(ax, args.component))
    _save(diagram, args, of)
    if finished < args.points:
        lanes = f"{finished} of {args.points} lanes are finished"
        print(f"jaxfil: interrupted: {lanes}; {written(args)}", file=sys.stderr)
        return INTERRUPTED
    if not args.quiet:
        print(_summary(args, diagram, seconds))
    if interrupts.count:  # while it was drawn
        return INTERRUPTED
    return 0 if (outcomes == "successful").any() else 1


def _summary(args: argparse.Namespace, diagram: BifurcationDiagram, seconds: float) -> str:
    ended = ", ".join(f"{count} {name}" for name, count in counted(diagram.results).items())
    error = ""
    if diagram.errors is not None and np.isfinite(diagram.errors).any():
        largest = diagram.errors.max(axis=1)  # NaN of a lane that failed
        error = (
            f"; errors up to {np.nanmax(largest):.1e}, in the median {np.nanmedian(largest):.1e}"
        )
    return (
        f"{args.points} values of {args.parameter} in {seconds:.1f} s: {ended}{error}; "
        f"{written(args)}"
    )


def _save(diagram: BifurcationDiagram, args: argparse.Namespace, of: Chosen) -> None:
    """Everything in the picture, and what it takes to make it again, beside it as .npz."""
    # From the defaults and not from the diagram: a parameter may be None, as alpha = 0 is.
    parameters = of.parameters()
    parameters.pop(args.parameter, None)
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
    dataset_io.save(data, numbers(args))
