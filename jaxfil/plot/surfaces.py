"""The surfaces of a system in a plane of two components of its state."""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from jaxfil.integrate.run.solution import Solution
from jaxfil.model.system import System
from jaxfil.plot.canvas import COLORS, subscript

# Points along each edge of the picture at which the switching function is evaluated.
_GRID = 201


def draw_surfaces(ax: Axes, system: System, sol: Solution, shown: list[int]) -> None:
    """Dash the zeros of every switching function within the axes of two components; several are
    numbered from 0, as in the event table."""
    limits = ax.get_xlim(), ax.get_ylim()
    x, y = (np.linspace(*ends, _GRID) for ends in limits)
    # A surface in n dimensions, cut by the plane through the last state.
    last = np.broadcast_to(np.asarray(sol.x_final), (_GRID, _GRID, np.size(sol.x_final))).copy()
    last[..., shown[0]], last[..., shown[1]] = np.meshgrid(x, y)
    heights = jax.vmap(jax.vmap(lambda x: jnp.atleast_1d(system.switching(sol.t_final, x))))
    every = np.moveaxis(np.asarray(heights(jnp.asarray(last))), -1, 0)
    for j, h in enumerate(every):
        if h.min() < 0 < h.max():  # a surface through the last state may contain the plane
            number, color = subscript(j) * (len(every) > 1), COLORS[j % len(COLORS)]
            ax.contour(x, y, h, levels=[0.0], colors=color, linewidths=1.0, linestyles="dashed")
            ax.plot([], [], "--", color=color, linewidth=1.0, label=f"H{number} = 0")
    ax.set_xlim(limits[0], auto=None)
    ax.set_ylim(limits[1], auto=None)
