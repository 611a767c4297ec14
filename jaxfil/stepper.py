"""One smooth step: any explicit Runge–Kutta tableau, or a linearly implicit one for stiff fields.

A field on components, a state and a step length enter; the state at the end of the step leaves.
Nothing here knows of surfaces.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import numpy as np
from jaxtyping import Array

from jaxfil.rosenbrock import RODAS5P, Rodas5P, RosenbrockTable, rosenbrock_step
from jaxfil.scene import Blocks


class RK4(eqx.Module):
    """The classical Runge–Kutta method of order four."""

    c = np.array([0.5, 0.5, 1.0])
    a = (np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0]))
    b = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])


class ExplicitTable(eqx.Module):
    """c (s−1,), a as s−1 rows, b (s,): the explicit method without its first, trivial row."""

    c: tuple[float, ...] = eqx.field(static=True)
    a: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    b: tuple[float, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @property
    def stages(self) -> int:
        """Evaluations of the field per step, the one at its start included."""
        return len(self.b)


Tableau = ExplicitTable | RosenbrockTable
"""What a step needs to know of a stepper."""


def _floats(row: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in row)


def tableau(stepper: Any) -> Tableau:
    """The tableau of a diffrax solver instance, of `RK4()` or of `Rodas5P()`."""
    name = type(stepper).__name__
    if isinstance(stepper, type):
        raise ValueError(f"`stepper` must be an instance, got the class {stepper.__name__}.")
    if isinstance(stepper, RK4):
        return ExplicitTable(_floats(RK4.c), tuple(map(_floats, RK4.a)), _floats(RK4.b), name)
    if isinstance(stepper, Rodas5P):
        return RODAS5P
    if isinstance(stepper, diffrax.Euler):
        return ExplicitTable((), (), (1.0,), name)
    table = getattr(stepper, "tableau", None)
    if not isinstance(table, diffrax.ButcherTableau) or table.implicit:
        raise ValueError(
            "`stepper` must be jaxfil.RK4(), jaxfil.Rodas5P() or an instance of an explicit "
            f"diffrax Runge–Kutta solver such as diffrax.Dopri8(), got {stepper!r}."
        )
    c, a, b = _floats(table.c), tuple(map(_floats, table.a_lower)), _floats(table.b_sol)
    if table.fsal:  # the last stage is the field at the end, which the loop evaluates anyway
        c, a, b = c[:-1], a[:-1], b[:-1]
    return ExplicitTable(c, a, b, name)


def _combine(x: Blocks, h: Array, coefficients: tuple[float, ...], slopes: list[Blocks]) -> Blocks:
    """x + h Σ coefficients·slopes, skipping the zeros of the tableau."""
    terms = [(c, k) for c, k in zip(coefficients, slopes, strict=True) if c != 0]
    out = []
    for i, x_i in enumerate(x):
        total: Any = 0.0
        for c, k in terms:
            total = c * k[i] + total
        out.append(x_i + h * total)
    return tuple(out)


def _stage(field: Callable, c: float, t: Array, h: Array, inner: Blocks) -> Blocks:
    return field(t + c * h, inner)


def step(
    table: Tableau,
    field: Callable[[Array, Blocks], Blocks],
    t: Array,
    x: Blocks,
    f: Blocks,
    h: Array,
    once: Callable[..., Blocks],
) -> Blocks:
    """The state at t + h. `f` is the field at (t, x), `once` is `Scene.once`: without it each stage
    would be computed again inside every later stage that uses it."""
    if isinstance(table, RosenbrockTable):
        return rosenbrock_step(table, field, t, x, f, h, once)
    slopes = [f]
    for c, row in zip(table.c, table.a, strict=True):
        inner = _combine(x, h, row, slopes)
        slopes.append(once(ft.partial(_stage, field, c), t, h, inner))
    return once(lambda *end: end, *_combine(x, h, table.b, slopes))
