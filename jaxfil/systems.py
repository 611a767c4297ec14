"""Textbook systems with known answers.

Parameters enter as float leaves with defaults; modules leave, ready for every verb of the library.
`TEXTBOOK` names them for the command line, each with an initial state.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfil.model.system import System


def _parameter(default: float):
    return eqx.field(converter=jnp.asarray, default=default)


def _none_if_zero(value: Any) -> Array | None:
    known = not isinstance(value, jax.core.Tracer)
    zero = value is None or (known and np.all(np.asarray(value) == 0))
    return None if zero else jnp.asarray(value)


class SDOscillator(System):
    r"""Smooth-and-discontinuous oscillator (snap-through arch).

    x'' + 2ζx' + x − x/√(x² + α²) = f0 cos Ωt; at α = 0 the nonlinearity is x − sgn x. H = x.
    Both fields give the same dH/dt, so the surface is crossed or touched, never slid on. It is not
    unique at (0, 0). Santhosh, Narayanan and Padmanabhan, Procedia IUTAM 19 (2016) 219–227.
    """

    f0: Array = _parameter(0.25)
    zeta: Array = _parameter(0.0141)
    omega: Array = _parameter(0.7)
    alpha: Array | None = eqx.field(converter=_none_if_zero, default=0.0)
    """None stands for α = 0: the discontinuous system has no such parameter."""

    slides: ClassVar[bool] = False
    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {"zeta": "ζ", "omega": "Ω", "alpha": "α"}

    def vector_field(self, t, x, side):
        snap = side if self.alpha is None else x[0] / jnp.sqrt(x[0] ** 2 + self.alpha**2)
        force = self.f0 * jnp.cos(self.omega * t)
        return jnp.stack([x[1], force - 2 * self.zeta * x[1] - x[0] + snap])

    def switching(self, t, x):
        return x[0] if self.alpha is None else jnp.zeros((0,), x.dtype)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class BeltFriction(System):
    r"""Forced oscillator on a moving belt, with dry friction.

    x'' = f0 cos ωt + αg w − βg w³ − γ1 x − γ2 x³ − μg sgn w, w = x' − v; H = w.
    The defaults are case 2 of Santhosh, Narayanan and Padmanabhan (2016), a cubic spring; case 1
    has γ1 = 10, γ2 = 0. α = −0.05 is positive damping.
    """

    f0: Array = _parameter(10.0)
    g: Array = _parameter(9.81)
    mu: Array = _parameter(0.6)
    alpha: Array = _parameter(-0.05)
    beta: Array = _parameter(0.0)
    gamma1: Array = _parameter(0.0)
    gamma2: Array = _parameter(10000.0)
    v: Array = _parameter(1.0)
    omega: Array = _parameter(4.6)

    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {
        "mu": "μ",
        "alpha": "α",
        "beta": "β",
        "gamma1": "γ1",
        "gamma2": "γ2",
        "omega": "ω",
    }

    def vector_field(self, t, x, side):
        w = x[1] - self.v
        friction = self.g * (self.alpha * w - self.beta * w * w * w - self.mu * side)
        spring = x[0] * (self.gamma1 + self.gamma2 * x[0] * x[0])
        return jnp.stack([x[1], self.f0 * jnp.cos(self.omega * t) + friction - spring])

    def switching(self, t, x):
        return x[1] - self.v

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class CoulombOscillator(System):
    """x'' = −x − F sgn x'. From (3, 0) with F = 0.4 it turns at π, 2π, 3π and sticks for good at
    t = 4π with x = 3 − 8F."""

    friction: Array = _parameter(0.4)

    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {"friction": "F"}

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -x[0] - self.friction * side])

    def switching(self, t, x):
        return x[1]


class MovingBelt(System):
    """x'' = −x − 0.4x' + cos 0.7t − F sgn(x' − v(t)) with v = cos t + 0.7: a surface that moves.

    Calvo, Montijano and Rández, DISODE45 (ACM TOMS 42, 2016)."""

    friction: Array = _parameter(0.4)

    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {"friction": "F"}

    def vector_field(self, t, x, side):
        force = jnp.cos(0.7 * t) - x[0] - 0.4 * x[1]
        return jnp.stack([x[1], force - self.friction * side])

    def switching(self, t, x):
        return x[1] - jnp.cos(t) - 0.7


class RotatingOscillator(System):
    """ẋ = A₁x for |x| < 1, A₂x outside, A₁ = [[1, ω], [−ω, 1]], A₂ = [[1, −ω], [ω, 1]].

    From (1/e, 0) with ω = −2π it switches at t = 1, and x(T) = e^{T−1}(cos 2π(T−1), −sin 2π(T−1))
    after. H = |x|² − 1 is curved. The benchmark of Nurkanović et al., nosnoc (2022)."""

    omega: Array = _parameter(-6.283185307179586)

    slides: ClassVar[bool] = False
    state_names: ClassVar = ("x₁", "x₂")
    symbols: ClassVar = {"omega": "ω"}

    def vector_field(self, t, x, side):
        spin = -side * self.omega
        return jnp.stack([x[0] + spin * x[1], x[1] - spin * x[0]])

    def switching(self, t, x):
        return x[0] ** 2 + x[1] ** 2 - 1


class SlipStick(System):
    """x₁' = x₂; x₂' = −x₁ + 1/(1.2 − x₂) for x₂ < 0.2, −x₁ − 1/(0.8 + x₂) above: autonomous
    stick–slip, period 9.230770458083, leaving the stick exactly at (1, 0.2)."""

    state_names: ClassVar = ("x₁", "x₂")

    def vector_field(self, t, x, side):
        below, above = side < 0, side > 0
        pull = jnp.where(below, 1 / jnp.where(below, 1.2 - x[1], 1.0), 0.0)
        push = jnp.where(above, 1 / jnp.where(above, 0.8 + x[1], 1.0), 0.0)
        return jnp.stack([x[1], -x[0] + pull - push])

    def switching(self, t, x):
        return x[1] - 0.2


class DenHartog(System):
    """x'' + x = cos Ωt − S sgn x': harmonic forcing and dry friction, solved by Den Hartog (1931).
    Amplitude √(V² − S²U²) with V = 1/(1 − Ω²), U = tan(π/2Ω)/Ω."""

    friction: Array = _parameter(0.3)
    omega: Array = _parameter(0.8)

    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {"friction": "S", "omega": "Ω"}

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], jnp.cos(self.omega * t) - x[0] - self.friction * side])

    def switching(self, t, x):
        return x[1]

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class ImpactOscillator(System):
    """x'' + cx' + kx = A cos ωt with a wall at x = d: x' → −e x' there. H = d − x.

    It grazes at A = √((k − ω²)² + c²ω²) d."""

    stiffness: Array = _parameter(1.0)
    damping: Array = _parameter(0.1)
    amplitude: Array = _parameter(0.1)
    omega: Array = _parameter(1.0)
    wall: Array = _parameter(1.0)
    restitution: Array = _parameter(0.8)

    slides: ClassVar[bool] = False
    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {
        "stiffness": "k",
        "damping": "c",
        "amplitude": "A",
        "omega": "ω",
        "wall": "d",
        "restitution": "e",
    }

    def vector_field(self, t, x, side):
        force = self.amplitude * jnp.cos(self.omega * t)
        return jnp.stack([x[1], force - self.damping * x[1] - self.stiffness * x[0]])

    def switching(self, t, x):
        return self.wall - x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -self.restitution * x[1]])

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class BouncingBall(System):
    """y'' = −g above a floor at y = 0, y' → −e y' there. From height h the impacts accumulate at
    √(2h/g)(1 + e)/(1 − e): the textbook Zeno system."""

    g: Array = _parameter(9.8)
    restitution: Array = _parameter(0.9)

    slides: ClassVar[bool] = False
    state_names: ClassVar = ("y", "y'")
    symbols: ClassVar = {"restitution": "e"}

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.g])

    def switching(self, t, x):
        return x[0]

    def reset(self, t, x, surface):
        return jnp.stack([x[0], -self.restitution * x[1]])


class FilippovSpiral(System):
    """ẋ = −sgn x + 2 sgn y, ẏ = −2 sgn x − sgn y: from (0, 1) it reaches the origin at t = 1/2
    after infinitely many crossings and rests there. Filippov (1988)."""

    state_names: ClassVar = ("x", "y")

    def vector_field(self, t, x, side):
        return jnp.stack([-side[0] + 2 * side[1], -2 * side[0] - side[1]])

    def switching(self, t, x):
        return x


class VisibleFold(System):
    """ẋ = (1, −1) outside the circle |x|² = 2, (x, y) inside: from (−1, 0.1) it slides on the
    circle and leaves it at the visible fold (−1, −1)."""

    state_names: ClassVar = ("x", "y")

    def vector_field(self, t, x, side):
        return jnp.where(side > 0, jnp.array([1.0, -1.0], x.dtype), x)

    def switching(self, t, x):
        return x[0] ** 2 + x[1] ** 2 - 2


class TwoRelays(System):
    """ẋ = (−2, 1.5) if x > y, else (2, −3): from (1.5, 1) it slides along x = y from t = 1/7."""

    state_names: ClassVar = ("x", "y")

    def vector_field(self, t, x, side):
        right = jnp.array([-2.0, 1.5], x.dtype)
        left = jnp.array([2.0, -3.0], x.dtype)
        return jnp.where(side > 0, right, left)

    def switching(self, t, x):
        return x[0] - x[1]


TEXTBOOK: dict[str, tuple[type[System], tuple[float, ...]]] = {
    "sd-oscillator": (SDOscillator, (1.995, 0.085)),
    "belt-friction": (BeltFriction, (0.0, 0.0)),
    "coulomb-oscillator": (CoulombOscillator, (3.0, 0.0)),
    "moving-belt": (MovingBelt, (3.0, 0.0)),
    "rotating-oscillator": (RotatingOscillator, (0.36787944117144233, 0.0)),
    "slip-stick": (SlipStick, (1.0, 0.2)),
    "den-hartog": (DenHartog, (0.0, 0.0)),
    "impact-oscillator": (ImpactOscillator, (0.0, 0.0)),
    "bouncing-ball": (BouncingBall, (10.0, 0.0)),
    "filippov-spiral": (FilippovSpiral, (0.0, 1.0)),
    "visible-fold": (VisibleFold, (-1.0, 0.1)),
    "two-relays": (TwoRelays, (1.5, 1.0)),
}
