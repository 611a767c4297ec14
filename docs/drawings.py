"""`python -m docs.drawings [--gallery]`: the pictures of the site that are not results.

Nothing enters; the drawings of the theory leave: the two mechanisms of the paper, Filippov's cases
on a surface, the intersection of two surfaces and the sliding bifurcations; with `--gallery` the
panels of `benchmarks.gallery` one by one. The orbits drawn of the sliding bifurcations are exact:
those of the normal forms named in the panels, in closed form.
"""

import sys
from pathlib import Path

import matplotlib
import matplotlib.patches
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


def spring(ax, a, b, coils=7, width=0.12):
    """A coil spring from one point to another."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    along = (b - a) / np.hypot(*(b - a))
    across = np.array([-along[1], along[0]])
    u = np.concatenate([[0, 0.15], np.linspace(0.15, 0.85, 2 * coils + 1), [0.85, 1]])
    v = np.concatenate([[0, 0], [0], width * np.resize([1, -1], 2 * coils - 1), [0], [0, 0]])
    points = a + u[:, None] * (b - a) + v[:, None] * across
    ax.plot(*points.T, color="black", linewidth=1)


def ground(ax, left, right, y):
    """A hatched line: what does not move."""
    ax.plot([left, right], [y, y], color="black", linewidth=1)
    ax.fill_between([left, right], y - 0.12, y, hatch="////", facecolor="none", edgecolor="0.5",
                    linewidth=0)  # fmt: skip


def pointer(ax, start, end, text, shift=(0, 0), color="black"):
    """A straight arrow with its name at the end."""
    ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": color})
    ax.text(end[0] + shift[0], end[1] + shift[1], text, color=color, ha="center", va="center")


def truss(ax):
    """The SD oscillator: a mass between two inclined springs."""
    for y in (1.25, -1.25):
        spring(ax, (0.0, y), (1.4, 0.0))
        ax.plot(0, y, "^" if y < 0 else "v", color="black", markersize=7)
    ax.plot([-0.9, 2.5], [0, 0], color="0.75", linewidth=0.8, linestyle="--", zorder=0)
    ax.plot([0, 0], [-1.25, 1.25], color="0.75", linewidth=0.8, linestyle="--", zorder=0)
    ax.plot(1.4, 0, "o", color=BEFORE, markersize=16)
    pointer(ax, (1.65, 0), (2.5, 0), "$f_0 \\cos\\Omega\\tau$", (0.55, 0))
    pointer(ax, (0, -1.5), (1.4, -1.5), "$x$", (0.15, 0))
    ax.plot([0, 0], [-1.25, -1.55], color="0.75", linewidth=0.8, linestyle="--", zorder=0)
    ax.annotate("", (-0.3, 1.25), (-0.3, 0), arrowprops={"arrowstyle": "<|-|>", "color": "0.4"})
    ax.text(-0.45, 0.62, "$\\alpha$", ha="center", va="center")
    ax.set_title("SD oscillator; $\\alpha = 0$: springs along $x$", fontsize="medium", loc="left")
    ax.set(xlim=(-1.1, 3.7), ylim=(-1.7, 1.5), aspect="equal")
    ax.axis("off")


def belt(ax):
    """A mass on a moving belt."""
    for x in (0.3, 2.9):
        ax.add_patch(matplotlib.patches.Circle((x, -0.9), 0.3, fill=False, linewidth=1))
    for y in (-0.6, -1.2):
        ax.plot([0.3, 2.9], [y, y], color="black", linewidth=1)
    ax.add_patch(matplotlib.patches.Rectangle((1.2, -0.6), 0.9, 0.7, color=BEFORE))
    ax.fill_between([-0.72, -0.6], -0.9, 0.6, hatch="////", facecolor="none", edgecolor="0.5",
                    linewidth=0)  # fmt: skip
    ax.plot([-0.6, -0.6], [-0.9, 0.6], color="black", linewidth=1)
    spring(ax, (-0.6, -0.25), (1.2, -0.25))
    ax.text(0.3, 0.08, "$\\gamma_1 x + \\gamma_2 x^3$", ha="center")
    pointer(ax, (2.1, -0.25), (2.95, -0.25), "$f_0 \\cos\\omega t$", (0.55, 0))
    pointer(ax, (1.3, -0.75), (2.2, -0.75), "$v$", (0.18, -0.04), AT)
    pointer(ax, (1.65, 0.35), (2.4, 0.35), "$x$", (0.15, 0))
    ax.plot([1.65, 1.65], [0.2, 0.5], color="black", linewidth=1)
    ax.set_title("belt friction, at $\\dot x = v$ it sticks", fontsize="medium", loc="left")
    ax.set(xlim=(-1.1, 3.7), ylim=(-1.6, 1.6), aspect="equal")
    ax.axis("off")


def cases(axes):
    """What the fields on both sides of a surface make of a motion."""
    titles = ("crosses upward", "crosses downward", "slides", "not unique")
    signs = ((1, 1), (-1, -1), (-1, 1), (1, -1))
    for ax, title, (above, below) in zip(axes, titles, signs, strict=True):
        ax.axhline(0, color="black", linewidth=1)
        for x in (-1.2, -0.4, 0.4, 1.2):
            for side, up in ((1, above), (-1, below)):
                middle = np.array([x, 0.5 * side])
                step = np.array([0.22, 0.26 * up])
                color = BEFORE if side > 0 else AT
                pointer(ax, middle - step, middle + step, "", color=color)
        if above < 0 < below:
            ax.plot([-1.6, 1.6], [0, 0], color="0.75", linewidth=7, zorder=0)
            pointer(ax, (-0.3, 0), (0.5, 0), "", color=AFTER)
        if above > 0 > below:
            ax.plot([-1.6, 1.6], [0, 0], color="0.75", linewidth=7, zorder=0, linestyle=":")
        rates = [f"$\\dot H_{s} {'>' if up > 0 else '<'} 0$" for s, up in zip("+-", (above, below),
                                                                          strict=True)]  # fmt: skip
        ax.set_title(f"{title}: {', '.join(rates)}", fontsize="small", loc="left")
        ax.text(-1.55, 0.85, "$H > 0$, $F_+$", color=BEFORE, fontsize="small")
        ax.text(-1.55, -0.95, "$H < 0$, $F_-$", color=AT, fontsize="small")
        ax.set(xlim=(-1.65, 1.65), ylim=(-1.1, 1.1), xticks=[], yticks=[])


def intersection(axes):
    """Four fields about the intersection of two surfaces: all lead to it, and all but one."""
    titles = ("all eight rates lead to the point", "$F_{++}$ leads away: not attracting")
    for ax, title, away in zip(axes, titles, (False, True), strict=True):
        ax.axhline(0, color="black", linewidth=1)
        ax.axvline(0, color="black", linewidth=1)
        for x in (-1, 1):
            for y in (-1, 1):
                outward = away and x > 0 and y > 0
                color = AT if outward else BEFORE
                for u, v in ((0.45, 1.1), (0.8, 0.8), (1.1, 0.45)):
                    middle = np.array([x * u, y * v])
                    step = 0.16 * np.array([x, y]) * (1 if outward else -1)
                    pointer(ax, middle - step, middle + step, "", color=color)
                sides = "".join("+" if side > 0 else "-" for side in (x, y))
                ax.text(1.4 * x, 1.4 * y, f"$F_{{{sides}}}$", ha="center", va="center", color=color)
        ax.plot(0, 0, "o", color="black", markersize=5)
        ax.set_title(title, fontsize="medium", loc="left")
        ax.set(xlim=(-1.65, 1.65), ylim=(-1.65, 1.65), xticks=[], yticks=[], aspect="equal")
        ax.set(xlabel="$H_1$", ylabel="$H_2$")


def theory(folder):
    """The mechanisms, Filippov's cases, the intersection, the four sliding bifurcations."""
    for name, size, shape, draw in (
        ("mechanisms", (9, 3.2), (1, 2), lambda axes: (truss(axes[0]), belt(axes[1]))),
        ("cases", (9, 4.4), (2, 2), lambda axes: cases(axes.ravel())),
        ("intersection", (8, 4), (1, 2), intersection),
    ):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure.subplots(*shape))
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    bifurcations(folder)


def bifurcations(folder):
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
    """Each panel of the gallery at the width of a column."""
    from benchmarks.gallery import PANELS
    from benchmarks.paper import canvas as paper

    for panel in PANELS:
        with paper.style():
            figure = paper.canvas(paper.COLUMN, 63)
            ax = figure.subplots()
            paper.entitle(ax, panel(ax, 1))
            figure.savefig(folder / f"{panel.__name__}.png", dpi=300)


if __name__ == "__main__":
    theory(DOCS / "theory")
    if "--gallery" in sys.argv:
        gallery(DOCS / "gallery")
