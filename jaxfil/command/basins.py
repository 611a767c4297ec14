"""The command `basins`."""

import argparse
import re

import jax.numpy as jnp
import numpy as np

from jaxfil.command.chosen import Chosen, check_component, check_sampling
from jaxfil.command.misuse import Misuse
from jaxfil.command.picture import draw, numbers, sampled, sweep_options
from jaxfil.command.sweep_end import ended, told_here
from jaxfil.sweep.basins import basins_of_attraction
from jaxfil.sweep.interrupt import Interrupts


def check(args: argparse.Namespace, of: Chosen) -> None:
    """Refuse arguments that do not fit the system."""
    for component in _components(args):
        check_component("the I of --grid xI=A:B:N", component, len(of.x0))
    check_sampling(args, of)


def run(args: argparse.Namespace, of: Chosen, interrupts: Interrupts) -> int:
    """Sweep, draw, save and print the card."""
    first, second = (np.linspace(*axis[1:]) for axis in args.grid)
    with told_here():
        found = basins_of_attraction(
            of.system(),
            (first, second),
            x0=jnp.array(of.x0),
            components=_components(args),
            **sweep_options(args),
        )

    def keep() -> None:
        draw(args, f"{of.conditions()}, {sampled(args)}", found.plot)
        found.save(numbers(args))

    return ended(args, found.results, interrupts, keep, lambda: str(found))


def _components(args: argparse.Namespace) -> tuple[int, int]:
    names = [axis.name for axis in args.grid]
    if not all(re.fullmatch(r"x\d+", name) for name in names):
        raise Misuse(f"--grid must be of x0, x1 and so on, it was {' and '.join(names)}")
    first, second = (int(name[1:]) for name in names)
    return first, second
