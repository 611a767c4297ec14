"""Systems without forcing, most of them solved in closed form."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from jaxfil.model.system import System
from jaxfil.systems.default import check_restitution, default


class CoulombOscillator(System):
    """A mass on a spring with dry friction, dimensionless: x'' = −x − F sgn x';  H = x'.

    From (3, 0), as in `TEXTBOOK`, with F = 0.4 it turns at π, 2π, 3π and sticks from t = 4π on with
    x = 3 − 8F.

    **Source**: textbook; J. P. Den Hartog, Mechanical Vibrations, McGraw–Hill (1934).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0])
    >>> sol = jf.solve(system, x0, 0.0, 13.0, 0.1, stepper=jf.RK4())
    >>> round(float(sol.x_final[0]), 4), int(sol.mode_final[0])  # it sticks
    (-0.2, 0)
    """

    friction: Array = default(0.4)
    """Friction force F, in units of stiffness times length."""

    state_names: ClassVar = ("x", "x'")
    symbols: ClassVar = {"friction": "F"}

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        return jnp.stack([x[1], -x[0] - self.friction * side])

    def switching(self, t: Array, x: Array) -> Array:
        return x[1]


class RotatingOscillator(System):
    """Two spirals that turn in opposite senses on both sides of a circle, dimensionless.

        ẋ = A₁x for |x| < 1, A₂x outside;  A₁ = [[1, ω], [−ω, 1]], A₂ = [[1, −ω], [ω, 1]]

    H = |x|² − 1 is curved. From (1/e, 0), as in `TEXTBOOK`, with ω = −2π it crosses at t = 1, and
    x(T) = e^{T−1}(cos 2π(T−1), −sin 2π(T−1)) after. It measures the order of a method.

    **Source**: A. Nurkanović and M. Diehl, NOSNOC: a software package for numerical optimal control
    of nonsmooth systems, IEEE Control Systems Letters 6 (2022) 3110–3115.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.RotatingOscillator(), jnp.array([jnp.exp(-1.0), 0.0])
    >>> sol = jf.solve(system, x0, 0.0, 2.0, 0.01, stepper=jf.RK4())
    >>> print(round(float(sol.x_final[0]), 4))  # exactly e
    2.7183
    """

    omega: Array = default(-6.283185307179586)
    """Angular velocity ω, radians per unit of time; its sign is the sense of rotation."""

    slides: ClassVar[bool] = False
    state_names: ClassVar = ("x₁", "x₂")
    symbols: ClassVar = {"omega": "ω"}

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        spin = -side * self.omega
        return jnp.stack([x[0] + spin * x[1], x[1] - spin * x[0]])

    def switching(self, t: Array, x: Array) -> Array:
        return x[0] ** 2 + x[1] ** 2 - 1


class SlipStick(System):
    """Autonomous stick–slip on a belt of velocity 0.2, dimensionless and without parameters.

        x₁' = x₂;  x₂' = −x₁ + 1/(1.2 − x₂) for x₂ < 0.2, −x₁ − 1/(0.8 + x₂) above;  H = x₂ − 0.2

    Its periodic orbit has the period 9.230770458083, sticks at x₁ = 0.094518907972 and slips
    exactly at (1, 0.2), where `TEXTBOOK` starts it.

    **Source**: L. Dieci and L. Lopez, Sliding motion in Filippov differential systems: theoretical
    results and a computational approach, SIAM Journal on Numerical Analysis 47 (2009) 2023–2051.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0, T = jf.systems.SlipStick(), jnp.array([1.0, 0.2]), 9.230770458083
    >>> sol = jf.solve(system, x0, 0.0, T, T / 200, stepper=jf.RK4())
    >>> [round(float(x), 3) for x in sol.x_final]
    [1.0, 0.2]
    """

    state_names: ClassVar = ("x₁", "x₂")

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        # Each quotient is zero off its own side, where it may have a pole. An infinity in the
        # branch not taken would still make the derivatives NaN.
        below, above = side < 0, side > 0
        pull = jnp.where(below, 1 / jnp.where(below, 1.2 - x[1], 1.0), 0.0)
        push = jnp.where(above, 1 / jnp.where(above, 0.8 + x[1], 1.0), 0.0)
        return jnp.stack([x[1], -x[0] + pull - push])

    def switching(self, t: Array, x: Array) -> Array:
        return x[1] - 0.2


class BouncingBall(System):
    """A ball that bounces on a floor: y'' = −g for y > 0, y' → −e y' at y = 0;  H = y.

    From rest at height h the impacts accumulate at √(2h/g)(1 + e)/(1 − e), the textbook Zeno
    example. `TEXTBOOK` starts it from (10, 0).

    **Source**: textbook; B. Brogliato, Nonsmooth Mechanics, Springer (2016).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.BouncingBall(), jnp.array([10.0, 0.0])
    >>> sol = jf.solve(system, x0, 0.0, 7.0, 0.1, stepper=jf.RK4())
    >>> [round(float(t), 3) for t in sol.events.ts[: sol.num_events]]  # exactly 10/7, 4, 6.3142857…
    [1.429, 4.0, 6.314]
    """

    g: Array = default(9.8)
    """Gravity, m/s² if lengths are in metres and times in seconds."""
    restitution: Array = default(0.9)
    """Coefficient e of restitution, from 0 to 1, dimensionless."""

    slides: ClassVar[bool] = False
    state_names: ClassVar = ("y", "y'")
    symbols: ClassVar = {"restitution": "e"}

    def __check_init__(self):
        check_restitution(self)

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        return jnp.stack([x[1], -self.g])

    def switching(self, t: Array, x: Array) -> Array:
        return x[0]

    def reset(self, t: Array, x: Array, surface: Array) -> Array:
        return jnp.stack([x[0], -self.restitution * x[1]])


class FilippovSpiral(System):
    """A spiral of straight lines into a corner, dimensionless and without parameters.

        ẋ = −sgn x + 2 sgn y,  ẏ = −2 sgn x − sgn y;  H = (x, y)

    From (0, 1), as in `TEXTBOOK`, it reaches the origin at t = 1/2 after infinitely many crossings,
    each leg a third of the last, and rests there.

    **Source**: A. F. Filippov, Differential Equations with Discontinuous Righthand Sides, Kluwer
    (1988).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.FilippovSpiral(), jnp.array([0.0, 1.0])
    >>> sol = jf.solve(system, x0, 0.0, 1.0, 0.1, stepper=jf.RK4())
    >>> bool(abs(sol.x_final).max() < 1e-3), sol.mode_final.tolist()
    (True, [0, 0])
    """

    state_names: ClassVar = ("x", "y")

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        return jnp.stack([-side[0] + 2 * side[1], -2 * side[0] - side[1]])

    def switching(self, t: Array, x: Array) -> Array:
        return x


class VisibleFold(System):
    """A slide that ends at a visible fold, dimensionless and without parameters.

        ẋ = (1, −1) where |x|² > 2, x inside;  H = |x|² − 2

    From (−1, 0.1), as in `TEXTBOOK`, it slides on the circle from t = 0.34159842485 and leaves it
    at 1.82862978083 in (−1, −1), where the field outside is tangent to the circle.

    **Source**: textbook; M. di Bernardo, C. Budd, A. Champneys and P. Kowalczyk, Piecewise-smooth
    Dynamical Systems, Springer (2008), for folds.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.VisibleFold(), jnp.array([-1.0, 0.1])
    >>> sol = jf.solve(system, x0, 0.0, 2.0, 0.05, stepper=jf.RK4())
    >>> [round(float(t), 3) for t in sol.events.ts[: sol.num_events]]
    [0.342, 1.829]
    """

    state_names: ClassVar = ("x", "y")

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        return jnp.where(side > 0, jnp.array([1.0, -1.0], x.dtype), x)

    def switching(self, t: Array, x: Array) -> Array:
        return x[0] ** 2 + x[1] ** 2 - 2


class TwoRelays(System):
    """Two constant fields separated by a line, dimensionless and without parameters.

        ẋ = (−2, 1.5) where x > y, (2, −3) where x < y;  H = x − y

    From (1.5, 1), as in `TEXTBOOK`, it slides along x = y from t = 1/7, and is at x = y = 15.5/17
    at t = 1.

    **Source**: textbook; A. F. Filippov, Differential Equations with Discontinuous Righthand Sides,
    Kluwer (1988), § 4, for the field along the line.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.TwoRelays(), jnp.array([1.5, 1.0])
    >>> sol = jf.solve(system, x0, 0.0, 1.0, 0.1, stepper=jf.RK4())
    >>> [round(float(x), 4) for x in sol.x_final]
    [0.9118, 0.9118]
    """

    state_names: ClassVar = ("x", "y")

    def vector_field(self, t: Array, x: Array, side: Array) -> Array:
        right = jnp.array([-2.0, 1.5], x.dtype)
        left = jnp.array([2.0, -3.0], x.dtype)
        return jnp.where(side > 0, right, left)

    def switching(self, t: Array, x: Array) -> Array:
        return x[0] - x[1]
