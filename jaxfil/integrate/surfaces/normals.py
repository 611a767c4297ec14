"""Projection along the normals ∇H_j of the surfaces."""

from jaxfil.integrate.surfaces import unilateral
from jaxfil.integrate.system.components import Components, any_of, where
from jaxfil.integrate.system.lowered import ComponentSystem
from jaxfil.integrate.system.rows import Rows


def project(
    system: ComponentSystem, x: Components, h: Components, normals: Rows, on: Components
) -> Components:
    """x moved along the normals so that H_j drops by `h` on each surface marked `on`.

    Where surfaces share numbers of the state, all corrections are solved for together, from
    Σ_k (∇H_j·∇H_k) μ_k = −h_j, since a correction for one surface moves the state off another.
    """
    # Surfaces that share no number of the state have orthogonal normals.
    if system.m == 1 or system.structure.members is not None:
        # A normal of zero length does not move the state, so any finite factor is right.
        squares = normals.squares()
        return normals.added(x, where(on, -h / where(squares == 0, 1, squares), 0.0))

    def together(x: Components, h: Components, normals: Rows, on: Components) -> Components:
        return normals.added(x, unilateral.multipliers(normals.products(normals), h, on))

    return system.where_any(any_of(on), together, lambda x, *_: x, x, h, normals, on)
