"""Normals: the gradients ∇H_j of the surfaces, and what is made of them.

A system, the normals that `ComponentSystem.gradients` has found and vectors of n components enter;
products, one of each surface, or a vector moved along the normals leave. Of surfaces that are one
array (`ComponentSystem.packed`) the normals are one vector, of whose numbers each is of one surface
or of none.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.integrate.surfaces import unilateral
from jaxfil.integrate.system.components import Components, Normals, any_of, axpy, dot, number
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.xla.moves import taken
from jaxfil.xla.select import select


def products(system: ComponentSystem, normals: Normals, v: Components) -> Components:
    """∇H_j·v."""
    if system.packed:
        return (_of_each(system, normals[0][0] * v[0]),)
    return tuple(dot(normal, v) for normal in normals)


def sizes(system: ComponentSystem, normals: Normals, v: Components) -> Components:
    """Σ_i |∂H_j/∂x_i| v_i."""
    return products(system, jax.tree.map(abs, normals), v)


def project(
    system: ComponentSystem, x: Components, h: Components, normals: Normals, on: Components
) -> Components:
    """x moved along the normals by what makes H there smaller by `h`, on the surfaces marked `on`.

    Where surfaces share numbers of the state, all at once, by the solution of
    Σ_k (∇H_j·∇H_k) μ_k = −H_j: what is taken from one moves the state off another.
    """
    if system.m == 1 or system.structure.members is not None:
        each = zip(h, _squares(system, normals), on, strict=True)
        away = tuple(select(o, -v / select(s == 0, 1, s), 0.0) for v, s, o in each)
        return _moved(system, x, normals, away)

    def together(x: Components, h: Components, normals: Normals, on: Components) -> Components:
        zero = jnp.zeros_like(number(h, 0))
        pairs = tuple(tuple(zero + dot(a, b) for b in normals) for a in normals)
        return _moved(system, x, normals, unilateral.multipliers(pairs, h, on))

    return system.where_any(any_of(on), together, lambda x, *_: x, x, h, normals, on)


def _squares(system: ComponentSystem, normals: Normals) -> Components:
    """|∇H_j|²."""
    if system.packed:
        return products(system, normals, normals[0])
    return tuple(dot(normal, normal) for normal in normals)


def _moved(
    system: ComponentSystem, x: Components, normals: Normals, shares: Components
) -> Components:
    """x + Σ_j s_j ∇H_j."""
    if system.packed:
        return (x[0] + _spread(system, shares[0]) * normals[0][0],)
    for normal, share in zip(normals, shares, strict=True):
        x = axpy(x, share, normal)
    return x


def _of_each(system: ComponentSystem, terms: Array) -> Array:
    """The sum of the terms of each surface, of terms of each number of the state."""
    assert system.structure.members is not None
    most = max(1, max(map(len, system.structure.members)))
    table = np.zeros((system.m, most), np.int32)
    real = np.arange(most) < np.array([[len(row)] for row in system.structure.members])
    table[real] = np.concatenate(system.structure.members)
    return jnp.sum(select(real, taken(terms, table), 0.0), axis=1)


def _spread(system: ComponentSystem, shares: Array) -> Array:
    """The share of the surface that each number of the state is of, 0 of a number of none."""
    assert system.structure.members is not None
    owner = np.full(system.n, -1, np.int32)
    for j, row in enumerate(system.structure.members):
        owner[list(row)] = j
    # Any surface for a number of none, but in a row with others.
    of = np.where(owner < 0, np.arange(system.n) % system.m, owner)
    return select(owner >= 0, taken(shares, of), 0.0)
