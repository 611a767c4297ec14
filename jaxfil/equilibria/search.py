"""`equilibrium`: an equilibrium by Newton's method, in a given mode or the mode of the guess.

It finds regular equilibria and pseudo-equilibria, stable or not, virtual or not.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Int

from jaxfil.equilibria.balance import Balance, is_affine
from jaxfil.equilibria.equilibrium import Equilibrium
from jaxfil.integrate.system.closed_over import with_closed_numbers
from jaxfil.model import check
from jaxfil.model.outcomes import RESULTS, raise_if_failed
from jaxfil.model.parameter import cast
from jaxfil.model.system import System
from jaxfil.model.types import State
from jaxfil.orbits.implicit import Equations, SystemOf, solve_implicit
from jaxfil.orbits.newton import Evaluation, Root, newton
from jaxfil.xla.known import array_of, compiled_if_traced
from jaxfil.xla.select import select
from jaxfil.xla.thresholds import EQUATIONS

# The least scale of a component, as a part of the change that alters an equation by its terms.
_SMALL = 1e-3
# A component that is zero, and moves by less than this many eps from there, is zero to rounding.
_ZERO = 0.256
_MODES = (-2, -1, 0, 1, 2)


def equilibrium(
    system: System,
    guess: State,
    *,
    mode: Int[ArrayLike, " m"] | int | None = None,
    newton_steps: int = 50,
    throw: bool = True,
) -> Equilibrium:
    r"""Find the equilibrium of an autonomous system near `guess` by Newton's method.

    $$\sum_s F_s(x) \prod_j \tfrac12 (1 + s_j w_j) + \sum_j \lambda_j d_j = 0, \qquad
    H_j(x) = 0 \text{ of each surface slid or rested on}$$

    On the sides of all surfaces it is a regular equilibrium, F(x, side) = 0. On sliding surfaces it
    is a pseudo-equilibrium of Filippov's sliding field, with the weights w among the unknowns; on
    surfaces with a reset it may rest, with the reactions λ in the direction d of the reset. It is
    virtual where H has the other sign, |w| > 1, or a reaction would have to pull.

    **Arguments**

    - `system`: the `System`, without a period and clocks. Its functions are evaluated at t = 0.
    - `guess`: a guess of the state, shape (n,). A component whose field is zero, such as a latch,
      keeps its value.
    - `mode`: for each surface the side ±1, 0 to slide on it, ±2 to rest on it from that side, shape
      (m,), or one number for one surface. None: the side of the guess; for a surface through the
      guess, to rounding, 0 (+1 if `slides` is False), or 2 if its reset reflects the motion.
    - `newton_steps`: the largest number of evaluations of the field.
    - `throw`: whether to raise an error unless the outcome is `successful`.

    **Returns** an `Equilibrium`. A virtual one is a success (see `kind` and `admissible`). For a
    batch use `equinox.filter_vmap` with `throw=False`. The first and second derivatives of its `x`
    and `multipliers` follow from the implicit function theorem, forward and reverse.

    **Outcomes**: `successful`; `newton_stalled`, `newton_singular` (a fold, or sliding with two
    equal fields) or `newton_max_steps_reached` without an equilibrium; `nonfinite` if the field at
    the guess is.

    **Source**: M. di Bernardo, C. Budd, A. Champneys and P. Kowalczyk, Piecewise-smooth Dynamical
    Systems, Springer (2008), § 5.1; on several surfaces the blend of J. Alexander and T. Seidman,
    Sliding modes in intersecting switching surfaces, Houston J. Math. 24 (1998).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> up, down = lambda t, x: jnp.stack([-x[0], -1.0]), lambda t, x: jnp.stack([1.0, 3.0])
    >>> relay = jf.piecewise(up, down, lambda t, x: x[1])
    >>> pseudo = jf.equilibrium(relay, jnp.array([0.5, 0.0]))
    >>> print(pseudo.kind, pseudo.x.round(6), pseudo.multipliers.round(6))
    pseudo [0.333333 0.      ] [0.5]
    """
    x = check.state("guess", guess)
    check.flags(throw=throw)
    if throw:
        check.finite("guess", x)
    check.system("system", system)
    system = with_closed_numbers(cast(system, x.dtype), x)
    autonomous("system", system)
    shape = check.shapes(system, x)
    m = 1 if shape == () else shape[0]
    known = None if mode is None else modes("mode", mode, m)
    budget = array_of(check.count("newton_steps", newton_steps), jnp.int32)
    if known is not None and not system.resets and np.any(abs(known) == 2):
        raise ValueError(
            f"`mode` must be −1, 0 or 1, since {type(system).__name__} has no reset and cannot "
            f"rest; got {check.told(mode)}."
        )
    if system.feels_reactions and (known is None or np.any(abs(known) == 2)):
        raise ValueError(
            f"`mode` must be given, without a rest, for {type(system).__name__}, whose field takes "
            f"reactions; got {check.told(mode)}."
        )
    affine = is_affine(system, x, m)
    given = None if known is None else array_of(np.asarray(known), x.dtype)
    found = in_mode(system, x, given, budget, m, affine)
    return raise_if_failed(found, found.result) if throw else found


def autonomous(name: str, system: System) -> None:
    """Check that a system is autonomous."""
    if system.period is not None or system.clocks:
        drives = "a period" if system.period is not None else "clocks"
        raise ValueError(
            f"`{name}` must be autonomous, since a forced system has no equilibria (see "
            f"`periodic_orbit`); {type(system).__name__} has {drives}."
        )


def modes(name: str, value: Any, m: int) -> np.ndarray:
    """A mode for each of m surfaces, shape (m,)."""
    must = f"{m} of the numbers −2, −1, 0, 1, 2, one for each surface"
    numbers = check.known_numbers(name, value, must)
    if m == 1 and numbers.ndim == 0:
        numbers = numbers[None]
    if numbers.shape != (m,) or not np.isin(numbers, _MODES).all():
        raise ValueError(f"`{name}` must be {must}, got {check.told(value)}.")
    return numbers


@compiled_if_traced
def in_mode(
    system: System, x: Array, mode: Array | None, newton_steps: Array, m: int, affine: bool
) -> Equilibrium:
    """`equilibrium` of checked arguments; None stands for the mode of the guess."""
    balance, z, least = _beginning(system, x, mode, m, affine)
    equations = _AtRest(balance.mode, least, newton_steps, affine)
    z, root = solve_implicit(equations, system, z)
    return equilibrium_of(balance, z, root)


@eqx.filter_jit
def _beginning(
    system: System, x: Array, mode: Array | None, m: int, affine: bool
) -> tuple[Balance, Array, Array]:
    """The mode, the first unknowns and their least scales."""
    if mode is None:
        mode = _mode_of(system, x, m)
    balance, off = Balance(system, mode, affine), abs(mode) == 1
    # Weights and reactions minimise the field at the guess; if the field itself is zero they are
    # exact.
    first = select(off, mode, jnp.zeros_like(mode))
    force = balance.field(x, first)
    by_first = jax.jacfwd(balance.field, 1)(x, first)
    gram = by_first.T @ by_first + jnp.diag(off.astype(x.dtype))
    best = first - jnp.linalg.solve(gram, by_first.T @ force)
    best = select(jnp.all(jnp.isfinite(best)), best, first)
    z = jnp.concatenate([x, select(off, mode, best)])
    residual, jacobian = balance.residual(z), balance.derivative(z)
    step = jnp.linalg.solve(jacobian, residual)
    # Nothing else shows the rounding of terms that cancel there.
    nothing = (z == 0) & (abs(step) <= _ZERO * jnp.finfo(z.dtype).eps)
    return balance, z, select(nothing, jnp.full_like(z, _SMALL), sizes(z, m))


def sizes(z: Array, m: int) -> Array:
    """Sizes of components, one at least for weights."""
    size = abs(z)
    return select(jnp.arange(z.shape[0]) < z.shape[0] - m, size, jnp.maximum(size, 1.0))


def throws_back(balance: Balance, x: Array) -> Array:
    """Whether the reset of each surface reflects a motion, e ≥ 0 to rounding, (m,)."""
    return balance.pushes(x)[1] >= 1 - float(jnp.finfo(x.dtype).eps) ** 0.5


def _mode_of(system: System, x: Array, m: int) -> Array:
    """The mode of a guess."""
    balance = Balance(system, jnp.ones((m,), x.dtype), affine=False)
    h = balance.h(x)
    terms = abs(jax.jacfwd(balance.h)(x)) @ abs(x)
    on = abs(h) <= EQUATIONS * jnp.finfo(x.dtype).eps * terms
    # Without slides the fields of both sides are equal there, and a weight is undetermined.
    there = jnp.zeros_like(h) if system.slides else jnp.ones_like(h)
    if system.resets and m:
        there = select(throws_back(balance, x), jnp.full_like(h, 2.0), there)
    # A mode has no derivative.
    return jax.lax.stop_gradient(select(on, there, jnp.sign(h)))


@eqx.filter_jit
def equilibrium_of(balance: Balance, z: Array, root: Root) -> Equilibrium:
    """The equilibrium of a solution."""
    x, multipliers = balance.split(z)
    return Equilibrium(
        x=x,
        mode=jnp.round(balance.mode).astype(jnp.int32),
        multipliers=multipliers,
        residual=root.size,
        num_steps=root.num_steps,
        result=root.result,
        system=balance.system,
        _affine=balance.affine,
    )


def evaluation(balance: Balance, z: Array, least: Array) -> Evaluation:
    """The equations in the form for Newton's method, with the least scales of the unknowns."""
    residual, jacobian = balance.residual(z), balance.derivative(z)
    unknowns = jnp.maximum(least, sizes(z, balance.mode.shape[0]))
    # A component may be small beside the others of which it is made. One that is zero has the size
    # of these, found from equation to equation.
    columns = abs(jacobian)

    def reach(unknowns: Array) -> Array:
        terms = (columns @ unknowns + abs(residual))[:, None]
        matters = (columns > 0) & (terms > 0)
        least = jnp.min(select(matters, terms / select(matters, columns, 1), jnp.inf), axis=0)
        return select(jnp.isfinite(least), least, 0)

    def known(_: Array, unknowns: Array) -> Array:
        return select(unknowns > 0, unknowns, reach(unknowns))

    unknowns = jnp.maximum(unknowns, _SMALL * reach(jax.lax.fori_loop(0, z.size, known, unknowns)))
    return relative(residual, jacobian, select(unknowns > 0, unknowns, 1))


def relative(residual: Array, jacobian: Array, unknowns: Array) -> Evaluation:
    """Equations relative to their terms, for unknowns of these scales."""
    terms = abs(jacobian) @ unknowns
    terms = select(terms > 0, terms, jnp.ones_like(terms))
    return Evaluation(residual, jacobian, terms, unknowns, RESULTS.successful, None)


class _AtRest(Equations):
    """The equations of an equilibrium of a given system, in a mode."""

    mode: Array
    least: Array
    newton_steps: Array
    affine: bool = eqx.field(static=True)

    def balance(self, system: System) -> Balance:
        """The balance of a system."""
        return Balance(system, self.mode, self.affine)

    @eqx.filter_jit
    def solve(self, system: System, guess: Array) -> tuple[Array, Array, Root]:
        """Newton's iteration."""
        balance = self.balance(system)
        root = newton(lambda z: evaluation(balance, z, self.least), guess, self.newton_steps)
        return root.z, root.at.jacobian, root

    @eqx.filter_jit
    def by_parameters(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """By the equations themselves."""
        return jax.jacfwd(lambda theta: self.balance(system_of(theta)).residual(z))(theta)

    @eqx.filter_jit
    def by_unknowns(self, system_of: SystemOf, theta: Array, z: Array) -> Array:
        """The same."""
        return jax.jacfwd(self.balance(system_of(theta)).residual)(z)
