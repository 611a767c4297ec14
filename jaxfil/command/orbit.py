"""The commands `orbit`, `branch` and `bifurcations`."""

import argparse

import jax.numpy as jnp

from jaxfil.bifurcations.sequence import find_bifurcations
from jaxfil.command.chosen import Chosen, check_component, starts
from jaxfil.command.misuse import Misuse
from jaxfil.command.picture import draw, numbers, stepper_options, steps_in_words
from jaxfil.model.outcomes import is_successful
from jaxfil.model.system import System
from jaxfil.orbits.continue_orbit import continue_orbit
from jaxfil.orbits.orbit import Orbit
from jaxfil.orbits.periodic_orbit import periodic_orbit
from jaxfil.sweep.interrupt import Interrupts


def check(args: argparse.Namespace, of: Chosen) -> None:
    """Refuse arguments that do not fit the system."""
    forced = of.system(starts(args)).period is not None
    if not forced and args.period is None:
        raise Misuse(
            f"--period is required: {of.name} has no forcing, and the search needs a guess of it"
        )
    if args.command != "orbit":
        check_component("--component", args.component, len(of.x0))


def run(args: argparse.Namespace, of: Chosen, interrupts: Interrupts) -> int:
    """Find the orbit, follow it if requested, draw, save and print the cards."""
    system = of.system(starts(args))
    orbit = _orbit(args, of, system)
    found = is_successful(orbit.result)
    if args.command == "orbit" or not found:
        print(orbit)
        if found and args.out is not None:
            orbit.save(numbers(args))
            draw(args, _title(args, of), orbit.plot)
        return 0 if found else 1
    if args.command == "branch":
        branch = followed = continue_orbit(
            system, args.parameter, orbit, stop=args.stop, throw=False
        )
    else:
        followed = find_bifurcations(system, args.parameter, orbit, stop=args.stop, throw=False)
        branch = followed.branch
    print(followed)
    if args.out is not None:
        branch.save(numbers(args))
        draw(args, _title(args, of), lambda ax: followed.plot(ax, args.component))
    return 0 if is_successful(branch.result) else 1


def _orbit(args: argparse.Namespace, of: Chosen, system: System) -> Orbit:
    return periodic_orbit(
        system,
        jnp.array(of.x0),
        periods=args.periods,
        period=args.period,
        transient=args.transient,
        throw=False,
        **stepper_options(args),
    )


def _title(args: argparse.Namespace, of: Chosen) -> str:
    return f"{of.conditions()}, {args.transient} + {args.periods} periods of {steps_in_words(args)}"
