"""The balance: the equations of an equilibrium in one mode of motion.

With μ the multipliers (weights w of sliding surfaces, reactions λ of resting ones) the unknowns are
z = (x, μ), of the same size for all modes:

    F(x, μ) = 0,    H_j(x) = 0 of a sliding or resting surface,    μ_j = side_j of any other

so that one program serves all modes. F is the blend of `integrate.surfaces.filippov`, here of
functions that JAX may differentiate any number of times, in either direction.
"""

import dataclasses
import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfil.equilibria.approach import QUADRANTS, Approach
from jaxfil.integrate.surfaces.corners import every_side
from jaxfil.integrate.system.dependencies import constants_of
from jaxfil.integrate.system.lowered import build
from jaxfil.model.system import System, field_of
from jaxfil.xla.select import select
from jaxfil.xla.thresholds import EQUATIONS
from jaxfil.xla.trace import without_branches

# Largest number of surfaces whose 2^m combinations of sides are always evaluated.
_FEW = 5
# Target of shifted zeros across surfaces, in sizes of the Jacobian.
_AWAY = 4.0


class Balance(eqx.Module):
    """A system in a mode: ±1 is a side of a surface, 0 sliding, ±2 rest from that side."""

    system: System
    mode: Float[Array, " m"]
    affine: bool = eqx.field(static=True)
    """Whether m + 1 combinations of sides determine the field."""

    @property
    def slid(self) -> Bool[Array, " m"]:
        """The sliding surfaces."""
        return self.mode == 0

    @property
    def rested(self) -> Bool[Array, " m"]:
        """The resting surfaces."""
        return abs(self.mode) == 2

    def split(self, z: Array) -> tuple[Array, Array]:
        """The state and the multipliers."""
        n = z.shape[0] - self.mode.shape[0]
        return z[:n], z[n:]

    def unknowns_in(self, after: Float[Array, " m"], z: Float[Array, " N"]) -> Float[Array, " N"]:
        """The unknowns of a boundary equilibrium in the mode on the other side of the boundary: a
        side for a side, no reaction where it begins to rest, and the same weight."""
        x, multipliers = self.split(z)
        begun = select(abs(after) == 2, jnp.zeros_like(after), multipliers)
        begun = select(abs(after) == 1, after, begun)
        return jnp.concatenate([x, select(after == self.mode, multipliers, begun)])

    def h(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """H of all surfaces."""
        switching = self.system.switching
        return jnp.atleast_1d(without_branches(switching, jnp.zeros((), x.dtype), x))

    def derivative(self, z: Float[Array, " N"]) -> Float[Array, "N N"]:
        """The derivative of the equations. A component that only events change, as a latch, is in
        balance at any value, and an equation is added by which it has the value of the guess."""
        jacobian = jax.jacfwd(self.residual)(z)
        return jacobian + self.constants(jacobian, self.split(z)[0])

    def constants(self, jacobian: Array, x: Array) -> Array:
        """The diagonal matrix of ones for components that only events change."""
        found = np.flatnonzero(constants_of(self.system, x))
        constant = np.isin(np.arange(len(jacobian)), found)
        # The reaction of a resting surface may be along such a component.
        zero = jnp.all(jacobian == 0, axis=1) if found.size else constant
        return jnp.diag((constant & zero).astype(x.dtype))

    def _force(self, x: Array, sides: Array) -> Array:
        """F on given sides."""
        t = jnp.zeros((), x.dtype)
        scalar = jnp.ndim(self.system.switching(t, x)) == 0
        sides = sides[0] if scalar else sides
        return without_branches(ft.partial(field_of, self.system), t, x, sides)

    def field(self, x: Float[Array, " n"], multipliers: Float[Array, " m"]) -> Float[Array, " n"]:
        """The blend of the fields with these weights and reactions."""
        m, slid = self.mode.shape[0], self.slid
        every = every_side(m) if not self.affine else np.eye(m + 1, m, -1) * -2 + 1
        flips = every < 0
        # A surface without sliding has one side in all of them, so its other side is not evaluated.
        base = select(slid, jnp.ones_like(self.mode), jnp.sign(self.mode))
        rows = select(slid & flips, -base, jnp.broadcast_to(base, flips.shape))
        fields = jax.vmap(ft.partial(self._force, x))(rows)
        below = select(slid, 0.5 * (1 - multipliers), jnp.zeros_like(multipliers))
        if self.affine:
            shares = jnp.append(1 - jnp.sum(below), below)
        else:
            shares = jnp.prod(jnp.where(flips, below, 1 - below), axis=1)
        blend = shares @ fields
        if not self.system.resets:
            return blend
        reactions = select(self.rested, multipliers, jnp.zeros_like(multipliers))
        return blend + reactions @ self.pushes(x)[0]

    def _approach(self, x: Array) -> Array:
        """ψ = dH/dt along the field of the sides, (m,), independent of them for a resting
        surface."""
        sides = select(self.slid, jnp.ones_like(self.mode), jnp.sign(self.mode))
        return jax.jvp(self.h, (x,), (self._force(x, sides),))[1]

    def pushes(self, x: Float[Array, " n"]) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """The directions d_j of resets, scaled such that ∇ψ_j·d_j = 1, so that a reaction is the
        acceleration d²H/dt² that it causes; and the factors 1 + e_j by which they reverse ψ. See
        `integrate.surfaces.unilateral`."""
        normals = jax.jacfwd(self._approach)(x)
        sizes = jnp.sum(normals * normals, axis=1)
        inverse = 1 / select(sizes > 0, sizes, jnp.ones_like(sizes))
        # A reset may be defined for approaching motions only.
        tiny = float(np.finfo(x.dtype).tiny) ** 0.5
        depth = EQUATIONS * jnp.finfo(x.dtype).eps * abs(normals) @ abs(x) + tiny
        depth = jax.lax.stop_gradient(select(self.mode < 0, -depth, depth) * inverse)

        def direction(j: Array, normal: Array, depth: Array) -> Array:
            def reset(x: Array) -> Array:
                return without_branches(self.system.reset, jnp.zeros((), x.dtype), x, j)

            moving = x - depth * jax.lax.stop_gradient(normal)
            return normal - jax.jvp(reset, (moving,), (normal,))[1]

        numbers = jnp.arange(normals.shape[0], dtype=jnp.int32)
        directions = jax.vmap(direction)(numbers, normals, depth) * inverse[:, None]
        gains = jnp.sum(normals * directions, axis=1)
        acts = gains != 0
        return directions / select(acts, gains, jnp.ones_like(gains))[:, None], gains

    def residual(self, z: Float[Array, " N"]) -> Float[Array, " N"]:
        """The equations."""
        x, multipliers = self.split(z)
        off = abs(self.mode) == 1
        rows = select(off, multipliers - self.mode, self.h(x))
        return jnp.concatenate([self.field(x, multipliers), rows])

    def margins(self, z: Float[Array, " N"]) -> Float[Array, " m"]:
        """±H_j on a side, 1 − w_j² of a sliding surface, the reaction of a resting one."""
        x, multipliers = self.split(z)
        inside = (1 - multipliers) * (1 + multipliers)
        pushes = jnp.sign(self.mode) * multipliers
        held = select(self.rested, pushes, self.mode * self.h(x))
        return select(self.slid, inside, held)

    def noise(self, z: Float[Array, " N"]) -> Float[Array, " m"]:
        """Rounding of the margins."""
        x, multipliers = self.split(z)
        eps = EQUATIONS * jnp.finfo(z.dtype).eps
        of_h = abs(jax.jacfwd(self.h)(x)) @ abs(x)
        return eps * select(abs(self.mode) == 1, of_h, jnp.maximum(1.0, abs(multipliers)))


def is_affine(system: System, x: Float[Array, " n"], m: int) -> bool:
    """Whether m + 1 combinations of sides determine a field with many surfaces."""
    if m <= _FEW:
        return False
    structure = build(system, x, compact=True).structure
    return structure.affine or structure.separate


class Linearised(eqx.Module):
    """The flow of a mode near its equilibrium."""

    jacobian: Float[Array, "n n"]
    """Jacobian of the field of the mode, with multipliers that follow the state."""
    deflated: Float[Array, "n n"]
    """The same, with its zeros across the surfaces shifted to `shift`."""
    shift: Float[Array, ""]
    """A number larger than all eigenvalues."""
    constants: Float[Array, "n n"]
    """The diagonal matrix of ones for components that only events change, as a latch."""
    approach: Approach
    """The motion across the sliding surfaces."""

    def moving(self) -> "Linearised":
        """The same with a fast decay of the components that only events change, so that their zeros
        are among the infinite eigenvalues."""
        decay = self.shift * self.constants
        return dataclasses.replace(self, deflated=self.deflated - decay)


def linearise(balance: Balance, z: Float[Array, " N"]) -> Linearised:
    """The flow of a mode near an equilibrium, where the multipliers follow the state.

    The constraints that hold a motion on surfaces stay zero: with C the gradients of H_j, or of
    ψ_j for a resting surface,

        A = F_x − F_μ (C F_μ)⁻¹ C F_x,    C A = 0.

    With P the projection on these gradients, A + c P has c instead of the zeros across surfaces,
    and the other eigenvalues of A, for all parameters, as do its derivatives.
    """
    x, multipliers = balance.split(z)
    by_x, by_mu = jax.jacfwd(balance.field, (0, 1))(x, multipliers)
    off = abs(balance.mode) == 1
    normals = jax.jacfwd(balance.h)(x)
    held = normals
    if balance.system.resets:
        of_rests = jax.jacfwd(balance._approach)(x)
        held = select(balance.rested[:, None], of_rests, normals)
        # A motion at rest has both H = 0 and ψ = 0.
        normals = jnp.concatenate([normals, of_rests])
    kept = jnp.concatenate([~off, balance.rested])[: normals.shape[0]]
    unit = jnp.diag(off.astype(z.dtype))
    held = select(off[:, None], jnp.zeros_like(held), held)
    response = jnp.linalg.inv(held @ by_mu + unit)
    jacobian = by_x - by_mu @ response @ held @ by_x
    size = jnp.sqrt(jnp.sum(jacobian**2))
    shift = jax.lax.stop_gradient(select(size > 0, _AWAY * size, jnp.ones_like(size)))
    projection = _projection(select(kept[:, None], normals, jnp.zeros_like(normals)), kept)
    both = balance.slid[:, None] & balance.slid[None, :]
    return Linearised(
        jacobian=jacobian,
        deflated=jacobian + shift * projection,
        shift=shift,
        constants=balance.constants(jacobian, x),
        approach=Approach(
            slid=balance.slid,
            response=select(both, response, -jnp.eye(off.shape[0], dtype=z.dtype)),
            speeds=_speeds(balance, z, held, by_mu) if off.shape[0] > 1 else None,
        ),
    )


def _speeds(
    balance: Balance, z: Float[Array, " N"], held: Float[Array, "m n"], by_mu: Float[Array, "n m"]
) -> Float[Array, "4 2"]:
    """dH/dt of the first two sliding surfaces on `QUADRANTS` of their sides, with reactions that
    keep resting surfaces at rest."""
    x, multipliers = balance.split(z)
    two = jnp.argsort(~balance.slid)[:2]
    pushes = select(balance.rested, by_mu, jnp.zeros_like(by_mu))
    unit = jnp.eye(multipliers.shape[0], dtype=z.dtype)
    matrix = select(balance.rested[:, None], held @ pushes, unit)

    def speeds(sides: Array) -> Array:
        force = balance.field(x, multipliers.at[two].set(sides))
        if balance.system.resets:
            too_much = select(balance.rested, held @ force, jnp.zeros_like(multipliers))
            force -= pushes @ jnp.linalg.solve(matrix, too_much)
        return (held @ force)[two]

    return jax.vmap(speeds)(jnp.asarray(QUADRANTS, z.dtype))


def _projection(rows: Float[Array, "k n"], kept: Bool[Array, " k"]) -> Float[Array, "n n"]:
    """The orthogonal projection on the rows flagged by `kept`; other rows are zero."""
    length = jnp.sqrt(jnp.sum(rows**2, axis=1) + (~kept).astype(rows.dtype))
    rows = rows / length[:, None]
    gram = rows @ rows.T + jnp.diag((~kept).astype(rows.dtype))
    return rows.T @ jnp.linalg.solve(gram, rows)


def on_batches(function: Callable, dimensions: int) -> Callable:
    """`function` of records with this many leading axes."""
    for _ in range(dimensions):
        function = eqx.filter_vmap(function)
    return function
