"""The command `show`, which prints and draws the contents of a file."""

import argparse

import jax.numpy as jnp

from jaxfil.command.chosen import class_named, required
from jaxfil.command.misuse import Misuse
from jaxfil.command.picture import draw
from jaxfil.files.load import load
from jaxfil.model import dataset_io
from jaxfil.model.system import System
from jaxfil.sweep.interrupt import Interrupts
from jaxfil.systems import TEXTBOOK


def check(args: argparse.Namespace, of: None) -> None:
    """Refuse a path without a file."""
    if not args.file.exists():
        raise Misuse(f"FILE must exist, it was {str(args.file)!r}")


def run(args: argparse.Namespace, of: None, interrupts: Interrupts) -> int:
    """Print the card, and draw with --out."""
    found = load(args.file, system=_system(args))
    print(found)
    if args.out is not None:
        draw(args, str(args.file), found.plot)
    return 0


def _system(args: argparse.Namespace) -> System | None:
    """A system of the named class, for results that need one."""
    if args.system is not None:
        cls = class_named(args.system)[0]
        # Placeholder numbers, which the values of the file replace.
        return cls(**{name: jnp.ones(()) for name in required(cls)})
    name = dataset_io.load(args.file).attributes.get("system")
    return next((cls() for cls, _ in TEXTBOOK.values() if cls.__name__ == name), None)
