"""What depends on what: which sides switch a number of the field, and which numbers H is made of.

The field and the switching function enter as `Traced` functions; a `Structure` leaves, known from
their operations before anything is compiled. What it says of every motion saves what no motion
needs: weights and modes of surfaces that have nothing to do with each other are those of single
ones.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from jaxfil.integrate.system.components import Components
from jaxfil.xla.trace import Traced


@dataclasses.dataclass(frozen=True)
class Structure:
    """How n numbers of a state and m surfaces depend on each other."""

    switched: tuple[tuple[int, ...], ...]
    """For each number of the field, the sides that it depends on."""
    separate: bool
    """Whether no number of the field depends on more than one side, and no dH_j/dt on a side other
    than its own: the surfaces then switch independently of each other."""
    affine: bool
    """Whether the field is affine in its sides, of which there are several."""
    members: tuple[tuple[int, ...], ...] | None
    """The numbers of the state that each of several surfaces is made of; None if one is of two."""


def of(
    functions: tuple[Traced, Traced],
    at: tuple,
    of_number: Sequence,
    of_side: Sequence,
    reacting: bool = False,
    asked: tuple = (),
) -> Structure:
    """The structure of a field (leaves, t, x, sides, *asked), of which a first one more is the
    reaction if it is `reacting`, and a switching function (leaves, t, x). `at` are leaves and a
    time; `of_number` flag one number of the state each, `of_side` one side each."""
    field, switching = functions
    n, m = len(of_number), len(of_side)
    nothing, still = jax.tree.map(lambda _: False, (at, of_number[0]))
    none = jax.tree.map(lambda _: False, asked)
    seen = [_flat(field.depends(*nothing, still, side, *none)) for side in of_side]
    switched = tuple(tuple(j for j in range(m) if seen[j][i]) for i in range(n))
    if m < 2:
        return Structure(switched, separate=m == 1, affine=False, members=None)
    steers = [_flat(switching.depends(*nothing, number)) for number in of_number]
    # Reactions on different sides are different ones: what is held is affine in one side at most.
    single = len(set().union(*switched)) < 2
    all_sides = jax.tree.map(lambda _: True, of_side[0])
    affine = single if reacting else field.is_affine(*nothing, still, all_sides, *none)
    return Structure(
        switched=switched,
        separate=not reacting and _are_separate(switched, steers),
        affine=affine,
        members=_members(np.array(steers)),
    )


def of_own_reactions(second: Traced, at: tuple, of_side: Sequence) -> tuple[bool, ...]:
    """Which numbers of a function (*at, reaction), one of each surface, depend on its reaction."""
    nothing = jax.tree.map(lambda _: False, at)
    return tuple(_flat(second.depends(*nothing, unit))[j] for j, unit in enumerate(of_side))


def _flat(flags: Components) -> list[bool]:
    """The flags of all numbers of a vector."""
    return [bool(flag) for v in flags.parts for flag in np.ravel(v)]


def _are_separate(switched: Sequence[tuple[int, ...]], steers: Sequence[list[bool]]) -> bool:
    """Whether each surface is switched by its own side alone, given which sides the numbers of the
    field depend on, and which surfaces depend on those numbers of the state."""
    single = all(len(seen) <= 1 for seen in switched)
    foreign = any(
        enters and set(seen) - {j}
        for seen, steered in zip(switched, steers, strict=True)
        for j, enters in enumerate(steered)
    )
    return single and not foreign


def _members(steers: np.ndarray) -> tuple[tuple[int, ...], ...] | None:
    """`Structure.members`, given (n, m) flags of which number is in which surface."""
    if np.any(steers.sum(axis=1) > 1):
        return None
    return tuple(tuple(map(int, np.flatnonzero(of_j))) for of_j in steers.T)
