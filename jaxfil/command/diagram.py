"""The commands `diagram` and `plane`, sweeps over one parameter or two."""

import argparse
import dataclasses
import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfil.command.chosen import Chosen, check_component, check_sampling, starts
from jaxfil.command.picture import draw, numbers, sampled, sweep_options, written
from jaxfil.command.sweep_end import ended, told_here
from jaxfil.model import dataset_io
from jaxfil.model.card import counted
from jaxfil.sweep.diagram import BifurcationDiagram
from jaxfil.sweep.interrupt import Interrupts
from jaxfil.sweep.sweep import bifurcation_diagram


def check(args: argparse.Namespace, of: Chosen) -> None:
    """Refuse arguments that do not fit the system."""
    check_component("--component", args.component, len(of.x0))
    check_sampling(args, of)


def run(args: argparse.Namespace, of: Chosen, interrupts: Interrupts) -> int:
    """Sweep, draw, save and print a summary."""
    start = time.perf_counter()
    with told_here():
        diagram = bifurcation_diagram(
            of.system(starts(args)),
            *_swept(args),
            jnp.array(of.x0),
            follow=args.follow,
            estimate_error=args.error,
            **sweep_options(args),
        )
    seconds = time.perf_counter() - start

    def keep() -> None:
        follow = f" and on {args.follow}" if args.follow else ""
        title = f"{of.conditions()}{follow}, {sampled(args)}"
        draw(args, title, lambda ax: diagram.plot(ax, args.component))
        _save(diagram, args, of)

    def summary() -> str:
        return _summary(args, diagram, seconds)

    return ended(args, diagram.results, interrupts, keep, summary)


def _swept(args: argparse.Namespace) -> tuple[Any, Any]:
    """Names and values, of one parameter or of two."""
    if args.command == "diagram":
        return args.parameter, jnp.asarray(np.linspace(args.start, args.stop, args.points))
    values = tuple(jnp.asarray(np.linspace(*axis[1:])) for axis in args.grid)
    return tuple(axis.name for axis in args.grid), values


def _summary(args: argparse.Namespace, diagram: BifurcationDiagram, seconds: float) -> str:
    ended = ", ".join(f"{count} {name}" for name, count in counted(diagram.results).items())
    error = ""
    if diagram.errors is not None and np.isfinite(diagram.errors).any():
        largest = diagram.errors.max(axis=1)  # NaN for a failed lane
        error = (
            f"; errors up to {np.nanmax(largest):.1e}, in the median {np.nanmedian(largest):.1e}"
        )
    points = " × ".join(str(count) for count in diagram.successful.shape)
    names = " and ".join(starts(args))
    return f"{points} values of {names} in {seconds:.1f} s: {ended}{error}; {written(args)}"


def _save(diagram: BifurcationDiagram, args: argparse.Namespace, of: Chosen) -> None:
    """Save the numbers and conditions of the picture next to it as .npz."""
    # From the defaults instead of the diagram: a parameter may be None, as alpha = 0 is.
    parameters = {p: v for p, v in of.parameters().items() if p not in starts(args)}
    asked = {
        "system": args.system,
        "samples": args.samples,
        "follow": args.follow or "",
        "fixed_names": np.array(list(parameters)),
        "fixed_values": np.array(list(parameters.values())),
    }
    data = diagram.named_arrays()
    # `system` is the command-line name here; the class is stored as well, for `jaxfil.load`.
    names = {**data.npz_names, "system": "system_class"}
    data = dataclasses.replace(data, npz_names=names, npz_extras=asked)
    dataset_io.save(data, numbers(args))
