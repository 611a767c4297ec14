"""What is refused before a system is lowered, in one line that says why."""

from typing import Any

import equinox as eqx
import jax

from jaxfil.integrate.system.dependencies import Structure
from jaxfil.model.system import System
from jaxfil.xla.trace import Traced

# Surfaces at most of a field that is not affine in its sides.
_MOST_PRODUCTS = 10


def check_affine(system: System, structure: Structure, m: int) -> None:
    """Says what would end in a lack of memory."""
    if m > _MOST_PRODUCTS and not (structure.separate or structure.affine):
        raise ValueError(
            f"`vector_field` of {type(system).__name__} must be affine in its sides (a + b * side, "
            f"not side[0] * side[1]) with more than {_MOST_PRODUCTS} surfaces, for otherwise each "
            f"of the 2**m combinations of sides has a field of its own; got m = {m}."
        )


def check_reactions(system: System, field: Traced, at: tuple, asked: tuple) -> None:
    """Refuses a field (*at, reaction, *asked) that is not affine in its reactions, which then could
    not be found from two values."""
    nothing, more = jax.tree.map(lambda _: False, (at, asked))
    all_reactions = jax.tree.map(lambda _: True, at[-1])
    if not field.is_affine(*nothing, all_reactions, *more):
        name = type(system).__name__
        # One of the library's own is a system with what is observed of it.
        what = "What is observed" if name.startswith("_") else f"`vector_field` of {name}"
        raise ValueError(
            f"{what} must be affine in its reactions (a + b * reaction, not "
            "jnp.maximum(reaction, 0.0), for they are never negative), got one that is not."
        )


def check_sharding(tree: Any) -> None:
    """Refuses arrays that `jax.shard_map` says to differ between devices."""
    kinds = [jax.typeof(v) for v in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]
    # `vma` until JAX 0.9.
    varying = (
        getattr(kind, "vma", None)
        or getattr(getattr(kind, "manual_axis_type", None), "varying", None)
        for kind in kinds
    )
    if any(varying):
        # Derivatives taken inside of the loop would have to say of each number where it differs.
        raise ValueError("`check_vma` of `jax.shard_map` must be False around jaxfil, got True.")


def check_derivatives(**functions: Traced) -> None:
    """Refuses functions without forward derivatives."""
    for name, function in functions.items():
        found = function.without_derivatives()
        if found is not None:
            raise TypeError(
                f"`{name}` must have forward derivatives, which contacts are located with, got one "
                f"that calls `{found}`: wrap it in `jax.custom_jvp`."
            )
