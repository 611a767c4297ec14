"""A linearly implicit step for stiff fields.

Each step solves s small linear systems with one matrix I − γhJ, where J = ∂F/∂x is computed by
automatic differentiation. Without an inner iteration, all lanes of a batch do the same work.
With α, γ_ij and b its coefficients, c_i and γ_i the sums of rows of α and γ_ij, a step reads

    (I − γhJ) k_i = F(t + c_i h, x + h Σ_j α_ij k_j) + hJ Σ_{j<i} γ_ij k_j + γ_i h ∂F/∂t
    x(t + h) = x + h Σ_i b_i k_i

(Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.7). The product with J is
eliminated by solving for v_i = k_i + Σ_{j<i} (γ_ij/γ) k_j. The usual variables
u_i = h Σ_j γ_ij k_j would save these sums, but their coefficients, up to 165, cost two digits in
every step.
"""

import functools as ft
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.steppers.adaptive import Adaptive
from jaxfil.integrate.system.components import Components, on_each, scalars
from jaxfil.integrate.system.smooth_field import SmoothField
from jaxfil.xla.small_linear import Factors, factored


class Rodas5P(eqx.Module):
    """Rodas5P: eight stages, order five, L-stable and stiffly accurate, for stiff fields.

    Accepted wherever `stepper` is an argument. Steps need to resolve only the slow motion. Contacts
    under very stiff damping (rates of 1e8) are located to 1e-6 in time only, and an oscillation
    that a step does not resolve is damped out without a warning.

    **Source**: G. Steinebach, Construction of Rosenbrock–Wanner method Rodas5P and numerical
    benchmarks within the Julia Differential Equations package, BIT Numerical Mathematics 63, 27
    (2023).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> fast = jf.piecewise(
    ...     lambda t, x: -1e6 * (x - 1), lambda t, x: -1e6 * x, lambda t, x: t[None] - 0.5
    ... )
    >>> sol = jf.solve(fast, jnp.zeros(1), 0.0, 1.0, 0.1, stepper=jf.Rodas5P())
    >>> round(float(sol.xs[-1, 0]), 9)
    1.0
    """


class RosenbrockTableau(eqx.Module):
    """The coefficients in the module's formulas: γ, c (s,), γ_i (s,) as `drift`, b (s,), and as s
    rows α and γ_ij/γ (`coupling`)."""

    gamma: float = eqx.field(static=True)
    c: tuple[float, ...] = eqx.field(static=True)
    drift: tuple[float, ...] = eqx.field(static=True)
    alpha: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    coupling: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    b: tuple[float, ...] = eqx.field(static=True)
    d: tuple[float, ...] = eqx.field(static=True)
    """Coefficients of the error estimate h Σ d·slopes. It is u of the last stage, without which the
    method has order four. The last entry, for the slope at the end, is zero."""
    name: str = eqx.field(static=True)
    crude: bool = eqx.field(static=True, default=False)
    order: int = eqx.field(static=True, default=5)
    tolerance: Adaptive | None = eqx.field(static=True, default=None)
    """The tolerance that chooses the step lengths; None for fixed lengths."""

    @property
    def stages(self) -> int:
        """Evaluations of the field per step."""
        return len(self.b)

    @property
    def times(self) -> list[float]:
        """Times in a step, as fractions, at which the field is evaluated alone: its end."""
        return [1.0]


def _table(name: str, gamma: float, a: list, coupling: list, m: list) -> RosenbrockTableau:
    """The table of a method published in the variables u, where x(t + h) = x + Σ m_i u_i, α = aΓ
    and Γ⁻¹ = 1/γ − C."""
    s = len(m)

    def square(rows: list) -> np.ndarray:
        return np.asarray([[*row, *[0.0] * (s - len(row))] for row in rows])

    full = np.linalg.inv(np.eye(s) / gamma - square(coupling))
    alpha, b = square(a) @ full, np.asarray(m) @ full
    # The published 16 digits give a sum of b that is wrong by 1e-14; corrected, so that a constant
    # field is integrated exactly.
    b[-2] += 1 - b.sum()
    return RosenbrockTableau(
        gamma=gamma,
        c=tuple(map(float, alpha.sum(axis=1))),
        drift=tuple(map(float, full.sum(axis=1))),
        alpha=tuple(tuple(map(float, alpha[i, :i])) for i in range(s)),
        coupling=tuple(tuple(map(float, full[i, :i] / gamma)) for i in range(s)),
        b=tuple(map(float, b)),
        d=(*map(float, full[-1]), 0.0),
        name=name,
    )


# Published coefficients that are row sums of others are omitted, and computed in `_table`.
# fmt: off
_LAST = [-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
         0.030198172008377946]
RODAS5P = _table(
    name="Rodas5P",
    gamma=0.21193756319429014,
    a=[
        [],
        [3.0],
        [2.849394379747939, 0.45842242204463923],
        [-6.954028509809101, 2.489845061869568, -10.358996098473584],
        [2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641],
        _LAST,
        [*_LAST, 1.0],
        [*_LAST, 1.0, 1.0],
    ],
    coupling=[
        [],
        [-14.155112264123755],
        [-17.97296035885952, -2.859693295451294],
        [147.12150275711716, -1.41221402718213, 71.68940251302358],
        [165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306],
        [24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125,
         -0.6610691825249471],
        [30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783,
         -19.097331116725623, -28.087943162872662],
        [37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047,
         -40.06618937091002, -54.66780262877968, -9.48861652309627],
    ],
    m=[*_LAST, 1.0, 1.0, 1.0],
)
# fmt: on


# The largest matrix that is factored number by number.
_FEW = 12


class _Linearised(eqx.Module):
    """The start of a step, with the quantities that all its stages share."""

    t: Array
    x: Components
    f: Components
    """The field at the start."""
    h: Array
    factors: Factors | tuple[Array, Array]
    """Factors of I − γhJ, number by number for a small matrix, else L and U by LAPACK. LAPACK calls
    end a kernel, but n³ operations then take longer than starting some kernels."""
    drift: Components
    """h ∂F/∂t."""

    def solve(self, right: Components) -> Components:
        """k of (I − γhJ) k = b."""
        if not isinstance(self.factors, Factors):
            return on_each(lambda b: jax.scipy.linalg.lu_solve(self.factors, b), right)
        if right.is_array:
            return Components([jnp.stack(self.factors.solve(scalars(right.parts[0])))])
        return Components(self.factors.solve(right.parts))


def rosenbrock_step(
    tableau: RosenbrockTableau, field: SmoothField, t: Array, x: Components, f: Components, h: Array
) -> tuple[Components, Components]:
    """The state at t + h, and the error estimate divided by h; `f` is the field at (t, x)."""
    start = field.once(ft.partial(_linearised, field, tableau.gamma), t, x, f, h)
    # Each stage is behind a fence of its own. XLA would otherwise compute a stage again in every
    # later one that uses it, as in `explicit.step`.
    slopes: list[Components] = []
    for row in zip(tableau.c, tableau.drift, tableau.alpha, tableau.coupling, strict=True):
        slopes.append(field.once(ft.partial(_stage, field, row), start, slopes))
    end = field.once(ft.partial(_advanced, tableau.b), x, h, slopes)
    # Errors choose step lengths, which are constants in derivatives. The last coefficient is for
    # the slope at the end, which `error_estimate` adds.
    return end, field.once(lambda held: held, stop_gradient(_sum(tableau.d[:-1], slopes)))


def _linearised(
    field: SmoothField, gamma: float, t: Array, x: Components, f: Components, h: Array
) -> _Linearised:
    """J and ∂F/∂t at the start of a step, by automatic differentiation."""
    # Linearised once, for ∂F/∂t and for all columns of J.
    _, push = jax.linearize(field, t, x)
    one, zero = jnp.ones_like(t), jnp.zeros_like(t)
    drift = h * push(one, x.like(zero))
    if x.is_array:
        eye = jnp.eye(x.parts[0].shape[0], dtype=t.dtype)
        # The derivative along unit vector k is column k of J, hence the axis.
        columns = jax.vmap(lambda v: push(zero, Components([v])).parts[0], out_axes=1)(eye)
        matrix = eye - gamma * h * columns
        if len(eye) > _FEW:
            return _Linearised(t, x, f, h, jax.scipy.linalg.lu_factor(matrix), drift)
        rows = [list(scalars(row)) for row in matrix]
    else:
        units = range(len(x.parts))
        columns = [push(zero, Components(one if i == k else zero for i in units)) for k in units]
        rows = [
            [float(i == k) - gamma * h * column.parts[i] for k, column in enumerate(columns)]
            for i in units
        ]
    return _Linearised(t, x, f, h, factored(rows), drift)


def _sum(coefficients: Sequence[float], slopes: Sequence[Components]) -> Any:
    """Σ coefficients·slopes."""
    return sum(c * k for c, k in zip(coefficients, slopes, strict=True))


def _advanced(
    coefficients: Sequence[float], x: Components, h: Array, slopes: list[Components]
) -> Components:
    """x + h Σ coefficients·slopes."""
    return x + h * _sum(coefficients, slopes)


_Row = tuple[float, float, tuple[float, ...], tuple[float, ...]]
"""The coefficients of one stage: c_i, γ_i, and the rows of α and γ_ij/γ."""


def _stage(
    field: SmoothField, row: _Row, start: _Linearised, slopes: list[Components]
) -> Components:
    """The next k, from v = k + Σ coupling·slopes."""
    c, sum_, alpha, coupling = row
    if not slopes:
        # The first stage is at the start, whose field is known.
        return start.solve(start.f + sum_ * start.drift)
    slope = field(start.t + c * start.h, _advanced(alpha, start.x, start.h, slopes))
    known = _sum(coupling, slopes)
    return start.solve(slope + known + sum_ * start.drift) - known
