"""Names and units of the quantities of a system in pictures and named arrays.

`labels_of` reads `state_names`, `symbols` and `units` of a system. Results store its `Labels`, so
that a picture needs no system.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from jaxfil.model import check
from jaxfil.model.parameter import parameters
from jaxfil.model.system import System

# Pairs instead of a dictionary, because labels are static fields, which are hashed.
Pairs = tuple[tuple[str, str], ...]


@dataclasses.dataclass(frozen=True)
class Labels:
    """Names and units of the quantities of a system. A quantity without an entry has its name in
    the code and no unit.

    >>> from jaxfil.model.labels import Labels
    >>> labels = Labels(state=("x", "x'"), symbols=(("omega", "Ω"),), units=(("x", "m"),))
    >>> labels.component(0), labels.parameter("omega"), labels.parameter("zeta")
    ('x, m', 'Ω', 'zeta')
    """

    state: tuple[str, ...] = ()
    """Names of the components of the state, in order; empty by default."""
    symbols: Pairs = ()
    """Pairs of a parameter's name and its symbol, sorted."""
    units: Pairs = ()
    """Pairs of the name of a component, of a parameter or of the time `t`, and its unit, sorted."""

    def component(self, i: int, wording: str = "{}") -> str:
        """The label of component i, with `wording` around its name: "x once a period, m"."""
        name = self.state[i] if self.state else f"x[{i}]"
        return self._with_unit(wording.format(name), name)

    def parameter(self, name: str) -> str:
        """The label of a parameter: "Ω, rad/s"."""
        return self._with_unit(self.symbol(name), name)

    @property
    def time(self) -> str:
        """The label of the time."""
        return self._with_unit("t", "t")

    def symbol(self, name: str) -> str:
        """The symbol of a parameter, or its name."""
        return dict(self.symbols).get(name, name)

    def unit(self, name: str) -> str:
        """The unit of a component, a parameter or the time `t`; empty by default."""
        return dict(self.units).get(name, "")

    def of(self, names: tuple[str, ...]) -> "Labels":
        """The labels of the state and of these parameters alone."""
        kept = {*self.state, *names}  # a result has labels only for its own quantities
        return Labels(
            self.state,
            tuple(pair for pair in self.symbols if pair[0] in names),
            tuple(pair for pair in self.units if pair[0] in kept),
        )

    def _with_unit(self, words: str, name: str) -> str:
        unit = self.unit(name)
        return f"{words}, {unit}" if unit else words


def labels_of(system: System, n: int) -> Labels:
    """The labels of a system with a state of n components."""
    names = system.state_names
    several = isinstance(names, (tuple, list)) and all(isinstance(name, str) for name in names)
    if not several or len(names) not in (0, n) or len(set(names)) < len(names):
        check.shapes(system, jnp.zeros(n))  # the length of the state may be wrong instead
        raise ValueError(
            f"`state_names` of {type(system).__name__} must be a tuple of different strings, one "
            f"for each of the {n} components of the state, got {names!r}."
        )
    # All fields, because a field that is None here may be a parameter in another instance.
    fields = {*parameters(system), *_fields(system)}
    return Labels(
        tuple(names),
        _pairs(system, "symbols", sorted(fields)),
        _pairs(system, "units", [*names, "t", *sorted(fields)]),
    )


def _fields(module: eqx.Module, path: str = "") -> Iterator[str]:
    """The names of all fields, with paths for nested modules."""
    for field in dataclasses.fields(module):
        yield path + field.name
        if isinstance(value := getattr(module, field.name, None), eqx.Module):
            yield from _fields(value, f"{path}{field.name}.")


def _pairs(system: System, attribute: str, known: list[str]) -> Pairs:
    """A dictionary of the class, by names of the system, as pairs in their order."""
    given: Any = getattr(system, attribute)
    must = f"`{attribute}` of {type(system).__name__} must be a dictionary of strings"
    if not isinstance(given, Mapping):
        raise ValueError(f"{must}, got {given!r}.")
    for name, told in given.items():
        if name not in known:
            raise ValueError(f"{must} by a name among {', '.join(known)}; got {name!r}.")
        if not isinstance(told, str):
            raise ValueError(f"{must}, got {told!r} for {name!r}.")
    # Sorted, so that the same labels in another order compile no other program.
    return tuple(sorted(given.items()))
