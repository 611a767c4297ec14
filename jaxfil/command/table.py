"""The command `work-precision`, error against run time."""

import argparse

import jax.numpy as jnp

from jaxfil.command.chosen import Chosen
from jaxfil.command.picture import draw
from jaxfil.command.steppers import STEPPERS
from jaxfil.studies.work_precision import work_precision
from jaxfil.sweep.interrupt import Interrupts


def check(args: argparse.Namespace, of: Chosen) -> None:
    """Accept all arguments; they fit every system."""


def run(args: argparse.Namespace, of: Chosen, interrupts: Interrupts) -> int:
    """Print the table, and draw it with --out."""
    system = of.system()
    unit = 1.0 if system.period is None else float(system.period)
    span = 10 * unit if args.time is None else args.time
    table = work_precision(
        system,
        jnp.array(of.x0),
        span,
        [STEPPERS[name] for name in args.steppers or STEPPERS],
        [unit / n for n in args.steps or (20, 40, 80, 160)],
        lanes=args.lanes,
    )
    print(table)
    if args.out is not None:
        draw(args, f"{of.conditions()} to t = {span:.10g}", table.plot)
    return 0 if table.reached.any() else 1
