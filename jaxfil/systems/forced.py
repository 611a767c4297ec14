"""Oscillators driven by a force, some of them on a belt or beside a wall.

Where there is one forcing frequency, its period is the period of the system, and diagrams sample
once per period.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.model.system import System
from jaxfil.systems.default import check_restitution, default, none_if_zero


class SDOscillator(System):
    """Smooth-and-discontinuous oscillator (snap-through arch), dimensionless.

        x'' + 2ζx' + x − x/√(x² + α²) = f0 cos Ωt;  at α = 0 the nonlinearity is x − sgn x.  H = x

    Both fields give the same dH/dt, so the surface is crossed or touched, never slid on. The motion
    from (0, 0) is not unique. The one-sided period-1 orbit about ±1 grazes the surface at
    Ω² = 1 − 2ζ² ∓ √((1 − 2ζ²)² − 1 + f0²), first at Ω = 0.866716581971234 with the defaults.
    `TEXTBOOK` starts it from (1.995, 0.085).

    **Source**: B. Santhosh, S. Narayanan and C. Padmanabhan, Discontinuity induced bifurcations in
    nonlinear systems, Procedia IUTAM 19 (2016) 219–227.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> sd, x0 = jf.systems.SDOscillator(omega=0.7), jnp.array([0.3, 0.1])
    >>> sol = jf.solve(sd, x0, 0.0, 6.0, 0.1, stepper=jf.RK4())
    >>> print(round(float(sol.events.ts[0]), 3))  # exactly 5.182577586…
    5.183
    """

    f0: Array = default(0.25)
    """Amplitude of the force."""
    zeta: Array = default(0.0141)
    """Damping ratio ζ."""
    omega: Array = default(0.7)
    """Frequency Ω of the force."""
    alpha: Array | None = eqx.field(converter=none_if_zero, default=0.0)
    """Deviation α of the arch from flat; None stands for α = 0, the discontinuous system, which has
    no such parameter."""

    slides: ClassVar[bool] = False
    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {"f0": "f₀", "zeta": "ζ", "omega": "Ω", "alpha": "α"}

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        snap = side if self.alpha is None else x[0] / jnp.sqrt(x[0] ** 2 + self.alpha**2)
        force = self.f0 * jnp.cos(self.omega * t)
        return jnp.stack([x[1], force - 2 * self.zeta * x[1] - x[0] + snap])

    def switching(self, t: Array, x: Array) -> Array:
        # Smooth for α > 0, without surfaces.
        return x[0] if self.alpha is None else jnp.zeros((0,), x.dtype)

    @property
    def period(self) -> Array:
        return 2 * jnp.pi / self.omega


class BeltFriction(System):
    """Forced oscillator on a moving belt, with dry friction; all per unit of mass.

        x'' = f0 cos ωt + αg w − βg w³ − γ1 x − γ2 x³ − μg sgn w,  w = x' − v;  H = w

    It sticks on x' = v while |f0 cos ωt − γ1 x − γ2 x³| < μg. The defaults are case 2 of the
    source, a cubic spring; case 1, a linear one, has γ1 = 10, γ2 = 0. Units follow from g in m/s².
    Case 2 has two attractors from about ω = 4.46 to 4.68 (one of them chaotic from 4.53 on),
    where its diagrams depend on the initial state. `TEXTBOOK` starts it from (0, 0).

    **Source**: B. Santhosh, S. Narayanan and C. Padmanabhan, Discontinuity induced bifurcations in
    nonlinear systems, Procedia IUTAM 19 (2016) 219–227.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=1.3)
    >>> x0, T = jnp.array([1.562680507274925516, 1.0]), belt.period
    >>> sol = jf.solve(belt, x0, 0.0, T, T / 40, stepper=jf.RK4())
    >>> [jf.EventKind(int(k)).name for k in sol.events.kinds[: sol.num_events]]
    ['slip', 'stick']
    """

    f0: Array = default(10.0)
    """Amplitude of the force, m/s²."""
    g: Array = default(9.81)
    """Gravity, m/s²."""
    mu: Array = default(0.6)
    """Coefficient μ of dry friction, dimensionless."""
    alpha: Array = default(-0.05)
    """Slope of friction against velocity, s/m; negative values damp."""
    beta: Array = default(0.0)
    """Cubic term of friction against velocity, s³/m³."""
    gamma1: Array = default(0.0)
    """Linear stiffness, 1/s²."""
    gamma2: Array = default(10000.0)
    """Cubic stiffness, 1/(m² s²)."""
    v: Array = default(1.0)
    """Velocity of the belt, m/s."""
    omega: Array = default(4.6)
    """Frequency of the force, rad/s."""

    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {
        "mu": "μ",
        "alpha": "α",
        "beta": "β",
        "f0": "f₀",
        "gamma1": "γ₁",
        "gamma2": "γ₂",
        "omega": "ω",
    }
    units: ClassVar = {
        "x": "m",
        "x'": "m/s",
        "t": "s",
        "f0": "m/s²",
        "g": "m/s²",
        "alpha": "s/m",
        "beta": "s³/m³",
        "gamma1": "1/s²",
        "gamma2": "1/(m² s²)",
        "v": "m/s",
        "omega": "rad/s",
    }

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        w = x[1] - self.v
        friction = self.g * (self.alpha * w - self.beta * w * w * w - self.mu * side)
        spring = x[0] * (self.gamma1 + self.gamma2 * x[0] * x[0])
        return jnp.stack([x[1], self.f0 * jnp.cos(self.omega * t) + friction - spring])

    def switching(self, t: Array, x: Array) -> Array:
        return x[1] - self.v

    @property
    def period(self) -> Array:
        return 2 * jnp.pi / self.omega


class MovingBelt(System):
    """Oscillator on a belt whose velocity changes, dimensionless, with a moving surface.

        x'' = −x − 0.4x' + cos 0.7t − F sgn(x' − v(t)),  v = cos t + 0.7;  H = x' − v(t)

    Its two frequencies, 0.7 and 1, have only the long common period 20π, and its `period` is None.
    From (3, 0), as in `TEXTBOOK`, it crosses at t = 7.60556996475, sticks at 9.48337857886 and
    slips at 9.76525875446.

    **Source**: M. Calvo, J. I. Montijano and L. Rández, Algorithm 968: DISODE45, ACM Transactions
    on Mathematical Software 43 (2016) 25.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> belt, x0 = jf.systems.MovingBelt(), jnp.array([3.0, 0.0])
    >>> sol = jf.solve(belt, x0, 0.0, 9.6, 0.05, stepper=jf.RK4())
    >>> [round(float(t), 3) for t in sol.events.ts[: sol.num_events]]
    [7.606, 9.483]
    """

    friction: Array = default(0.4)
    """Friction force F, in units of the amplitude of the force."""

    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {"friction": "F"}

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        force = jnp.cos(0.7 * t) - x[0] - 0.4 * x[1]
        return jnp.stack([x[1], force - self.friction * side])

    def switching(self, t: Array, x: Array) -> Array:
        return x[1] - jnp.cos(t) - 0.7


class DenHartog(System):
    """Harmonic forcing and dry friction, dimensionless; solved in closed form in 1931.

        x'' + x = cos Ωt − S sgn x';  H = x'

    With V = 1/(1 − Ω²) and U = tan(π/(2Ω))/Ω the motion without stops has the amplitude
    √(V² − S²U²); it begins to stop at S = Ω²|V|/√(1 + Ω⁴U²). `TEXTBOOK` starts it from (0, 0).

    **Source**: J. P. Den Hartog, Forced vibrations with combined Coulomb and viscous friction,
    Transactions of the ASME 53 (1931) 107–115.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.DenHartog(omega=0.8, friction=0.3), jnp.zeros(2)
    >>> T = system.period
    >>> sol = jf.solve(system, x0, 0.0, 40 * T, T / 40, stepper=jf.RK4())
    >>> print(round(abs(float(sol.events.xs[sol.num_events - 1, 0])), 3))  # exactly 2.6261048757…
    2.626
    """

    friction: Array = default(0.3)
    """Friction force S, in units of the amplitude of the force."""
    omega: Array = default(0.8)
    """Frequency Ω of the force, in units of the natural frequency."""

    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {"friction": "S", "omega": "Ω"}

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        return jnp.stack([x[1], jnp.cos(self.omega * t) - x[0] - self.friction * side])

    def switching(self, t: Array, x: Array) -> Array:
        return x[1]

    @property
    def period(self) -> Array:
        return 2 * jnp.pi / self.omega


class ImpactOscillator(System):
    """Forced linear oscillator of mass one beside a wall.

        x'' + cx' + kx = A cos ωt for x < d,  x' → −e x' at x = d;  H = d − x

    Its orbit without impacts grazes the wall at A = √((k − ω²)² + c²ω²) d. `TEXTBOOK` starts it
    from (0, 0).

    **Source**: S. W. Shaw and P. J. Holmes, A periodically forced piecewise linear oscillator,
    Journal of Sound and Vibration 90 (1983) 129–155.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.ImpactOscillator(restitution=0.5), jnp.array([0.0, 2.0])
    >>> sol = jf.solve(system, x0, 0.0, 1.0, 0.05, stepper=jf.RK4())
    >>> jf.EventKind(int(sol.events.kinds[0])).name, round(float(sol.events.xs[0, 0]), 5)
    ('impact', 1.0)
    """

    stiffness: Array = default(1.0)
    """Stiffness k, force per length."""
    damping: Array = default(0.1)
    """Damping c, force per velocity."""
    amplitude: Array = default(0.1)
    """Amplitude A of the force."""
    omega: Array = default(1.0)
    """Frequency ω of the force, radians per unit of time."""
    wall: Array = default(1.0)
    """Position d of the wall, a length."""
    restitution: Array = default(0.8)
    """Coefficient e of restitution, from 0 to 1, dimensionless."""

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

    def __check_init__(self):
        check_restitution(self)

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        force = self.amplitude * jnp.cos(self.omega * t)
        return jnp.stack([x[1], force - self.damping * x[1] - self.stiffness * x[0]])

    def switching(self, t: Array, x: Array) -> Array:
        return self.wall - x[0]

    def reset(self, t: Array, x: Array, surface: Array) -> Array:
        return jnp.stack([x[0], -self.restitution * x[1]])

    @property
    def period(self) -> Array:
        return 2 * jnp.pi / self.omega
