"""The phase plane of a planar system: fields, nullclines, surfaces, equilibria and separatrices."""

from collections.abc import Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.axes import Axes

from jaxfil.equilibria.equilibrium import Equilibrium
from jaxfil.equilibria.plane_equilibria import equilibria_in
from jaxfil.equilibria.search import autonomous
from jaxfil.equilibria.tangency_points import FieldTangency, Limits, tangency_points, window_of
from jaxfil.integrate.run.solution import Solution
from jaxfil.integrate.run.solve import solve
from jaxfil.integrate.steppers.explicit import RK4
from jaxfil.integrate.surfaces.corners import every_side
from jaxfil.model import check
from jaxfil.model.labels import labels_of
from jaxfil.model.parameter import cast
from jaxfil.model.section import bound
from jaxfil.model.system import System, field_of
from jaxfil.plot.canvas import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    PURPLE,
    SKY,
    VERMILLION,
    WHITE,
    name_components,
    own_axes,
    styled,
)
from jaxfil.plot.legend import legend_outside
from jaxfil.plot.path import lanes, path
from jaxfil.plot.sliding_region import Plane, draw_surface
from jaxfil.xla.known import array_of

# Points along each edge for nullclines, and arrows.
_GRID, _ARROWS = 201, 17
# Distance of the start of a separatrix from an equilibrium or a tangency, as a fraction of the
# window; its number of steps, and its length in the slowest time of the equilibrium, or in times of
# the motion through the window.
_OFF, _STEPS, _TIMES = 1e-5, 2000, 25.0
# A separatrix ends at this distance outside, in half windows; the power makes that smooth.
_OUTSIDE, _POWER = 1.3, 8
# The style of each separatrix.
_UNSTABLE = {"color": VERMILLION, "linewidth": 1.4, "label": "unstable manifold"}
_STABLE = {"color": BLUE, "linewidth": 1.4, "label": "stable manifold"}
_TANGENT = {"color": GREEN, "linewidth": 1.0, "label": "through a visible tangency"}


def phase_plane(system: System, limits: Limits, ax: Axes | None = None, **style: Any) -> Axes:
    """Draw the phase plane of an autonomous planar system.

    The picture shows the field as arrows of one length; nullclines, on which one component of the
    field of the side is zero; each surface with its attracting, repelling and crossed parts;
    tangency points and two-folds; equilibria and pseudo-equilibria that Newton's method finds from
    a grid of guesses; the stable and unstable manifolds of saddles and pseudo-saddles, and the
    orbits through visible tangencies. A manifold ends where it leaves the window, comes to rest, or
    is no longer unique, as at an attracting slide in backward time.

    **Arguments**

    - `system`: the `System`, of two components and at most four surfaces, without a period, clocks
      and resets; taken at t = 0.
    - `limits`: limits of the axes, ((left, right), (bottom, top)).
    - `ax`: the axes to draw on; by default new ones.
    - `style`: matplotlib's keywords of the separatrices, as `lw`.

    **Returns** the matplotlib axes.

    **Source**: Yu. Kuznetsov, S. Rinaldi and A. Gragnani, One-parameter bifurcations in planar
    Filippov systems, Int. J. Bifurcation and Chaos 13 (2003), § 2.

    >>> import jaxfil as jf
    >>> belt = jf.systems.SlipStick()
    >>> ax = jf.plot.phase_plane(belt, ((-2, 2), (-2, 1)), jf.plot.page().add_subplot())
    >>> "visible tangency" in [text.get_text() for text in ax.get_legend().get_texts()]
    True
    """
    check.system("system", system)
    autonomous("system", system)
    window = window_of("limits", limits)
    if system.resets:
        raise ValueError(
            f"`system` must have no `reset`: {type(system).__name__} has impacts, and its motions "
            "jump in the plane."
        )
    system = cast(system, float)
    middle = array_of(window.mean(axis=1))
    shape = check.shapes(system, middle)
    m = 1 if shape == () else shape[0]
    found = equilibria_in(system, window, m)
    tangencies = tangency_points(system, limits) if m else []
    ax = own_axes(ax)
    speed = _draw_fields(ax, system, window, m)
    for j in range(m):
        where = Plane(system, jnp.zeros(()), middle, (0, 1), j)
        draw_surface(ax, where, tuple(map(tuple, window)), {})
    starts = [*_from_saddles(system, window, found)]
    starts += _from_tangencies(system, window, tangencies, speed)
    _draw_separatrices(ax, system, window, starts, style)
    for point in tangencies:
        _draw_tangency(ax, point)
    for one in found:
        _draw_equilibrium(ax, one)
    ax.set_xlim(*window[0])
    ax.set_ylim(*window[1])
    labels = labels_of(system, 2)
    name_components(ax, labels, (0, 1))
    legend_outside(ax)
    return ax


@eqx.filter_jit
def _fields(system: System, points: Array) -> tuple[Array, Array]:
    """The sides at points (k, 2), (k, m), and F on every combination of sides, (k, 2^m, 2)."""
    t = jnp.zeros(())

    def at(x: Array) -> tuple[Array, Array]:
        h = system.switching(t, x)
        m = jnp.size(h)
        every = every_side(m)
        rows = every if jnp.ndim(h) else every[:, 0]
        fields = jax.vmap(lambda side: field_of(system, t, x, side))(jnp.asarray(rows))
        return jnp.where(jnp.atleast_1d(h) < 0, -1.0, 1.0), fields

    return jax.vmap(at)(points)


def _on_grid(
    system: System, axes: list[np.ndarray], m: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a grid, the fields there, each NaN off its own sides, and the actual field."""
    points = np.stack(np.meshgrid(*axes), axis=-1)
    sides, fields = map(np.asarray, _fields(system, array_of(points.reshape(-1, 2))))
    every = every_side(m)
    holds = np.all(sides[:, None] == every, axis=-1)
    own = np.where(holds[..., None], fields, np.nan)
    shape = points.shape[:2]
    alone = np.nansum(own, axis=1).reshape(*shape, 2)
    return points, own.reshape(*shape, -1, 2), alone


def _draw_fields(ax: Axes, system: System, window: np.ndarray, m: int) -> float:
    """Draw directions of the field, and nullclines; returns the typical speed of a motion, in
    windows."""
    axes = [np.linspace(low, high, 2 * _ARROWS + 1)[1::2] for low, high in window]
    points, _, field = _on_grid(system, axes, m)
    # Of one length on the page; the axes have different units.
    field = field / np.ptp(window, axis=1)
    size = np.linalg.norm(field, axis=-1, keepdims=True)
    field /= np.maximum(size, 1e-300)
    arrows = {"angles": "uv", "scale": 1.5 * _ARROWS, "width": 0.002, "pivot": "mid"}
    ax.quiver(*points.reshape(-1, 2).T, *field.reshape(-1, 2).T, color=GREY, **arrows)
    axes = [np.linspace(low, high, _GRID) for low, high in window]
    _, fields, _ = _on_grid(system, axes, m)
    for component, (color, line) in enumerate(((PURPLE, ":"), (SKY, "-."))):
        drawn = False
        for row in range(fields.shape[2]):
            values = fields[:, :, row, component]
            real = values[np.isfinite(values)]
            if real.size and real.min() < 0 < real.max():
                ax.contour(*axes, values, [0.0], colors=color, linestyles=line, linewidths=1.2)
                drawn = True
        if drawn:
            name = labels_of(system, 2).state
            told = name[component] if name else f"x[{component}]"
            ax.plot([], [], line, color=color, linewidth=1.2, label=f"d({told})/dt = 0")
    return float(np.median(size))


# The start of a separatrix, its time, negative for backward, and its style.
_Start = tuple[np.ndarray, float, dict[str, Any]]


def _from_saddles(system: System, window: np.ndarray, found: list[Equilibrium]) -> Iterator[_Start]:
    """The starts of the stable and unstable manifolds of saddles."""
    off = _OFF * float(np.linalg.norm(np.ptp(window, axis=1)))
    for one in found:
        x, values = np.asarray(one.x), np.asarray(one.eigenvalues)
        # A saddle has one stable and one unstable direction, with a rate that may be infinite.
        real = np.real(values)
        if np.any(np.imag(values)) or not real[0] > 0 > real[1]:
            continue
        slow = float(np.min(abs(real)))
        own, vectors = np.linalg.eig(np.asarray(one.jacobian))
        for value in real:
            told, way = (_UNSTABLE, 1.0) if value > 0 else (_STABLE, -1.0)
            if np.isfinite(value):
                vector = np.real(vectors[:, np.argmin(abs(own - value))])
                ahead = [vector, -vector]
            else:
                ahead = [way * v for v in _beside(system, one)]
            for v in ahead:
                yield x + off * v / np.linalg.norm(v), way * _TIMES / slow, told


def _from_tangencies(
    system: System, window: np.ndarray, points: list[FieldTangency], speed: float
) -> Iterator[_Start]:
    """The starts of the orbits through visible tangencies, on either side."""
    off = _OFF * float(np.linalg.norm(np.ptp(window, axis=1)))
    for point in points:
        for side in point.visible:
            field = _on_side(system, point.x, point.surface, side)
            step = off / np.linalg.norm(field)
            # To first order it stays on a flat surface, without a side.
            bend = 0.5 * step**2 * _turn(system, point.x, point.surface, side, field)
            for way in (1.0, -1.0):
                yield point.x + way * step * field + bend, way * _TIMES / speed, _TANGENT


def _beside(system: System, one: Equilibrium) -> list[np.ndarray]:
    """The fields on both sides of the surface that a pseudo-equilibrium is on."""
    (j,) = np.flatnonzero(np.asarray(one.mode) == 0)
    return [_on_side(system, np.asarray(one.x), int(j), side) for side in (1, -1)]


def _on_side(system: System, x: np.ndarray, surface: int, side: int) -> np.ndarray:
    plane = Plane(system, jnp.zeros(()), array_of(x), (0, 1), surface)
    return np.asarray(plane.force(array_of(x), float(side)))


def _turn(system: System, x: np.ndarray, surface: int, side: int, field: np.ndarray) -> np.ndarray:
    """The second derivative of the motion on a side."""
    plane = Plane(system, jnp.zeros(()), array_of(x), (0, 1), surface)
    force = lambda x: plane.force(x, float(side))  # noqa: E731
    return np.asarray(jax.jvp(force, (array_of(x),), (array_of(field),))[1])


def _draw_separatrices(
    ax: Axes,
    system: System,
    window: np.ndarray,
    starts: list[_Start],
    style: dict[str, Any],
) -> None:
    """Draw all separatrices, computed in one batch."""
    if not starts:
        return
    middle, half = window.mean(axis=1), 0.5 * np.ptp(window, axis=1)

    def room(t: Array, x: Array) -> Array:
        return _OUTSIDE**_POWER - jnp.sum(((x - middle) / half) ** _POWER)

    # Padded to a power of two, so that few programs are compiled.
    rows = np.resize(np.arange(len(starts)), 1 << (len(starts) - 1).bit_length())
    x0, spans = array_of(np.array([starts[i][0] for i in rows])), [starts[i][1] for i in rows]
    sol = _followed(system, x0, array_of(np.array(spans)), bound(room))
    for one, (_, _, told) in zip(lanes(sol), starts, strict=False):
        # A motion that is not unique from its start has no path.
        if np.isfinite(np.asarray(one.ts)).sum() > 1:
            ax.plot(*path(one)[1].T, **styled(style, **told))


@eqx.filter_jit
def _followed(system: System, x0: Array, spans: Array, room: Any) -> Solution:
    def one(x0: Array, span: Array) -> Solution:
        return solve(
            system,
            x0,
            0.0,
            span,
            abs(span) / _STEPS,
            stepper=RK4(),
            saveat=diffrax.SaveAt(t0=True, steps=True),
            max_steps=2 * _STEPS,
            max_events=64,
            sections=room,
            throw=False,
        )

    return eqx.filter_vmap(one)(x0, spans)


def _draw_tangency(ax: Axes, point: FieldTangency) -> None:
    """Draw a tangency, filled if visible, otherwise hollow; two-folds as diamonds."""
    marker = "D" if point.side == 0 else "v"
    face = {"visible": BLACK, "invisible": WHITE}.get(point.kind.split(" ")[0], GREY)
    told = point.kind if point.side == 0 else f"{point.kind} tangency"
    ax.plot(*point.x, marker, color=face, markeredgecolor=BLACK, zorder=4, label=told)


def _draw_equilibrium(ax: Axes, one: Equilibrium) -> None:
    """Draw an equilibrium, filled if stable, a cross for a saddle; pseudo-equilibria as squares."""
    values = np.real(np.asarray(one.eigenvalues))
    saddle = values[0] > 0 > values[1]
    face = BLACK if bool(one.stable) else WHITE
    pseudo = one.kind == "pseudo"
    word = "saddle" if saddle else ("stable" if bool(one.stable) else "unstable")
    prefix = "pseudo-" if pseudo else ""
    told = f"{prefix}saddle" if saddle else f"{word} {prefix}equilibrium"
    marker = ("X" if saddle else "s") if pseudo else ("P" if saddle else "o")
    ax.plot(*np.asarray(one.x), marker, color=face, markeredgecolor=BLACK, zorder=5, label=told)
