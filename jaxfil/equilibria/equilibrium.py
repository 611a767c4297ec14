"""`Equilibrium`: an equilibrium of a system, with margins, kind, eigenvalues and stability."""

import functools as ft
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from jaxfil.equilibria.balance import Balance, Linearised, linearise, on_batches
from jaxfil.model.card import outcome, precision
from jaxfil.model.outcomes import RESULTS
from jaxfil.model.system import System
from jaxfil.xla.select import select


class Equilibrium(eqx.Module):
    """A state x in which a system stays, F = 0, on one side of each surface, sliding or at rest.

    The first and second derivatives of `x` and `multipliers` with respect to the float leaves of
    the system follow from the implicit function theorem. `margins` and `jacobian` also have first
    and second ones, `eigenvalues` first ones.
    """

    x: Float[Array, " n"]
    """The state."""
    mode: Int[Array, " m"]
    """For each surface ±1 for its side, 0 for a pseudo-equilibrium of the sliding flow, ±2 for rest
    on the surface from that side."""
    multipliers: Float[Array, " m"]
    """For each sliding surface the weight w of its sides, from −1 to 1 unless it is virtual:
    F = (1 + w)/2 F_+ + (1 − w)/2 F_−; for a resting one the reaction; for others the side."""
    residual: Float[Array, ""]
    """The largest residual of the equations, relative to their terms."""
    num_steps: Int[Array, ""]
    """Number of evaluations by Newton's method."""
    result: RESULTS
    """The outcome of the search."""
    system: System
    """The system, with the parameters of this equilibrium."""
    _affine: bool = eqx.field(static=True)

    @property
    def margins(self) -> Float[Array, "*batch m"]:
        """A number of each surface that is positive unless the equilibrium is virtual: ±H on a
        side, 1 − w² for a sliding surface, the repelling reaction of a resting one. It is zero for
        a boundary equilibrium."""
        return self._of(_margins)

    @property
    def admissible(self) -> Bool[Array, "*batch"]:
        """Whether it is an equilibrium of the system: no margin is negative beyond rounding.
        Otherwise it is virtual, and the field or the blend that vanishes there is not the field of
        the system."""
        return self._of(_admissible) & (self.result == RESULTS.successful)

    @property
    def jacobian(self) -> Float[Array, "*batch n n"]:
        """The derivative of the field of its mode, shape (n, n). For sliding this is the sliding
        field, which has a zero for each sliding surface and two for each resting one."""
        return self._of(_jacobian)

    @property
    def eigenvalues(self) -> Complex[Array, "*batch n"]:
        """Eigenvalues of the Jacobian, shape (n,), by descending real part.

        Sliding is reached in a finite time, so the zero of each sliding surface is replaced by −∞,
        or +∞ where the sides repel. On two sliding surfaces both are −∞ if motions from all sides
        reach their intersection, sliding on one of them or turning about it. On more the limits of
        the eigenvalues of a smoothed system decide, with a different answer for another smoothing
        in some systems. The two of a resting surface are replaced by −∞."""
        return self._of(_eigenvalues)

    @property
    def stable(self) -> Bool[Array, "*batch"]:
        """Whether it belongs to the system and all eigenvalues have negative real parts, except the
        0 of a component of the state that only events change, as a latch."""
        return self.admissible & self.attracts

    @property
    def attracts(self) -> Bool[Array, "*batch"]:
        """Whether the field of its mode attracts to it, as in `stable`."""
        return self._of(_attracts)

    @property
    def kind(self) -> str | np.ndarray:
        """One of "regular", "pseudo" (it slides) and "rest", or "boundary" for a boundary
        equilibrium, preceded by "virtual " if it does not belong to the system; for a batch an
        array of these."""
        kinds = _kinds(*map(np.asarray, (self.mode, self.margins, self._of(_noise))))
        return str(kinds) if kinds.ndim == 0 else kinds

    def _of(self, function: Callable) -> Any:
        return on_batches(function, self.x.ndim - 1)(self)

    def __repr__(self) -> str:
        return _card(self)


def _balance(at: Equilibrium) -> tuple[Balance, Array]:
    mode = at.mode.astype(at.x.dtype)
    return Balance(at.system, mode, at._affine), jnp.concatenate([at.x, at.multipliers])


@eqx.filter_jit
def _margins(at: Equilibrium) -> Array:
    balance, z = _balance(at)
    return balance.margins(z)


@eqx.filter_jit
def _noise(at: Equilibrium) -> Array:
    balance, z = _balance(at)
    return balance.noise(z)


@eqx.filter_jit
def _admissible(at: Equilibrium) -> Array:
    balance, z = _balance(at)
    return jnp.all(balance.margins(z) >= -balance.noise(z))


@eqx.filter_jit
def _jacobian(at: Equilibrium) -> Array:
    return linearise(*_balance(at)).jacobian


@eqx.filter_jit
def _eigenvalues(at: Equilibrium) -> Array:
    return eigenvalues_of(linearise(*_balance(at)))


@eqx.filter_jit
def _attracts(at: Equilibrium) -> Array:
    return jnp.all(jnp.real(eigenvalues_of(linearise(*_balance(at)).moving())) < 0)


def eigenvalues_of(flow: Linearised) -> Complex[Array, " n"]:
    """The eigenvalues of a linearised flow, by descending real part, infinite across surfaces."""
    # LAPACK must not receive a NaN.
    sound = jnp.all(jnp.isfinite(flow.deflated)) & flow.approach.sound
    fine = lambda v: select(sound, v, jnp.zeros_like(v))  # noqa: E731
    values = jnp.linalg.eigvals(fine(flow.deflated))
    moved = sound & (abs(values) > 0.5 * flow.shift) & (jnp.isfinite(flow.shift))
    height = jnp.where(moved, -jnp.inf, jnp.real(values))
    # Ties are ordered by the imaginary part, independent of the library.
    order = jnp.lexsort((-jnp.imag(values), -height))
    values, count = values[order], jnp.sum(moved)
    repels = jax.tree.map(fine, jax.lax.stop_gradient(flow.approach)).repelling()
    values, place = jnp.roll(values, repels), jnp.arange(values.shape[0])
    values = jnp.where(place < repels, jnp.inf, values)
    values = jnp.where(place >= values.shape[0] - (count - repels), -jnp.inf, values)
    return jnp.where(sound, values, jnp.nan)


def _kinds(mode: np.ndarray, margins: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """The kind of each equilibrium of a batch."""
    plain = np.where(np.any(mode == 0, axis=-1), "pseudo", "regular")
    plain = np.where(np.any(abs(mode) == 2, axis=-1), "rest", plain)
    plain = np.where(np.any(abs(margins) <= noise, axis=-1), "boundary", plain)
    virtual = np.any(margins < -noise, axis=-1)
    return np.where(virtual, np.char.add("virtual ", plain), plain)


def _card(at: Equilibrium) -> str:
    told = precision(at.x)
    if isinstance(at.x, jax.core.Tracer) or at.x.ndim > 1:
        *batch, n = at.x.shape
        return f"Equilibrium{told}: a batch of shape {tuple(batch)}, states of {n}"
    show = ft.partial(np.array2string, precision=10, separator=", ")
    lines = [
        f"Equilibrium of {type(at.system).__name__}{told}: {outcome(at.result)}",
        f"  {at.kind}, x = {show(np.asarray(at.x))}, mode {np.asarray(at.mode).tolist()}",
    ]
    held = np.asarray(abs(at.mode) != 1)
    if held.any():
        numbers = zip(np.flatnonzero(held), np.asarray(at.multipliers)[held], strict=True)
        words = [f"{'w' if at.mode[j] == 0 else 'λ'} = {v:.10g}" for j, v in numbers]
        lines.append(f"  {', '.join(words)}")
    lines += [
        f"  eigenvalues {show(np.asarray(at.eigenvalues))}: "
        + ("stable" if bool(at.stable) else "unstable"),
        f"  residual {float(at.residual):.1e} after {int(at.num_steps)} Newton steps",
    ]
    return "\n".join(lines)
