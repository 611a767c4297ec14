"""The command `spectrum`, Lyapunov exponents at one value or over several."""

import argparse
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.command.chosen import Chosen, starts
from jaxfil.command.misuse import Misuse
from jaxfil.command.picture import by_stepper, draw, numbers, stepper_options, written
from jaxfil.exponents.lyapunov import LyapunovSpectrum, lyapunov_spectrum
from jaxfil.model.card import counted
from jaxfil.model.labels import labels_of
from jaxfil.model.outcomes import outcome_names
from jaxfil.model.parameter import replace_parameter
from jaxfil.sweep.interrupt import Interrupts


def check(args: argparse.Namespace, of: Chosen) -> None:
    """Refuse arguments that do not fit the system, and an incomplete sweep."""
    swept = [args.parameter, args.start, args.stop, args.points]
    if any(word is None for word in swept) and swept != [None] * 4:
        raise Misuse("--parameter, --from, --to and --points are given together, or none of them")
    if args.interval is None and of.system(starts(args)).period is None:
        raise Misuse(f"--interval is required: {of.name} has no forcing")


def run(args: argparse.Namespace, of: Chosen, interrupts: Interrupts) -> int:
    """Compute, draw, save and print a summary."""
    x0 = jnp.array(of.x0)
    options = {
        **stepper_options(args),
        "periods": args.periods,
        "transient": args.transient,
        "interval": args.interval,
    }
    title = f"{of.conditions()}, {args.transient} + {args.periods} periods{by_stepper(args)}"
    if args.parameter is None:
        found = lyapunov_spectrum(of.system(), x0, **options)
        print(found)
        if args.out is not None:
            draw(args, title, found.plot)
            _save(args, found)
    else:
        system = of.system(starts(args))
        values = jnp.asarray(np.linspace(args.start, args.stop, args.points))

        def at(value: Array) -> LyapunovSpectrum:
            return lyapunov_spectrum(
                replace_parameter(system, args.parameter, value), x0, **options
            )

        found = eqx.filter_jit(eqx.filter_vmap(at))(values)
        if args.out is not None:
            from jaxfil import plot

            label = labels_of(system, len(of.x0)).parameter(args.parameter)
            draw(args, title, lambda ax: plot.lyapunov_exponents(values, found, ax, label))
            _save(args, found, **{args.parameter: values})
        ended = ", ".join(f"{count} {name}" for name, count in counted(found.result).items())
        wrote = f"; {written(args)}" if args.out else ""
        print(f"{args.points} values of {args.parameter}: {ended}{wrote}")
    return 0 if (outcome_names(found.result) == "successful").any() else 1


def _save(args: argparse.Namespace, found: LyapunovSpectrum, **values: Array) -> None:
    arrays = {"exponents": found.exponents, "standard_error": found.standard_error, **values}
    saved: dict[str, Any] = {name: np.asarray(array) for name, array in arrays.items()}
    np.savez(numbers(args), **saved)
