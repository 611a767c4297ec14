"""What pictures are drawn on, and with: pages, axes and colours.

Axes, or nothing, enter; axes to draw on leave. The colours are those of M. Okabe and K. Ito, Color
Universal Design (2008), which colour-blind readers tell apart.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLACK, WHITE, YELLOW, VERMILLION = "#000000", "#FFFFFF", "#F0E442", "#D55E00"
COLORS = ("#0072B2", VERMILLION, "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


def page() -> Figure:
    """An empty figure that no window shows, for a picture that goes to a file.

    **Returns** a `matplotlib.figure.Figure` of 8 by 5 inches at 200 dots per inch: add axes with
    `add_subplot`, and write it with `savefig`.

    >>> import jaxfil as jf
    >>> page = jf.plot.page()
    >>> ax = page.add_subplot()
    >>> print(page.get_size_inches(), page.axes == [ax])
    [8. 5.] True
    """
    # Not of pyplot, which keeps every figure alive until it is closed and may look for a display.
    return Figure(figsize=(8, 5), dpi=200, layout="constrained")


def own_axes(ax: object) -> Axes:
    """The axes given, or without any those of a figure of their own."""
    if isinstance(ax, Axes):
        return ax
    if ax is not None:
        raise ValueError(f"`ax` must be matplotlib axes or None, got {type(ax).__name__}.")
    import matplotlib.pyplot as plt  # looks for a display, so only when a window is wanted

    return plt.subplots(layout="constrained")[1]


def marker_size(ax: Axes, columns: int) -> float:
    """The width of a column of samples in points, from half a point up to two."""
    # Markers as wide as a column leave no gap and hide no neighbour; thinner than half a point they
    # vanish on paper.
    width = ax.get_window_extent().transformed(ax.figure.dpi_scale_trans.inverted()).width
    return float(np.clip(72 * width / columns, 0.5, 2.0))
