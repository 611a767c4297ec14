"""The equations that define a bifurcation of equilibria, with two free parameters.

They are one fewer than the unknowns u. With r(z; p) = 0 the balance, J = ∂r/∂z, E the unit matrix
on the state and zero on multipliers, and a fixed vector c, which sets the length of a null vector,

- boundary: the margin of surface j is zero; u = (z, p).
- fold: J v = 0, c·v = 1; u = (z, v, p).
- Hopf: J (v + i w) = i ω E (v + i w), c·v = 1, c·w = 0; u = (z, v, w, ω, p).

J and E also describe the sliding flow, whose multipliers follow the state.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfil.equilibria.balance import Balance
from jaxfil.equilibria.equilibrium import Equilibrium
from jaxfil.equilibria.equilibrium_branch import EquilibriumBifurcation
from jaxfil.model.parameter import get_parameter, replace_parameters
from jaxfil.xla.known import array_of


class BifurcationEquations(eqx.Module):
    """The equations of one kind."""

    balance: Balance
    after: Float[Array, " m"]
    """The mode on the other side of a boundary."""
    across: Float[Array, " N"]
    """c, which sets the length of a null vector, and the phase of a complex one; zero at a
    boundary."""
    constants: Float[Array, "N N"]
    """The diagonal matrix of ones for components that only events change, as a latch."""
    start: Float[Array, " N"]
    """The unknowns z at the given bifurcation, where such components have their values."""
    free: tuple[str, str] = eqx.field(static=True)
    """The names of the two parameters."""
    family: str = eqx.field(static=True)
    """One of "boundary", "fold" and "hopf"."""
    surface: int = eqx.field(static=True)
    """The surface of a boundary."""

    def at(self, u: Array) -> tuple[Balance, Array]:
        """The balance at the values of the parameters, and its unknowns."""
        system = replace_parameters(self.balance.system, self.free, u[-2:])
        size = self.across.shape[0]
        return Balance(system, self.balance.mode, self.balance.affine), u[:size]

    def residual(self, u: Array) -> Array:
        """All equations."""
        balance, z = self.at(u)
        c, size = self.across, self.across.shape[0]

        def balanced(z: Array) -> Array:
            return balance.residual(z) + self.constants @ (z - self.start)

        r = balanced(z)
        if self.family == "boundary":
            return jnp.append(r, balance.margins(z)[self.surface])
        v = u[size : 2 * size]
        jv = jax.jvp(balanced, (z,), (v,))[1]
        if self.family == "fold":
            return jnp.concatenate([r, jv, jnp.stack([c @ v - 1])])
        w, omega = u[2 * size : 3 * size], u[3 * size]
        jw = jax.jvp(balanced, (z,), (w,))[1]
        diagonal = jnp.asarray(np.arange(size) < size - balance.mode.shape[0], u.dtype)  # of E
        real, imaginary = jv + omega * diagonal * w, jw - omega * diagonal * v
        return jnp.concatenate([r, real, imaginary, jnp.stack([c @ v - 1, c @ w])])

    def persists(self, u: Array) -> Array:
        """Positive where a boundary equilibrium persists, negative at a nonsmooth fold: −det J⁺
        det J, with J⁺ of the mode on the other side; for rest, and for the other side of a surface,
        the opposite sign."""
        balance, z = self.at(u)
        beside = Balance(balance.system, self.after, balance.affine)
        others = balance.unknowns_in(self.after, z)
        both = [b.derivative(v) for b, v in ((balance, z), (beside, others))]
        # Rows are scaled by their sizes, because only the sign matters.
        sizes = [jnp.max(abs(v), axis=1, keepdims=True) for v in both]
        determinants = [
            jnp.linalg.det(v / jnp.where(s > 0, s, 1)) for v, s in zip(both, sizes, strict=True)
        ]
        rests = jnp.any(balance.rested != beside.rested)
        passes = jnp.any(balance.mode * beside.mode < 0)
        return jnp.where(rests | passes, 1.0, -1.0) * determinants[0] * determinants[1]


@eqx.filter_jit
def _jacobian(balance: Balance, z: Array) -> tuple[Array, Array]:
    """The derivative of the balance, and the part of it for constant components."""
    jacobian = jax.jacfwd(balance.residual)(z)
    constants = balance.constants(jacobian, balance.split(z)[0])
    return jacobian + constants, constants


def _frequency(at: Equilibrium) -> float:
    """The frequency of the pair of eigenvalues nearest to the imaginary axis."""
    values = np.asarray(at.eigenvalues)
    pairs = values[np.imag(values) > 0]
    return float(np.imag(pairs[np.argmin(abs(np.real(pairs)))]))


def equations_of(
    bifurcation: EquilibriumBifurcation, free: tuple[str, str]
) -> tuple[BifurcationEquations, np.ndarray]:
    """The equations of a located bifurcation, and its unknowns."""
    at, kind = bifurcation.equilibrium, bifurcation.kind
    dtype = at.x.dtype
    balance = Balance(at.system, at.mode.astype(dtype), at._affine)
    z = np.concatenate([np.asarray(at.x), np.asarray(at.multipliers)])
    jacobian, constants = map(np.asarray, _jacobian(balance, array_of(z)))
    n, size = at.x.size, z.size
    family = kind if kind in ("fold", "hopf") else "boundary"
    more: list[np.ndarray] = []  # v, w and ω, between z and the parameters
    across, surface = np.zeros(size), 0
    before, after = bifurcation.before, bifurcation.after
    # On the part of a branch that was followed backward the equilibrium is in the mode after.
    beyond = after if np.array_equal(before, at.mode) else before
    if family == "boundary":
        changed = np.not_equal(before, after)
        surface = int(np.flatnonzero(changed)[0])
    elif family == "fold":
        across = np.linalg.svd(jacobian)[2][-1]
        more = [across]
    else:
        omega = _frequency(at)
        on_state = np.diag(np.arange(size) < n).astype(float)  # E
        vector = np.linalg.svd(jacobian - 1j * omega * on_state)[2][-1].conj()
        # Rotated so that its real and imaginary parts are orthogonal.
        vector = vector * np.exp(-0.5j * np.angle(np.sum(vector**2)))
        across = vector.real / (vector.real @ vector.real)
        more = [vector.real, vector.imag, np.array([omega])]
    values = [np.array([float(get_parameter(at.system, name)) for name in free])]
    equations = BifurcationEquations(
        balance=balance,
        after=array_of(np.asarray(beyond, dtype), dtype),
        across=array_of(across, dtype),
        constants=array_of(constants, dtype),
        start=array_of(z, dtype),
        free=free,
        family=family,
        surface=surface,
    )
    return equations, np.concatenate([z, *more, *values])
