"""The system of a command: a textbook system, or FILE.py:CLASS for a class in a user's file."""

import argparse
import dataclasses
import difflib
import importlib.util
import inspect
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import jax.numpy as jnp

from jaxfil.command.misuse import Misuse
from jaxfil.model.parameter import replace_parameters
from jaxfil.model.system import System
from jaxfil.systems import TEXTBOOK


@dataclasses.dataclass(frozen=True)
class Chosen:
    """A class of systems, with the settings of the command line."""

    name: str
    """The name as written."""
    cls: type[System]
    """The class, from a user's file or from `jaxfil.systems`."""
    settings: dict[str, float]
    """Parameters from the command line, by name."""
    x0: tuple[float, ...]
    """The initial state."""

    def system(self, more: Mapping[str, float] = MappingProxyType({})) -> System:
        """The system, with additional parameters."""
        given = {**self.settings, **more}
        nested = {name: given.pop(name) for name in [*given] if _is_path(name)}
        system = self.cls(**_numbers(self.cls, given))
        return replace_parameters(system, nested, nested.values())

    def parameters(self) -> dict[str, float]:
        """Every numeric parameter with a value, by name."""
        return _defaults(self.cls) | self.settings

    def conditions(self) -> str:
        """The conditions needed to reproduce a picture."""
        symbols = self.cls.symbols
        if not isinstance(symbols, Mapping):  # a property of a wrapper system
            symbols = {}
        given = (f", {symbols.get(p, p)} = {v:.10g}" for p, v in self.settings.items())
        return f"{self.name}{''.join(given)}, from {_text(self.x0)}"


def _numbers(cls: type[System], given: Mapping[str, float]) -> dict[str, Any]:
    """The values of fields, of the types of these fields; raises `Misuse` for those they cannot
    hold."""
    kinds = {f.name: f.type for f in dataclasses.fields(cls)}
    return {name: _number(name, kinds.get(name), value) for name, value in given.items()}


def _number(name: str, kind: Any, value: float) -> Any:
    """The value of a field that is declared to be of a kind, in words or as a type."""
    if kind in (int, "int", bool, "bool"):
        whole = kind in (int, "int")
        if value not in (0, 1) and not (whole and value.is_integer()):
            must = "an integer" if whole else "0 or 1"
            raise Misuse(f"{name} must be {must}, it was {value:.10g}")
        return int(value) if whole else bool(value)
    # Arrays are float leaves of any class, with or without a converter.
    return jnp.asarray(value)


def listing() -> str:
    """Every textbook system with its parameters, their defaults and its initial state."""
    lines = []
    for name, (cls, x0) in TEXTBOOK.items():
        parameters = " ".join(f"{p}={value:.10g}" for p, value in _defaults(cls).items())
        kind = "" if cls().period is not None else " (no period: a diagram needs --section)"
        lines.append(f"{name}{kind}\n    {parameters or 'no parameters'}, from {_text(x0)}")
    return "\n".join(lines)


def chosen(args: argparse.Namespace) -> Chosen:
    """The system of these arguments; raises `Misuse` if they do not define one."""
    cls, default = class_named(args.system)
    swept, settings = starts(args), dict(args.set)
    own = [f.name for f in dataclasses.fields(cls) if f.init]
    for name in swept:
        _one_of("--grid" if args.command == "plane" else "--parameter", name, own)
    for name in settings:
        _one_of("--set", name, [p for p in own if p not in swept])
    missing = [p for p in required(cls) if p not in settings and p not in swept]
    if missing:
        raise Misuse(f"--set must give {', '.join(missing)}, which has no default")
    _numbers(cls, swept | settings)
    return Chosen(args.system, cls, settings, _state(args, default))


def class_named(name: str) -> tuple[type[System], tuple[float, ...] | None]:
    """The class with this name, and its default initial state."""
    file, colon, wanted = name.rpartition(":")
    if not colon or not file.endswith(".py"):
        _one_of("NAME", name, TEXTBOOK, "or FILE.py:CLASS")
        return TEXTBOOK[name]
    path = Path(file)
    if not path.is_file():
        raise Misuse(f"NAME must be FILE.py:CLASS of a file that exists, it was {name!r}")
    found = {
        key: value
        for key, value in vars(_module(path)).items()
        if inspect.isclass(value) and issubclass(value, System) and not inspect.isabstract(value)
    }
    if not found:
        raise Misuse(f"FILE must define a jaxfil.System, but {file} has no such class")
    _one_of(f"CLASS of {file}", wanted, found)
    return found[wanted], None


def required(cls: type[System]) -> list[str]:
    """The parameters of a class without a default."""
    unset = dataclasses.MISSING
    return [
        f.name
        for f in dataclasses.fields(cls)
        if f.init and f.default is unset and f.default_factory is unset
    ]


def starts(args: argparse.Namespace) -> dict[str, float]:
    """The parameters that a command varies, with their first values."""
    if args.command == "plane":
        return {axis.name: axis.start for axis in args.grid}
    if getattr(args, "start", None) is None or args.parameter is None:
        return {}
    return {args.parameter: args.start}


def check_sampling(args: argparse.Namespace, of: Chosen) -> None:
    """Raise `Misuse` without a forcing period or a section to sample at."""
    if args.section is not None:
        check_component("the I of --section", args.section.component, len(of.x0))
        if args.max_return is None:
            raise Misuse("--max-return is required with --section")
    elif of.system(starts(args)).period is None:
        raise Misuse(f"{of.name} has no period to sample at: --section says where")
    elif args.max_return is not None:
        raise Misuse("--max-return goes with --section")


def check_component(what: str, component: int, n: int) -> None:
    """Raise `Misuse` unless a state of n numbers has this component."""
    if component >= n:
        raise Misuse(f"{what} must be from 0 to {n - 1}, it was {component}")


def _module(path: Path) -> ModuleType:
    """A file, imported as a module; its errors propagate."""
    name = path.stem
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None  # true for every name that ends in .py
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look for their module there
    sys.path.insert(0, str(path.parent.resolve()))  # as for a script, which imports its neighbours
    spec.loader.exec_module(module)
    return module


def _defaults(cls: type[System]) -> dict[str, float]:
    """The numeric parameters of a class, and their defaults."""
    given: dict[str, Any] = {f.name: f.default for f in dataclasses.fields(cls) if f.init}
    numbers = {p: v for p, v in given.items() if isinstance(v, int | float)}
    return {p: float(v) for p, v in numbers.items() if not isinstance(v, bool)}


def _is_path(name: str) -> bool:
    """Whether a parameter belongs to a nested module, or is an entry of an array."""
    return "." in name or "[" in name


def _state(args: argparse.Namespace, default: tuple[float, ...] | None) -> tuple[float, ...]:
    """The requested initial state, or the system's own."""
    x0 = args.x0 or default
    if x0 is None:
        raise Misuse(f"--x0 is required: {args.system} says no initial state")
    if default is not None and len(x0) != len(default):
        raise Misuse(f"--x0 must be {len(default)} numbers for {args.system}, it was {len(x0)}")
    return x0


def _text(x0: Sequence[float]) -> str:
    """A state in a title."""
    return f"({', '.join(f'{value:.10g}' for value in x0)})"


def _one_of(what: str, name: str, allowed: Collection[str], more: str = "") -> None:
    # A parameter of a nested module, or an entry of an array, is looked up by the library.
    if what.startswith("--") and _is_path(name):
        return
    if not allowed:
        raise Misuse(
            f"{what} must name a parameter, but the system has no parameters; it was {name!r}"
        )
    if name not in allowed:
        told = f"{what} must be one of {', '.join(allowed)}{more and ', '}{more}; it was {name!r}"
        raise Misuse(f"{told}{_suggestion(name, allowed)}")


def _suggestion(name: str, allowed: Collection[str]) -> str:
    """A question with the name that was probably meant, if one is similar."""
    plain = {_folded(known): known for known in allowed}
    near = difflib.get_close_matches(_folded(name), plain, n=1)
    return f"; did you mean {plain[near[0]]!r}?" if near else ""


def _folded(name: str) -> str:
    return name.lower().replace("_", "-")
