"""The plane of two swept parameters of a diagram."""

import numpy as np
from matplotlib.axes import Axes

from jaxfil.sweep.diagram import BifurcationDiagram


def plane_of(diagram: BifurcationDiagram) -> tuple[list[np.ndarray], tuple[np.ndarray, ...]]:
    """The values of both parameters in ascending order, and the indices of this order; an error for
    any other diagram."""
    values = diagram.values
    if not isinstance(values, tuple) or len(values) != 2 or min(map(len, values)) < 2:
        names = [diagram.parameter] if isinstance(diagram.parameter, str) else diagram.parameter
        raise ValueError(
            "`diagram` must be a sweep over a grid of two parameters, two values or more of each, "
            f"got {', '.join(names)} in the shape {diagram.successful.shape}."
        )
    at = [np.argsort(axis)[: np.isfinite(axis).sum()] for axis in values]  # NaN comes last
    return [axis[order] for axis, order in zip(values, at, strict=True)], np.ix_(*at)


def label_plane(ax: Axes, diagram: BifurcationDiagram) -> None:
    """The names of both parameters along the axes."""
    ax.set_xlabel(diagram.labels.parameter(diagram.parameter[0]))
    ax.set_ylabel(diagram.labels.parameter(diagram.parameter[1]))
