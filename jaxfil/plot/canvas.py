"""What pictures are drawn on, and with: pages, axes and the colours of Okabe and Ito."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLACK, WHITE, YELLOW, VERMILLION = "#000000", "#FFFFFF", "#F0E442", "#D55E00"
COLORS = ("#0072B2", VERMILLION, "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


def page() -> Figure:
    """An empty figure that no window shows, for a picture that goes to a file."""
    return Figure(figsize=(8, 5), dpi=200, layout="constrained")


def own_axes() -> Axes:
    """Axes of a figure of their own."""
    import matplotlib.pyplot as plt  # looks for a display, so only when a window is wanted

    return plt.subplots(layout="constrained")[1]
