"""The dependency structure of a system: which sides switch a number of the field, and which numbers
of the state each H_j depends on.

It is known from the operations of the traced functions, before anything is compiled. Where surfaces
are independent of each other, it saves operations: their weights and modes are computed as for
single surfaces.
"""

import dataclasses
import functools as ft
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool

from jaxfil.integrate.system.components import Components
from jaxfil.model.system import System, field_of
from jaxfil.xla.trace import Traced


@dataclasses.dataclass(frozen=True)
class Structure:
    """The dependencies between n numbers of a state and m surfaces."""

    switched: tuple[tuple[int, ...], ...]
    """For each number of the field, the sides that it depends on."""
    separate: bool
    """Whether the surfaces switch independently of each other. No number of the field then depends
    on more than one side, and no dH_j/dt on a side other than its own."""
    affine: bool
    """Whether the field is affine in its sides, for m > 1."""
    alone: tuple[int | None, ...]
    """For each number of the state, a surface that depends on it alone, and not on time, so that a
    slide on that surface keeps the number constant; None without one."""
    steered: tuple[bool, ...]
    """For each surface, whether dH_j/dt is another function on other sides, so that a weight can
    hold the motion on it. For the position of a mass it is not."""
    kinked: bool
    """Whether H or the field on constant sides may have a kink where time and state move."""
    folded: bool
    """Whether H may."""
    flat: bool
    """Whether all H_j are affine in the state."""
    members: tuple[tuple[int, ...], ...] | None
    """The numbers of the state that each of several surfaces depends on; None if two surfaces share
    one."""
    constant: tuple[int, ...]
    """The numbers of the state whose field is zero, such as a latch, which only events change."""
    groups: tuple[int, ...]
    """For each surface the first one of its group. Sides within a group switch each other's rates
    dH_j/dt or, where no side switches that, the rates of these."""


def of(
    functions: tuple[Traced, Traced],
    at: tuple,
    of_number: Sequence,
    of_side: Sequence,
    reacting: bool = False,
    asked: tuple = (),
) -> Structure:
    """The structure of a field `(leaves, t, x, sides, *asked)` and a switching function
    `(leaves, t, x)`. If the field is `reacting`, the first entry of `asked` is the reaction. `at`
    is `(leaves, t)`; each of `of_number` flags one number of the state, each of `of_side` one
    side."""
    field, switching = functions
    n, m = len(of_number), len(of_side)
    # Questions to a trace are flags in the form of its arguments, set for the numbers asked about.
    nothing, still = jax.tree.map(lambda _: False, (at, of_number[0]))
    none = jax.tree.map(lambda _: False, asked)
    seen = [_flat(field.depends(*nothing, still, side, *none)) for side in of_side]
    switched = tuple(tuple(j for j in range(m) if seen[j][i]) for i in range(n))
    moving = nothing[0], True, jax.tree.map(lambda _: True, of_number[0])
    steady = jax.tree.map(lambda _: False, of_side[0]) if of_side else Components(())
    flat = switching.is_affine(*nothing, moving[2])
    folded = switching.is_kinked(*moving)
    kinked = folded or field.is_kinked(*moving, steady, *none)
    steers = [_flat(switching.depends(*nothing, number)) for number in of_number]
    moved = _flat(switching.depends(nothing[0], True, still))
    alone = _alone(np.array(steers, bool).reshape(n, m), moved)
    numbers = [steer for steer, sides in zip(steers, switched, strict=True) if sides]
    steered = tuple(any(steer[j] for steer in numbers) for j in range(m))
    constant = tuple(map(int, np.flatnonzero(_flat(field.zeros()))))
    if m < 2:
        # The two sides of a single surface determine all blends, affine or not.
        return Structure(
            switched=switched,
            separate=m == 1,
            affine=False,
            alone=alone,
            steered=steered,
            kinked=kinked,
            folded=folded,
            flat=flat,
            members=None,
            constant=constant,
            groups=tuple(range(m)),
        )
    # Reactions of different sides multiply different vectors, so a field with reactions counts as
    # affine in at most one side.
    single = len(set().union(*switched)) < 2
    all_sides = jax.tree.map(lambda _: True, of_side[0])
    # A reaction acts on the rates of other surfaces too.
    separate = not reacting and _are_separate(switched, steers)
    groups = tuple(range(m))
    if not separate:
        touched = [_any_of(of_number, of_one) for of_one in seen]
        second = [_flat(field.depends(*nothing, numbers, steady, *none)) for numbers in touched]
        groups = _groups(*(np.array(flags, bool) for flags in (seen, second, steers)))
    affine = single if reacting else field.is_affine(*nothing, still, all_sides, *none)
    return Structure(
        switched=switched,
        separate=separate,
        affine=affine,
        alone=alone,
        steered=steered,
        kinked=kinked,
        folded=folded,
        flat=flat,
        members=_members(np.array(steers)),
        constant=constant,
        groups=groups,
    )


def constants_of(system: System, x: Array, batch: int = 0) -> Bool[np.ndarray, " n"]:
    """Flags of the numbers of the state whose field is zero (`Structure.constant`), given a system
    and a state whose arrays have this many axes of a batch."""
    arrays, static = eqx.partition(system, eqx.is_array)
    shape = lambda v: jax.ShapeDtypeStruct(v.shape[batch:], v.dtype)  # noqa: E731
    shapes, form = jax.tree.flatten(jax.tree.map(shape, (arrays, x)))
    others, other_form = jax.tree.flatten(static)
    return _constants(form, tuple(shapes), other_form, tuple(others))


@ft.lru_cache(maxsize=64)  # so that a verb that repeats another one's question traces no field
def _constants(form: Any, shapes: tuple, other_form: Any, others: tuple) -> np.ndarray:
    """`constants_of` for arrays of these shapes and everything else in a system."""
    leaves, x = jax.tree.unflatten(form, shapes)
    static = jax.tree.unflatten(other_form, others)
    t = jax.ShapeDtypeStruct((), x.dtype)

    def switching(leaves: System, t: Array, x: Array) -> Array:
        return eqx.combine(leaves, static).switching(t, x)

    def field(leaves: System, t: Array, x: Array, side: Array) -> Array:
        return field_of(eqx.combine(leaves, static), t, x, side)

    side = jax.eval_shape(switching, leaves, t, x)
    return np.asarray(Traced(field, leaves, t, x, side).zeros())


def of_own_reactions(second: Traced, at: tuple, of_side: Sequence) -> tuple[bool, ...]:
    """Flags of the surfaces whose own number in a function (*at, reaction), with one number for
    each surface, depends on their own reaction."""
    nothing = jax.tree.map(lambda _: False, at)
    return tuple(_flat(second.depends(*nothing, unit))[j] for j, unit in enumerate(of_side))


def _flat(flags: Components) -> list[bool]:
    """The flags of all numbers of a vector."""
    return [bool(flag) for v in flags.parts for flag in np.ravel(v)]


def _any_of(of_number: Sequence, flags: Sequence[bool]) -> Any:
    """The flags of several numbers of a state."""
    chosen = [unit for unit, flag in zip(of_number, flags, strict=True) if flag]
    nothing = jax.tree.map(lambda _: False, of_number[0])
    return ft.reduce(lambda a, b: jax.tree.map(np.logical_or, a, b), chosen, nothing)


def _groups(first: np.ndarray, second: np.ndarray, steers: np.ndarray) -> tuple[int, ...]:
    """`Structure.groups`, given (m, n) flags of the numbers of the field that a side switches, and
    of the numbers that depend on these, and (n, m) flags of which number is in which surface."""
    m = steers.shape[1]
    rates = first @ steers
    late = second @ steers & ~rates.any(axis=0)
    linked = rates | late | np.eye(m, dtype=bool)
    linked = linked | linked.T
    for _ in range(m.bit_length()):  # each time over chains of twice the length
        linked = linked @ linked
    return tuple(map(int, np.argmax(linked, axis=1)))


def _are_separate(switched: Sequence[tuple[int, ...]], steers: Sequence[list[bool]]) -> bool:
    """Whether each surface is switched by its own side alone, given the sides on which the numbers
    of the field depend, and the surfaces that depend on those numbers of the state."""
    # dH_j/dt depends on the rates of the numbers in H_j, and so on the sides that switch these.
    single = all(len(seen) <= 1 for seen in switched)
    foreign = any(
        enters and set(seen) - {j}
        for seen, steered in zip(switched, steers, strict=True)
        for j, enters in enumerate(steered)
    )
    return single and not foreign


def _alone(steers: np.ndarray, moved: Sequence[bool]) -> tuple[int | None, ...]:
    """`Structure.alone`, given (n, m) flags of which number is in which surface, and the surfaces
    that depend on time."""
    single = steers & (steers.sum(axis=0) == 1) & ~np.array(moved, bool)
    return tuple(int(np.argmax(row)) if row.any() else None for row in single)


def _members(steers: np.ndarray) -> tuple[tuple[int, ...], ...] | None:
    """`Structure.members`, given (n, m) flags of which number is in which surface."""
    if np.any(steers.sum(axis=1) > 1):
        return None
    return tuple(tuple(map(int, np.flatnonzero(of_j))) for of_j in steers.T)
