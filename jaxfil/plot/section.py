"""A Poincaré section: the states at which a motion meets it."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxfil.model import check
from jaxfil.model.labels import Labels, labels_of
from jaxfil.model.system import System
from jaxfil.plot.canvas import BLACK, own_axes


def poincare_section(
    xs: Any,
    ax: Axes | None = None,
    components: tuple[int, int] = (0, 1),
    system: System | None = None,
) -> Axes:
    """Draw one component against another at every state of a section, shape (k, n) or (…, k, n).

    A stroboscopic section is what `jaxfil.bifurcation_diagram` samples: `diagram.xs[i]` for one
    value. That of another kind is `jaxfil.Solution.events.xs`, the states at contacts.
    The axes have the names that `system` gives the components, if it is given.
    """
    if system is not None:
        check.system("system", system)
    given, xs = xs, np.asarray(xs)
    if xs.dtype.kind not in "fiu" or xs.ndim < 2 or xs.shape[-1] <= max(components):
        got = f"shape {xs.shape}" if xs.dtype.kind in "fiu" else type(given).__name__
        raise ValueError(
            f"`xs` must be states of shape (k, n) with n > {max(components)}, got {got}."
        )
    ax = own_axes(ax)
    points = xs.reshape(-1, xs.shape[-1])
    points = points[np.isfinite(points).all(axis=1)]
    # A point of a page covers some thousandth of it: so many that none hides the next.
    size = float(np.clip(60 / np.sqrt(max(len(points), 1)), 1, 4))
    x, y = (points[:, i] for i in components)
    ax.plot(x, y, ".", color=BLACK, markersize=size, markeredgewidth=0, rasterized=True)
    labels = Labels() if system is None else labels_of(system, xs.shape[-1])
    ax.set_xlabel(labels.component(components[0]))
    ax.set_ylabel(labels.component(components[1]))
    return ax
