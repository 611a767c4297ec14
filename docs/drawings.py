"""`python -m docs.drawings [--gallery]`: the pictures of the site that are not results.

Nothing enters; the drawings of the sliding bifurcations leave, and with `--gallery` the panels of
`benchmarks.gallery` one by one. The orbits drawn are exact: those of the normal forms named in the
panels, in closed form.
"""

import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

DOCS = Path(__file__).parent
BEFORE, AT, AFTER = "#0072B2", "#D55E00", "#009E73"
matplotlib.rcParams["svg.hashsalt"] = "jaxfil"  # the same file from the same drawing


def fold(t, x, h, sign):
    """A flight of ẋ = 1, Ḣ = ±x from (x, h)."""
    return x + t, h + sign * ((x + t) ** 2 - x**2) / 2


def arrow(ax, x, y, color):
    """A path with an arrowhead in its middle."""
    ax.plot(x, y, color=color, linewidth=1.8)
    i = len(x) // 2
    ax.annotate(
        "",
        (x[i + 1], y[i + 1]),
        (x[i - 1], y[i - 1]),
        arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 1.8},
    )


def together(ax, x, y, *colors, dash=5):
    """A path that several take: their colours in turn."""
    for i, color in enumerate(colors):
        style = dash * (len(colors) - i), (dash, dash * (len(colors) - 1))
        ax.plot(x, y, color=color, linewidth=1.8, linestyle=style)


def line(a, b, n=41):
    """From one point to another."""
    return np.linspace(a[0], b[0], n), np.linspace(a[1], b[1], n)


def surface(ax, left, right, title):
    """The line H = 0, thick where it slides."""
    ax.axhline(0, color="0.6", linewidth=1)
    ax.plot([left, right], [0, 0], color="0.75", linewidth=7, solid_capstyle="butt", zorder=0)
    ax.plot(0, 0, "o", color="black", markersize=5, zorder=5)
    ax.set_title(title, fontsize="medium", loc="left")
    ax.set(xlim=(-2.3, 2.3), xticks=[], yticks=[], xlabel="along the surface", ylabel="H")


def grazing_sliding(ax):
    """Three flights over a visible fold."""
    surface(ax, -2.3, 0, "grazing-sliding:  $F_+ = (1, x)$")
    arrow(ax, *fold(np.linspace(0, 4, 81), -2.0, 0.35 + 2.0, 1), BEFORE)
    arrow(ax, *fold(np.linspace(0, 2, 41), -2.0, 2.0, 1), AT)
    x = -np.sqrt(2 * 0.45)
    arrow(ax, *fold(np.linspace(0, 2 + x, 41), -2.0, -0.45 + 2.0, 1), AFTER)
    arrow(ax, *line((x, 0), (0, 0)), AFTER)
    together(ax, *fold(np.linspace(0, 2, 41), 0.0, 0.0, 1), AT, AFTER)


def crossing_sliding(ax):
    """Three arrivals from below near a visible fold."""
    surface(ax, -2.3, 0, "crossing-sliding:  $F_+ = (1, x)$")
    for x, color in ((0.7, BEFORE), (0.0, AT), (-0.9, AFTER)):
        arrow(ax, *line((x - 1, -1), (x, 0)), color)
    arrow(ax, *fold(np.linspace(0, 1.4, 41), 0.7, 0.0, 1), BEFORE)
    arrow(ax, *line((-0.9, 0), (0, 0)), AFTER)
    together(ax, *fold(np.linspace(0, 2.1, 41), 0.0, 0.0, 1), AT, AFTER)


def switching_sliding(ax):
    """Three arrivals from below near an invisible fold."""
    surface(ax, 0, 2.3, "switching-sliding:  $F_+ = (1, -x)$")
    for x, color in ((0.8, BEFORE), (0.0, AT), (-0.95, AFTER)):
        arrow(ax, *line((x - 1, -1), (x, 0)), color)
    arrow(ax, *fold(np.linspace(0, 1.9, 41), -0.95, 0.0, -1), AFTER)
    arrow(ax, *line((0, 0), (0.8, 0)), AT)
    together(ax, *line((0.8, 0), (0.95, 0)), BEFORE, AT)
    together(ax, *line((0.95, 0), (2.2, 0)), BEFORE, AT, AFTER)


def adding_sliding(above, beside):
    """Three slides near the end of their region, from above and from the side."""
    above.axhspan(-3.4, 0, color="0.75", linewidth=0)
    above.axhline(0, color="0.4", linewidth=1)
    above.set_title(
        "adding-sliding:  on the slide $\\dot H_+ = y$, $\\dot x = 1$, $\\dot y = -x$",
        fontsize="medium",
        loc="left",
    )
    x = np.linspace(-2.2, 2.2, 89)
    for c, color in ((-0.6, BEFORE), (0.0, AT)):
        arrow(above, x, c - x**2 / 2, color)
    c, a = 0.45, np.sqrt(2 * 0.45)
    for left, right, style in ((-2.2, -a, "-"), (-a, 2 * a, "--"), (2 * a, 2.2, "-")):
        u = np.linspace(left, right, 61)
        above.plot(u, c - u**2 / 2, style, color=AFTER, linewidth=1.8)
        if style == "--":
            beside.plot(u, c * (u + a) - (u**3 + a**3) / 6, style, color=AFTER, linewidth=1.8)
        together(beside, u, 0 * u, BEFORE, AT, *[AFTER] * (style == "-"))
    above.set(xlim=(-2.3, 2.3), ylim=(-3.2, 1.2), xticks=[], yticks=[], ylabel="y")
    above.text(0, -3.0, "sliding region", horizontalalignment="center")
    beside.set(xlim=(-2.3, 2.3), xticks=[], yticks=[], xlabel="x", ylabel="H")


def theory(folder):
    """The four sliding bifurcations."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for ax, panel in zip(figure.subplots(1, 2), (grazing_sliding, crossing_sliding), strict=True):
        panel(ax)
    figure.savefig(folder / "flights.svg", metadata={"Date": None})
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subfigures(1, 2)
    switching_sliding(left.subplots())
    adding_sliding(*right.subplots(2, 1, height_ratios=(3, 1)))
    figure.savefig(folder / "slides.svg", metadata={"Date": None})


def gallery(folder):
    """Each panel of the gallery on a page of its own."""
    from benchmarks.gallery import PANELS
    from benchmarks.paper import canvas as paper

    for panel in PANELS:
        with paper.style():
            figure = paper.canvas(120, 82)
            ax = figure.subplots()
            paper.entitle(ax, panel(ax, 1))
            figure.savefig(folder / f"{panel.__name__}.png", dpi=200)


if __name__ == "__main__":
    theory(DOCS / "theory")
    if "--gallery" in sys.argv:
        gallery(DOCS / "gallery")
