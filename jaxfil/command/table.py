"""Error against run time from the command line: checked arguments enter, a table and perhaps its
picture leave, and the exit code."""

import argparse

import jax.numpy as jnp

from jaxfil.command.steppers import STEPPERS
from jaxfil.command.textbook import state, text
from jaxfil.studies.work_precision import WorkPrecision, work_precision
from jaxfil.sweep.interrupt import Interrupts
from jaxfil.systems import TEXTBOOK


def run(args: argparse.Namespace, interrupts: Interrupts) -> int:
    """Print the table, and draw it where --out says so."""
    system = TEXTBOOK[args.system][0](**dict(args.set))
    unit = 1.0 if system.period is None else float(system.period)
    span = 10 * unit if args.time is None else args.time
    table = work_precision(
        system,
        jnp.array(state(args)),
        span,
        [STEPPERS[name] for name in args.steppers or STEPPERS],
        [unit / n for n in args.steps or (20, 40, 80, 160)],
        lanes=args.lanes,
    )
    print(table)
    if args.out is not None:
        _draw(table, args, span)
    return 0 if table.reached.any() else 1


def _draw(table: WorkPrecision, args: argparse.Namespace, span: float) -> None:
    from jaxfil import plot

    page = plot.page()
    ax = plot.work_precision(table, page.add_subplot())
    asked = f"{args.system}, from {text(state(args))} to t = {span:.10g}"
    title = asked if args.title is None else args.title
    ax.set_title(title, fontsize="small" if args.title is None else None)
    page.savefig(args.out, dpi=args.dpi or "figure")
