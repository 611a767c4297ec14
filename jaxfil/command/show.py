"""The command `show`, which prints and draws the contents of a file."""

import argparse
import dataclasses
import json
from typing import Any

import jax.numpy as jnp

from jaxfil.command.chosen import class_named, required
from jaxfil.command.misuse import Misuse
from jaxfil.command.picture import draw
from jaxfil.files.load import load
from jaxfil.model import dataset_io
from jaxfil.model.dataset import OTHERS
from jaxfil.model.dataset_io import NamedArrays
from jaxfil.model.parameter import parameters
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
    data = dataset_io.load(args.file)
    if args.system is not None:
        return _with_parameters(class_named(args.system)[0], data)
    name = data.attributes.get("system")
    known = (cls for cls, _ in TEXTBOOK.values() if cls.__name__ == name)
    return next((_with_parameters(cls, data) for cls in known), None)


def _with_parameters(cls: type[System], data: NamedArrays) -> System:
    """A system of a class with the whole numbers, flags and words of a file, and its parameters as
    placeholder numbers that its values replace."""
    others = _plain_fields(cls, data)
    numbers = {name: jnp.ones(()) for name in required(cls) if name not in others} | others
    own = parameters(cls(**numbers))
    held = {*data.variables, *data.coordinates, *data.attributes}
    # A parameter that is None by default, or by a converter for its default.
    for field in dataclasses.fields(cls):
        absent = field.init and field.name not in own
        if absent and (field.default is None or isinstance(field.default, float)):
            numbers |= {field.name: jnp.ones(())} if held & {field.name, f"{field.name}_"} else {}
    return cls(**numbers)


def _plain_fields(cls: type[System], data: NamedArrays) -> dict[str, Any]:
    """The fields of a class whose values a file has in full: whole numbers, flags and words."""
    held = json.loads(data.attributes.get(OTHERS, "{}"))
    kinds = {field.name: field.type for field in dataclasses.fields(cls) if field.init}
    values = {name: json.loads(text) for name, text in held.items() if name in kinds}
    # A word may also be the name of a function.
    return {
        name: value
        for name, value in values.items()
        if isinstance(value, int) or (isinstance(value, str) and kinds[name] in (str, "str"))
    }
