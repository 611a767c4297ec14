"""The paper on which the figures are drawn: sizes, colours and marks that all of them share.

Inches, axes and samples enter; an empty figure, and axes drawn on, leave.
"""

from matplotlib.figure import Figure

# Okabe and Ito's colours, which colour-blind readers tell apart.
BLACK, BLUE, VERMILLION, GREEN = "#000000", "#0072B2", "#D55E00", "#009E73"
PURPLE, ORANGE, SKY = "#CC79A7", "#E69F00", "#56B4E9"
COLORS = (BLUE, ORANGE, GREEN, VERMILLION, PURPLE)
DOTS = {"linestyle": "none", "marker": "o", "markeredgewidth": 0, "rasterized": True}


def canvas(width, height):
    """An empty figure of that many inches."""
    return Figure(figsize=(width, height), dpi=110, layout="constrained")


def entitle(ax, text):
    """A panel's title, on the left."""
    ax.set_title(text, fontsize="medium", loc="left")


def dots(ax, values, samples, **style):
    """Every sample (p, samples) above its value (p,)."""
    xs = values[:, None] + 0 * samples
    ax.plot(xs.ravel(), samples.ravel(), **{**DOTS, "color": BLACK, "markersize": 0.7, **style})
