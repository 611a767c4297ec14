"""The command `simulate`, one run."""

import argparse
import sys

import diffrax
import jax.numpy as jnp

from jaxfil.command.chosen import Chosen
from jaxfil.command.picture import draw, numbers, stepper_options, steps_in_words
from jaxfil.integrate.run.solve import solve
from jaxfil.model.outcomes import is_successful
from jaxfil.sweep.interrupt import Interrupts

# Least number of saved times for a picture; a curve through fewer has corners.
_SAVED = 2000


def check(args: argparse.Namespace, of: Chosen) -> None:
    """Accept all arguments; they fit every system."""


def run(args: argparse.Namespace, of: Chosen, interrupts: Interrupts) -> int:
    """Run, draw, save and print the card."""
    system = of.system()
    unit = 1.0 if system.period is None else float(system.period)
    span = 10 * unit if args.time is None else args.time
    options = stepper_options(args)
    ts = jnp.linspace(0.0, span, _SAVED + 1)
    sol = solve(
        system,
        jnp.array(of.x0),
        0.0,
        span,
        unit / options.pop("steps"),
        saveat=diffrax.SaveAt(ts=ts) if args.out else diffrax.SaveAt(t1=True),
        throw=False,
        **options,
    )
    print(sol)
    if args.out is not None:
        from jaxfil import plot

        title = f"{of.conditions()}, {steps_in_words(args)}"
        plane = [lambda ax: plot.phase_portrait(sol, ax, system)] if len(of.x0) > 1 else []
        sol.save(numbers(args))
        if int(sol.stats["num_saved"]) > 1:
            draw(args, title, lambda ax: plot.time_history(sol, ax, system=system), *plane)
        else:
            print(f"jaxfil: the run stopped at its start; wrote {numbers(args)}", file=sys.stderr)
    return 0 if is_successful(sol.result) else 1
