"""An animation of a motion, with its contacts as they happen."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.artist import Artist
from matplotlib.axes import Axes

from jaxfil.integrate.run.solution import Solution
from jaxfil.model import check
from jaxfil.model.outcomes import EventKind
from jaxfil.model.system import System
from jaxfil.plot.canvas import BLACK, GREY, own_axes
from jaxfil.plot.legend import legend
from jaxfil.plot.path import MARKERS, chosen, contacts, one_lane, path
from jaxfil.plot.surfaces import draw_surfaces


def animation(
    sol: Solution,
    ax: Axes | None = None,
    system: System | None = None,
    components: Iterable[int] = (0, 1),
    frames: int = 200,
    interval: float = 40.0,
) -> FuncAnimation:
    """Move a point along a motion in the plane of two components.

    The path is drawn behind the point, and each contact is marked by its kind once it has happened.
    Frames are evenly spaced in time; between saved states the point moves on straight lines.

    **Arguments**

    - `sol`: a `Solution` of one lane with two saved times or more.
    - `ax`: the axes to draw on; by default new ones.
    - `system`: the `System` whose surfaces are drawn; None to omit them.
    - `components`: the two components, horizontal first.
    - `frames`: number of frames, two or more.
    - `interval`: time of each frame in milliseconds.

    **Returns** a `matplotlib.animation.FuncAnimation`: keep it, `save` it to a file, or show
    `to_jshtml()` in a notebook.

    >>> import diffrax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system, x0 = jf.systems.CoulombOscillator(), jnp.array([3.0, 0.0])
    >>> saveat = diffrax.SaveAt(t0=True, steps=True)
    >>> sol = jf.solve(system, x0, 0.0, 14.0, 0.1, stepper=jf.RK4(), saveat=saveat)
    >>> page = jf.plot.page(84)
    >>> moving = jf.plot.animation(sol, page.add_subplot(), system=system, frames=3)
    >>> "<img" in moving.to_jshtml()
    True
    """
    check.instance("sol", sol, Solution)
    if system is not None:
        check.system("system", system)
    one_lane(sol)
    if not isinstance(frames, (int, np.integer)) or frames < 2:
        raise ValueError(f"`frames` must be an integer of 2 or more, got {frames!r}.")
    shown = chosen("components", components, sol.x_final.shape[-1], (2,))
    ts, xs = path(sol)
    met, xs = contacts(sol), xs[:, shown]
    ax = own_axes(ax)
    ax.plot(*xs.T, color=GREY, linewidth=0.5, alpha=0.5)
    (trail,) = ax.plot([], [], color=BLACK, linewidth=1)
    kinds = [EventKind(k) for k in np.unique(met.kinds)]
    marks = {}
    for kind in kinds:
        marker, color = MARKERS[kind]
        style: dict[str, Any] = {"color": color, "markeredgecolor": BLACK, "label": kind.name}
        (marks[kind],) = ax.plot([], [], marker, **style)
    (point,) = ax.plot([], [], "o", color=BLACK)
    clock = ax.set_title("", loc="left", fontsize="medium")
    if system is not None:
        draw_surfaces(ax, system, sol, shown)
    ax.set_xlabel(sol.labels.component(shown[0]))
    ax.set_ylabel(sol.labels.component(shown[1]))
    legend(ax)
    way = 1 if ts[0] <= ts[-1] else -1
    solid = np.isfinite(xs).all(axis=1)

    def show(t: float) -> list[Artist]:
        gone = way * ts <= way * t
        here = [np.interp(way * t, way * ts[solid], column[solid]) for column in xs.T]
        trail.set_data(*np.append(xs[gone], [here], axis=0).T)
        point.set_data(*np.reshape(here, (2, 1)))
        for kind, line in marks.items():
            happened = (met.kinds == kind) & (way * met.ts <= way * t)
            line.set_data(*met.xs[happened][:, shown].T)
        clock.set_text(f"{sol.labels.time.split(',')[0]} = {t:.4g}")
        return [trail, point, clock, *marks.values()]

    show(float(ts[0]))
    moments = np.linspace(ts[0], ts[-1], frames)
    figure: Any = ax.figure  # also for axes in a subfigure
    return FuncAnimation(figure, show, frames=moments, interval=interval)
