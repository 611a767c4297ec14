"""A Poincaré section coloured by the density of its points."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from jaxfil.model.system import System
from jaxfil.model.types import States
from jaxfil.plot.canvas import color_bar, own_axes
from jaxfil.plot.section import name_axes, section_points


def section_density(
    xs: States,
    ax: Axes | None = None,
    components: Iterable[int] = (0, 1),
    system: System | None = None,
    bins: int = 300,
    colorbar: bool | Axes = True,
) -> Axes:
    """Draw the density of a section's points, in a logarithmic scale of colours.

    It distinguishes often visited parts of an attractor from rare ones where dots would overlap.
    The integral over the axes is one.

    **Arguments**

    - `xs`: states, shape (k, n) or (…, k, n); states that are not finite are omitted.
    - `ax`: the axes to draw on; by default new ones.
    - `components`: the numbers of the two components, horizontal first.
    - `system`: the `System` with the names of the axes; by default x[0], x[1], ….
    - `bins`: number of cells along either axis.
    - `colorbar`: whether to draw the scale of colours beside them, or the axes to draw it in.

    **Returns** the matplotlib axes.

    >>> import numpy as np
    >>> import jaxfil as jf
    >>> xs = np.random.default_rng(0).normal(size=(10_000, 2))
    >>> ax = jf.plot.section_density(xs, jf.plot.page().add_subplot(), bins=50)
    >>> ax.get_xlabel(), ax.figure.axes[1].get_ylabel()
    ('x[0]', 'density')
    """
    points, shown = section_points(xs, components, system, (2,))
    ax = own_axes(ax)
    if len(points):
        density, x, y = np.histogram2d(*points[:, shown].T, bins=bins, density=True)
        few = np.ma.masked_equal(density.T, 0)
        norm = LogNorm(few.min(), max(few.max(), 1.001 * few.min()))
        picture = ax.pcolormesh(x, y, few, norm=norm, cmap="viridis_r", rasterized=True)
        color_bar(ax, picture, colorbar, label="density")
    name_axes(ax, system, points.shape[1], shown)
    return ax
