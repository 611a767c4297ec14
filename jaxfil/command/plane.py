"""A sweep over two parameters from the command line: checked arguments enter, the map of periods,
its numbers and a line leave, and the exit code."""

import argparse
import time

import jax.numpy as jnp
import numpy as np

from jaxfil.command.chosen import Chosen, check_sampling, starts
from jaxfil.command.picture import draw, numbers, sampled, sweep_options, written
from jaxfil.model.card import counted
from jaxfil.sweep.interrupt import Interrupts
from jaxfil.sweep.sweep import bifurcation_diagram


def check(args: argparse.Namespace, of: Chosen) -> None:
    """Refuse what does not fit the system."""
    check_sampling(args, of)


def run(args: argparse.Namespace, of: Chosen, interrupts: Interrupts) -> int:
    """Sweep, draw, save and say so."""
    first, second = args.grid
    start = time.perf_counter()
    diagram = bifurcation_diagram(
        of.system(starts(args)),
        (first.name, second.name),
        tuple(jnp.asarray(np.linspace(*axis[1:])) for axis in args.grid),
        jnp.array(of.x0),
        **sweep_options(args),
    )
    seconds = time.perf_counter() - start
    draw(args, f"{of.conditions()}, {sampled(args)}", diagram.plot)
    diagram.save(numbers(args))
    if not args.quiet:
        ended = ", ".join(f"{count} {name}" for name, count in counted(diagram.results).items())
        grid = f"{first.points} × {second.points} values of {first.name} and {second.name}"
        print(f"{grid} in {seconds:.1f} s: {ended}; {written(args)}")
    return 0 if diagram.successful.any() else 1
