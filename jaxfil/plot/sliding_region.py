"""A surface in the plane, with its attracting, repelling and crossed parts."""

from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.model.labels import labels_of
from jaxfil.model.system import System, field_of
from jaxfil.plot.canvas import BLACK, BLUE, GREY, ORANGE, PURPLE, own_axes, styled
from jaxfil.plot.legend import legend
from jaxfil.plot.path import chosen
from jaxfil.xla.known import array_of

# The style of each part of a surface.
_PARTS = {
    "crossing": {"color": BLACK, "linewidth": 1.0},
    "attracting sliding": {"color": ORANGE, "linewidth": 3.5},
    "repelling sliding": {"color": PURPLE, "linewidth": 3.5},
}
# Points along each edge at which H is evaluated, and arrows along each edge.
_GRID, _ARROWS = 201, 16


def sliding_region(
    system: System,
    limits: tuple[tuple[float, float], tuple[float, float]],
    ax: Axes | None = None,
    t: float = 0.0,
    at: Float[ArrayLike, " n"] | tuple[float, ...] = (0.0, 0.0),
    components: Iterable[int] = (0, 1),
    surface: int = 0,
    **style: Any,
) -> Axes:
    r"""Draw the two fields of a surface, and the parts into which they divide it.

    With $\dot H_\pm = \partial_t H + \nabla H \cdot F_\pm$ the surface is crossed where both have
    one sign, attracts where $\dot H_+ < 0 < \dot H_-$ and repels where $\dot H_- < 0 < \dot H_+$.
    Arrows of one length show the direction of the field of their side. A dot is a tangency, where a
    part ends.

    **Arguments**

    - `system`: the `System`.
    - `limits`: limits of the axes, ((left, right), (bottom, top)).
    - `ax`: the axes to draw on; by default new ones.
    - `t`: the time of fields and surface.
    - `at`: the state through which the plane is laid, shape (n,).
    - `components`: the numbers of the two components of the plane, horizontal first.
    - `surface`: the number of the surface, from 0. The state determines the sides of the others.
    - `style`: matplotlib's keywords of the surface's lines, as `lw`.

    **Returns** the matplotlib axes.

    **Source**: A. F. Filippov, Differential Equations with Discontinuous Righthand Sides (1988),
    §4.

    >>> import jaxfil as jf
    >>> belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0)
    >>> ax = jf.plot.sliding_region(belt, ((-3, 3), (-1, 3)), jf.plot.page().add_subplot())
    >>> sorted(text.get_text() for text in ax.get_legend().get_texts())
    ['attracting sliding', 'crossing', 'tangency']
    """
    check.system("system", system)
    state = jnp.asarray(at, float)
    shown = chosen("components", components, state.size, (2,))
    time = jnp.asarray(t, float)
    check.component("surface", surface, jnp.atleast_1d(system.switching(time, state)).size)
    where = Plane(system, time, state, tuple(shown), surface)
    ax = own_axes(ax)
    _arrows(ax, where, limits)
    ends = draw_surface(ax, where, limits, style)
    if ends.size:
        ax.plot(*ends.T, "o", color=BLACK, zorder=3, label="tangency")
    ax.set_xlim(*limits[0])
    ax.set_ylim(*limits[1])
    labels = labels_of(system, state.size)
    ax.set_xlabel(labels.component(shown[0]))
    ax.set_ylabel(labels.component(shown[1]))
    legend(ax)
    return ax


class Plane(eqx.Module):
    """A plane of two components through a state, and one surface's H and fields on it."""

    system: System
    t: Array
    state: Array
    shown: tuple[int, ...] = eqx.field(static=True)
    surface: int = eqx.field(static=True)

    def h(self, t: Array, x: Array) -> Array:
        """H of the surface, ()."""
        return jnp.atleast_1d(self.system.switching(t, x))[self.surface]

    def force(self, x: Array, side: Array | float) -> Array:
        """F on that side of the surface, (n,)."""
        h = self.system.switching(self.t, x)
        sides = jnp.where(jnp.atleast_1d(h) < 0, -1.0, 1.0).at[self.surface].set(side)
        return field_of(self.system, self.t, x, sides[0] if jnp.ndim(h) == 0 else sides)

    def height(self, points: np.ndarray) -> np.ndarray:
        """H at points (…, 2)."""
        return _mapped(self, _height, points)

    def field(self, points: np.ndarray) -> np.ndarray:
        """The two components of the actual field at points (…, 2)."""
        return _mapped(self, _field, points)

    def rates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """dH/dt along the fields of the positive and of the negative side."""
        return _mapped(self, _rates, points)


def _height(plane: Plane, x: Array) -> Array:
    return plane.h(plane.t, x)


def _field(plane: Plane, x: Array) -> Array:
    side = jnp.where(plane.h(plane.t, x) < 0, -1.0, 1.0)
    return plane.force(x, side)[jnp.array(plane.shown)]


def _rates(plane: Plane, x: Array) -> tuple[Array, ...]:
    return tuple(
        jax.jvp(plane.h, (plane.t, x), (jnp.ones_like(plane.t), plane.force(x, side)))[1]
        for side in (1.0, -1.0)
    )


def _mapped(plane: Plane, function: Callable, points: np.ndarray) -> Any:
    """A function of the states of points (…, 2) of a plane."""
    flat = _on_states(plane, function, array_of(points.reshape(-1, 2)))
    return jax.tree.map(lambda a: np.asarray(a).reshape(*points.shape[:-1], *a.shape[1:]), flat)


@eqx.filter_jit
def _on_states(plane: Plane, function: Callable, points: Array) -> Any:
    def at(point: Array) -> Any:
        return function(plane, plane.state.at[jnp.array(plane.shown)].set(point))

    return jax.vmap(at)(jnp.asarray(points, plane.state.dtype))


def _arrows(ax: Axes, where: Plane, limits: tuple[tuple[float, float], ...]) -> None:
    """Draw the directions of the fields, each on its own side."""
    middles = [np.linspace(*ends, 2 * _ARROWS + 1)[1::2] for ends in limits]
    points = np.stack(np.meshgrid(*middles), axis=-1)
    # Of one length on the page; the axes have different units.
    size = np.array([ends[1] - ends[0] for ends in limits])
    field = where.field(points) / size
    field /= np.maximum(np.linalg.norm(field, axis=-1, keepdims=True), 1e-300)
    sides = where.height(points) >= 0
    for side, color in ((True, BLUE), (False, GREY)):
        keep = sides == side
        ax.quiver(
            *points[keep].T,
            *field[keep].T,
            color=color,
            angles="uv",
            scale=1.4 * _ARROWS,
            width=0.0025,
            pivot="mid",
        )


def draw_surface(
    ax: Axes, where: Plane, limits: tuple[tuple[float, float], ...], style: dict[str, Any]
) -> np.ndarray:
    """Draw the parts of a surface within limits; returns the points between them, (k, 2)."""
    x, y = (np.linspace(*ends, _GRID) for ends in limits)
    heights = where.height(np.stack(np.meshgrid(x, y), axis=-1))
    # Only its path is used; its parts are drawn separately.
    line = ax.contour(x, y, heights, levels=[0.0], linewidths=0)
    pieces = line.get_paths()[0].to_polygons(closed_only=False)
    line.remove()
    return np.concatenate(
        [np.zeros((0, 2)), *(_draw_parts(ax, where, np.asarray(v), style) for v in pieces)]
    )


def _draw_parts(ax: Axes, where: Plane, piece: np.ndarray, style: dict[str, Any]) -> np.ndarray:
    """One connected piece of the surface, (k, 2), cut at its tangencies, which are returned."""
    fine = _refined(piece)
    plus, minus = where.rates(fine)
    kind = np.where(plus * minus > 0, 0, np.where(plus < minus, 1, 2))
    edges = np.flatnonzero(np.diff(kind)) + 1
    for start, end in zip([0, *edges], [*edges, len(kind)], strict=True):
        name = list(_PARTS)[kind[start]]
        x, y = fine[start : end + 1].T
        ax.plot(x, y, **styled(style, label=name, solid_capstyle="butt", **_PARTS[name]))
    return fine[edges]


def _refined(piece: np.ndarray, points: int = 2001) -> np.ndarray:
    """Points (points, 2) evenly spaced along a polygon."""
    length = np.append(0, np.cumsum(np.linalg.norm(np.diff(piece, axis=0), axis=1)))
    s = np.linspace(0, length[-1], points)
    return np.stack([np.interp(s, length, column) for column in piece.T], axis=1)
