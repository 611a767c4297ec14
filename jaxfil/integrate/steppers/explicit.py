"""One smooth step of any explicit Runge–Kutta tableau, or of another method by its own file.

A step maps a field on components, a state and a length to the state at its end and an error
estimate. This file does not depend on surfaces.
"""

import dataclasses
import functools as ft
from collections.abc import Sequence
from typing import Any, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from jaxfil.integrate.steppers.adaptive import Adaptive
from jaxfil.integrate.steppers.rosenbrock import (
    RODAS5P,
    Rodas5P,
    RosenbrockTableau,
    rosenbrock_step,
)
from jaxfil.integrate.steppers.taylor import Taylor, TaylorTableau, error_at
from jaxfil.integrate.system.components import Components, Forcing, on_each
from jaxfil.integrate.system.smooth_field import Polynomial, SmoothField
from jaxfil.model.argument import told
from jaxfil.xla.select import select


class RK4(eqx.Module):
    """The classical Runge–Kutta method of order four, for wherever `stepper` is an argument.

    k₁ = f(t, x), k₂ = f(t + h/2, x + h k₁/2), k₃ = f(t + h/2, x + h k₂/2), k₄ = f(t + h, x + h k₃);
    x(t + h) = x + h (k₁ + 2k₂ + 2k₃ + k₄)/6. Its error estimate is crude: a step is halved only if
    it is grossly wrong, that is, unstable or not finite.

    **Source**: Kutta, Beitrag zur näherungsweisen Integration totaler Differentialgleichungen,
    Zeitschrift für Mathematik und Physik 46 (1901).

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> belt = jf.systems.BeltFriction()
    >>> sol = jf.solve(belt, jnp.zeros(2), 0.0, 1.0, 0.01, stepper=jf.RK4())
    >>> int(sol.num_events)
    3
    """

    c = np.array([0.5, 0.5, 1.0])
    a = (np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0]))
    b = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])
    # With the field at the end in place of k₄, the method has order three.
    d = np.array([0, 0, 0, 1 / 6, -1 / 6])


class ExplicitTableau(eqx.Module):
    """An explicit method without its first, trivial row: c (s−1,), a as s−1 rows, b (s,) and
    d (s + 1,). h Σ d·slopes, with the slope at the end of the step last, estimates the error of a
    step; d is empty for methods without a meaningful estimate."""

    c: tuple[float, ...] = eqx.field(static=True)
    a: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    b: tuple[float, ...] = eqx.field(static=True)
    d: tuple[float, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    crude: bool = eqx.field(static=True, default=False)
    """Whether the estimate is of such low order that it is as large as the change in a step from
    rest."""
    order: int = eqx.field(static=True, kw_only=True)
    tolerance: Adaptive | None = eqx.field(static=True, default=None)
    """The tolerance that chooses the step lengths; None for fixed lengths."""

    @property
    def stages(self) -> int:
        """Evaluations of the field per step, including the one at its start."""
        return len(self.b)

    @property
    def times(self) -> list[float]:
        """Times in a step, as fractions, at which the field is evaluated after its start."""
        # Stages at one time share its forcing. The end comes last, where the loop reads them.
        return [*sorted({*self.c} - {1.0}), 1.0]

    def forced(self, forcing: list[Forcing]) -> dict[float, Forcing]:
        """The forcing at each of `times`."""
        return dict(zip(self.times, forcing, strict=True))


Tableau: TypeAlias = ExplicitTableau | RosenbrockTableau | TaylorTableau
"""The coefficients of a stepper, as a step uses them."""
Method: TypeAlias = diffrax.AbstractERK | diffrax.Euler | RK4 | Rodas5P | Taylor
"""A one-step method, as the user chooses it."""
OWN_METHODS = {method.__name__: method for method in (RK4, Rodas5P, Taylor)}
"""The methods that are not diffrax's, by the names under which files and messages know them. A new
one has a case in `tableau_of`."""


class Controlled(eqx.Module):
    """A method whose step lengths follow a tolerance."""

    method: "Stepper"
    """The one-step method."""
    tolerance: Adaptive = eqx.field(static=True)
    """The tolerance that chooses the step lengths."""


Stepper: TypeAlias = Method | Controlled
"""A method, with or without a tolerance, as the loop receives it."""


class Trial(eqx.Module):
    """The end of a trial step."""

    x: Components
    """The state."""
    error: Components | None
    """The estimated error without the share of the field at the end; None without an estimate."""
    forcing: list[Forcing]
    """The forcing at the times within the step, the end last."""
    searched: Components | None = None
    """Surfaces whose guards are known to have no zero before the end, m flags; None if unknown for
    all."""
    path: Polynomial | None = None
    """The motion that the step is a part of, if it is a polynomial."""


# The lowest order of a diffrax method whose error estimate is used in fixed steps. One of lower
# order is as large as the change in a step from rest. Down to the second of these orders it is
# kept, marked as crude, as for `RK4`: its limits are such that only unstable steps are
# halved. Below, steps from rest would be halved by these limits too.
_TRUSTED, _CRUDE = 5, 3


def _floats(row: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in row)


_DEFAULT = diffrax.Dopri8()


def checked_stepper(stepper: Stepper | None) -> Stepper:
    """The requested stepper, `diffrax.Dopri8()` for None, if `tableau_of` supports it."""
    stepper = _DEFAULT if stepper is None else stepper
    _refuse_others(stepper)
    return stepper


def has_known_name(stepper: Stepper) -> bool:
    """Whether a file can tell a stepper by the name of its class."""
    cls = type(stepper.method if isinstance(stepper, Controlled) else stepper)
    return cls in (OWN_METHODS.get(cls.__name__), getattr(diffrax, cls.__name__, None))


def controlled(tolerance: Adaptive, stepper: Any) -> Controlled:
    """The requested stepper, checked, with a tolerance."""
    method = checked_stepper(stepper)
    asked = Controlled(method, tolerance)
    # The limits of a crude estimate detect unstable steps alone (`error_estimate`).
    if (tableau := tableau_of(asked)).crude or not tableau.d:
        raise ValueError(
            "`stepper` must have an error estimate that is more than a test for instability if "
            "steps follow a tolerance, as diffrax.Dopri8(), Tsit5(), Bosh3() and jaxfil.Rodas5P() "
            "have; got "
            f"{told(stepper)}."
        )
    return asked


def checked_steppers(name: str, steppers: Any) -> tuple[Stepper, ...]:
    """The steppers of a list, at least one."""
    if not isinstance(steppers, (list, tuple)) or not steppers:
        raise ValueError(
            f"`{name}` must be a list of steppers, at least one, got {told(steppers)}."
        )
    for number, stepper in enumerate(steppers):
        _refuse_others(stepper, f"{name}[{number}]")
    return tuple(steppers)


def _refuse_others(stepper: Any, name: str = "stepper") -> None:
    """Raises an error for an object that is not a stepper supported by `tableau_of`."""
    if isinstance(stepper, type):
        raise ValueError(f"`{name}` must be an instance, got the class {stepper.__name__}.")
    tableau = getattr(stepper, "tableau", None)
    explicit = isinstance(tableau, diffrax.ButcherTableau) and not tableau.implicit
    if isinstance(stepper, Controlled):
        return
    if isinstance(stepper, Adaptive):
        raise ValueError(
            f"`{name}` must be a method; a tolerance takes the place of the step, as `dt` or "
            f"`steps`; got {told(stepper)}."
        )
    if not explicit and not isinstance(stepper, (*OWN_METHODS.values(), diffrax.Euler)):
        raise ValueError(
            f"`{name}` must be {', '.join(f'jaxfil.{own}()' for own in OWN_METHODS)} or an "
            "instance of an explicit diffrax Runge–Kutta solver such as diffrax.Dopri8(), got "
            f"{told(stepper)}."
        )
    kind = getattr(stepper, "scan_kind", None)
    if kind is not None:
        raise ValueError(
            f"`{name}.scan_kind` must be None, since stages are written out; got {kind!r}."
        )


def tableau_of(stepper: Stepper) -> Tableau:
    """The tableau of an explicit diffrax solver, of one of `OWN_METHODS`, or of either with a
    tolerance."""
    _refuse_others(stepper)
    if isinstance(stepper, Controlled):
        # A tolerance uses estimates of any order.
        own, tolerance = _tableau(stepper.method, least=1), stepper.tolerance
        # Files store the name of a tableau, from which the tolerance is read back.
        return dataclasses.replace(own, tolerance=tolerance, name=f"{own.name}, {tolerance!r}")
    return _tableau(stepper, _TRUSTED)


def _tableau(stepper: Any, least: int) -> Tableau:
    """The tableau of a method, with the error estimate of a diffrax method of `least` order."""
    name = type(stepper).__name__
    if isinstance(stepper, RK4):
        a = tuple(map(_floats, RK4.a))
        c, b, d = _floats(RK4.c), _floats(RK4.b), _floats(RK4.d)
        return ExplicitTableau(c, a, b, d, name, crude=True, order=4)
    if isinstance(stepper, Rodas5P):
        return RODAS5P
    if isinstance(stepper, Taylor):
        return TaylorTableau(stepper.order, f"{name}({stepper.order})")
    if isinstance(stepper, diffrax.Euler):
        return ExplicitTableau((), (), (1.0,), (), name, order=1)
    # The order of an explicit diffrax solver does not depend on its argument.
    given, order = stepper.tableau, stepper.order(None)  # pyright: ignore[reportArgumentType]
    assert isinstance(given, diffrax.ButcherTableau) and order is not None
    c, a, b = _floats(given.c), tuple(map(_floats, given.a_lower)), _floats(given.b_sol)
    crude = _CRUDE <= order < least
    d = _floats(given.b_error) if order >= least or crude else ()
    if given.fsal:  # the last stage is the field at the end, which the loop evaluates anyway
        c, a, b = c[:-1], a[:-1], b[:-1]
    elif d:
        # The estimate has no share of the field at the end.
        d = (*d, 0.0)
    return ExplicitTableau(c, a, b, d, name, crude=crude, order=order)


def _combined(x: Components, h: Array, coefficients: Sequence[float], slopes: list) -> Components:
    """x + h Σ coefficients·slopes."""
    return x + h * weighted(coefficients, slopes)


def weighted(coefficients: Sequence[float], slopes: Sequence[Components]) -> Any:
    """Σ coefficients·slopes, skipping the zeros of the tableau."""
    out: Any = 0.0
    for c, slope in zip(coefficients, slopes, strict=True):
        if c != 0:
            out = c * slope + out
    return out


def _stage(
    field: SmoothField, c: float, t: Array, h: Array, inner: Components, forcing: Forcing
) -> Components:
    return field(t + c * h, inner, forcing)


def step(
    tableau: Tableau,
    field: SmoothField,
    t: Array,
    x: Components,
    f: Components,
    h: Array,
    forcing: list[Forcing],
) -> Trial:
    """A step of length h from (t, x), with the field `f` there; `forcing` is the value of
    `ComponentSystem.forcing` for `tableau.times`."""
    if isinstance(tableau, RosenbrockTableau):
        return Trial(*rosenbrock_step(tableau, field, t, x, f, h), forcing)
    if isinstance(tableau, TaylorTableau):
        known = field.polynomial(tableau.order, t, x, h)
        return trial_of(tableau, known, jnp.ones_like(h), forcing)
    slopes = [f]
    known = tableau.forced(forcing)
    for c, row in zip(tableau.c, tableau.a, strict=True):
        inner = _combined(x, h, row, slopes)
        # Without `once`, XLA recomputes each stage inside every later one that uses it (see
        # `ComponentSystem`).
        slopes.append(field.once(ft.partial(_stage, field, c), t, h, inner, known[c]))
    end, error = _combined(x, h, tableau.b, slopes), None
    if tableau.d:
        # Errors choose step lengths, which are constants in derivatives.
        error = stop_gradient(weighted(tableau.d[:-1], slopes))
    # The end has many users, in each of which XLA would compute it again.
    end, error = field.once(lambda held: held, (end, error))
    return Trial(end, error, forcing)


def trial_of(tableau: TaylorTableau, known: Polynomial, s: Array, forcing: list[Forcing]) -> Trial:
    """The end of a step at a fraction s of a known polynomial."""
    return Trial(known.at(s), error_at(tableau, known, s), forcing, path=known)


def _column(v: Any, rows: Array) -> Any:
    """One number for each row, reshaped to broadcast against the rows."""
    return v.reshape(-1, *(1,) * (rows.ndim - 1))


def _sum_of_rows(weights: Any, slopes: Components) -> Components:
    """Σ weights·rows. A matrix product is a library call in XLA, which would end the kernel."""
    return on_each(lambda rows: jnp.sum(_column(weights, rows) * rows, axis=0), slopes)


def compact_step(
    tableau: Tableau,
    field: SmoothField,
    t: Array,
    x: Components,
    f: Components,
    h: Array,
    forcing: list[Forcing],
) -> Trial:
    """`step` with its stages in a loop. The program is about as small as one evaluation of the
    field, for large fields and few steps."""
    if not isinstance(tableau, ExplicitTableau):
        return step(tableau, field, t, x, f, h, forcing)
    stages = tableau.stages
    times, rows = np.zeros(stages), np.zeros((stages, stages))
    # Coefficients as square arrays, so that a loop can select its row. Row 0 is not used.
    for k, (c, row) in enumerate(zip(tableau.c, tableau.a, strict=True), start=1):
        times[k], rows[k, : len(row)] = c, row
    # In the precision of the run, since an array of NumPy in float64 would promote float32.
    times, rows = times.astype(h.dtype), rows.astype(h.dtype)
    number = jnp.arange(stages)
    known = tableau.forced(forcing)
    forced = list(map(jnp.stack, zip(*(known[c] for c in tableau.c), strict=True)))

    def put(k: Any, rows: Array, v: Array) -> Array:
        return select(_column(number == k, rows), v, rows)

    def stage(k: Array, slopes: Components) -> Components:
        row, time = (jax.lax.dynamic_index_in_dim(v, k, keepdims=False) for v in (rows, times))
        # Stage 0 is the field at the start, which is given, so `forced` begins with stage 1.
        own = [jax.lax.dynamic_index_in_dim(v, k - 1, keepdims=False) for v in forced]
        new = field(t + time * h, x + h * _sum_of_rows(row, slopes), own)
        return on_each(ft.partial(put, k), slopes, new)

    # Slopes that are not yet computed are zero, so that each stage can sum over all rows.
    first = on_each(lambda v: select(_column(number == 0, v[None]), v, 0.0), f)
    slopes = jax.lax.fori_loop(1, stages, stage, first)
    end = x + h * _sum_of_rows(np.asarray(tableau.b, h.dtype), slopes)
    if not tableau.d:
        return Trial(end, None, forcing)
    d = np.asarray(tableau.d[:-1], h.dtype)
    return Trial(end, stop_gradient(_sum_of_rows(d, slopes)), forcing)
