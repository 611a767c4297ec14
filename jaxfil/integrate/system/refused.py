"""Systems that cannot be lowered, and the error messages that say why."""

from typing import Any

import equinox as eqx
import jax

from jaxfil.integrate.system.dependencies import Structure
from jaxfil.model.system import System
from jaxfil.xla.trace import Traced

# The largest number of surfaces of a field that is not affine in its sides.
_MOST_PRODUCTS = 10


def check_affine(system: System, structure: Structure, m: int) -> None:
    """Raises an error for a system whose program would exhaust the memory."""
    if m > _MOST_PRODUCTS and not (structure.separate or structure.affine):
        raise ValueError(
            f"`vector_field` of {type(system).__name__} must be affine in its sides (a + b * side, "
            f"not side[0] * side[1]) with more than {_MOST_PRODUCTS} surfaces, since otherwise "
            f"each of the 2**m combinations of sides has a field of its own; got m = {m}."
        )


def check_reactions(system: System, field: Traced, at: tuple, asked: tuple) -> None:
    """Raises an error for a field (*at, reaction, *asked) that is not affine in its reactions; two
    evaluations would not determine it."""
    nothing, more = jax.tree.map(lambda _: False, (at, asked))
    all_reactions = jax.tree.map(lambda _: True, at[-1])
    if not field.is_affine(*nothing, all_reactions, *more):
        name = type(system).__name__
        # Private names belong to the library's own wrapper of a system and an observable.
        what = "The observable" if name.startswith("_") else f"`vector_field` of {name}"
        raise ValueError(
            f"{what} must be affine in its reactions (a + b * reaction, not "
            "jnp.maximum(reaction, 0.0), since they are never negative), got one that is not."
        )


def check_sharding(tree: Any) -> None:
    """Raises an error for arrays that `jax.shard_map` marks as varying between devices."""
    kinds = [jax.typeof(v) for v in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]
    # The attribute's name is `vma` up to JAX 0.9.
    varying = (
        getattr(kind, "vma", None)
        or getattr(getattr(kind, "manual_axis_type", None), "varying", None)
        for kind in kinds
    )
    if any(varying):
        # Derivatives inside the loop would have to annotate each number with the devices on which
        # it varies.
        raise ValueError("`check_vma` of `jax.shard_map` must be False around jaxfil, got True.")


def check_derivatives(**functions: Traced) -> None:
    """Raises an error for functions without forward derivatives."""
    for name, function in functions.items():
        found = function.without_derivatives()
        if found is not None:
            raise TypeError(
                f"`{name}` must have forward derivatives, which are used to locate contacts, got "
                f"one that calls `{found}`. Wrap it in `jax.custom_jvp`."
            )


def check_loops(**functions: Traced) -> None:
    """Raises an error for functions with a loop that has no reverse derivatives, which give the
    gradients of all surfaces at once."""
    for name, function in functions.items():
        if function.has_open_loop:
            raise ValueError(
                f"`{name}` must have reverse derivatives, which give the gradients of surfaces, "
                "got one that calls `jax.lax.while_loop`. Give the loop a fixed number of turns, "
                "as jax.lax.fori_loop(0, 20, ...) has, or wrap it in `jax.custom_jvp`."
            )
