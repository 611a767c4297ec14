"""Error against run time as a picture: one lane, a lane of a batch, and the smoothed problem.

A problem and its rows enter; a file leaves. A colour is a program, a mark a method; jaxfil's Taylor
series are darker, and dashed where their order is not 12. Loops compiled whole, and tolerances of a
single lane, are in the table alone.
"""

import itertools
import math

import numpy as np
from matplotlib.lines import Line2D

from benchmarks.paper import canvas as paper
from benchmarks.programs import PROGRAMS
from benchmarks.work_precision.front import curves
from benchmarks.work_precision.program import LANES
from benchmarks.work_precision.whole_loop import NOTE

MARKS = {
    "Dopri8": "o",
    "DOP853": "o",
    "Tsit5": "s",
    "RK45": "s",
    "RK4": "^",
    "Taylor": "*",
    "Taylor8": "*",
    "Taylor12": "*",
    "Taylor16": "*",
    "Radau": "D",
    "Kvaerno5": "D",
    "LSODA": "v",
    "Dopri8, tolerance": "P",
    "Taylor12, tolerance": "X",
}
SMOOTHED = "smoothed; width at each curve"
DARKER = "#08306b"
DASHES = {"Taylor8": ":", "Taylor16": "--"}

# Where the name of a curve may be, beside one of its points.
PLACES = (
    {"xytext": (0, 4), "ha": "center", "va": "bottom"},
    {"xytext": (0, -4), "ha": "center", "va": "top"},
    {"xytext": (5, 0), "ha": "left", "va": "center"},
    {"xytext": (-5, 0), "ha": "right", "va": "center"},
    {"xytext": (4, 4), "ha": "left", "va": "bottom"},
    {"xytext": (-4, 4), "ha": "right", "va": "bottom"},
    {"xytext": (4, -4), "ha": "left", "va": "top"},
    {"xytext": (-4, -4), "ha": "right", "va": "top"},
)


def draw(problem, rows, path):
    """The panels that there are rows for."""
    with paper.style():
        paper.save(_figure(problem, rows), path)


def _figure(problem, rows):
    """The figure of `draw`."""
    panels = {title: some for title, some in _panels(rows).items() if some}
    figure = paper.canvas(paper.PAGE, 125)
    axes = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    for ax, (title, some) in zip(axes, panels.items(), strict=True):
        for key, points in curves(some).items():
            _curve(ax, *key, points)
        ax.set(xscale="log", yscale="log")
        paper.entitle(ax, title)
        ax.grid(alpha=0.25)
    axes[0].set(ylabel="run time (ms)")
    axes[0].invert_xaxis()
    # Room for the names of the widths.
    axes[0].set(xlim=(1e2 * axes[0].get_xlim()[0], None), ylim=(None, 2 * axes[0].get_ylim()[1]))
    axes[len(axes) // 2].set(xlabel="error at t1 (smaller to the right)")
    figure.suptitle(problem.title)
    figure.get_layout_engine().set(wspace=0.06)  # the last tick of one panel, the first of the next
    shown = [row for some in panels.values() for row in some]
    figure.legend(handles=list(_handles(shown)), loc="outside lower center", ncols=4, frameon=False)
    if SMOOTHED in panels:
        _name_widths(axes[-1], [r for r in rows if r.program == "smoothed"])
    return figure


def _panels(rows):
    """{title: rows}. Beside the batches stands the fastest program that has none, and beside the
    smoothed problem the located one."""
    single = [r for r in rows if r.lanes == 1 and NOTE not in r.method]
    located = [r for r in single if r.program != "smoothed"]
    smoothed = [r for r in single if r.program == "smoothed"]
    ours = [r for r in located if (r.program, r.method) == ("jaxfil", "Dopri8")]
    batch = [r for r in rows if r.lanes > 1]
    return {
        "one lane": [r for r in located if "tolerance" not in r.method],
        f"a lane of {LANES}; heyoka: one": batch + [r for r in located if r.program == "heyoka"],
        SMOOTHED: smoothed + ours if smoothed else [],
    }


def _style(program, method):
    """How the points of a curve are drawn and joined. What a smoothed method is called ends with
    its width."""
    name = method if method in MARKS else method.split(",")[0]
    series = program == "jaxfil" and name.startswith("Taylor")
    color = DARKER if series else PROGRAMS[program][0]
    dashes = DASHES.get(name, "-")
    return {"color": color, "marker": MARKS[name], "ls": dashes, "ms": 3.5, "lw": 0.9}


def _curve(ax, program, method, rows):
    """Points in the order of settings; a run that failed has none."""
    points = [(r.error, 1e3 * r.seconds) for r in rows if 0 < r.error < math.inf]
    if points:
        ax.plot(*zip(*points, strict=True), **_style(program, method))


def _name_widths(ax, rows):
    """The width of each smoothed curve at one of its ends, or else of its points, where there are
    neither curves nor other names."""
    ax.figure.get_layout_engine().execute(ax.figure)
    points = np.concatenate([_between(ax.transData.transform(c.get_xydata())) for c in ax.lines])
    boxes = []
    for (_, method), some in curves(rows).items():
        found = [(r.error, 1e3 * r.seconds) for r in some if 0 < r.error < math.inf]
        if not found:
            continue
        power = round(math.log10(float(method.split("width ")[1])))
        ends = dict.fromkeys((found[-1], found[0], *found))
        for at, place in itertools.product(ends, PLACES):
            name = ax.annotate(f"$10^{{{power}}}$", at, textcoords="offset points", **place)
            box = name.get_window_extent()
            free = not (box.count_overlaps(boxes) or box.count_contains(points))
            if free and ax.bbox.containsx(box.x0) and ax.bbox.containsx(box.x1):
                break
            name.remove()
        else:
            raise ValueError(f"no place for the width of {method}")
        boxes.append(box)


def _between(points, pieces=60):
    """Points along a polygon, its corners among them."""
    at = np.linspace(0, len(points) - 1, pieces * (len(points) - 1) + 1)
    return np.stack([np.interp(at, np.arange(len(points)), column) for column in points.T], axis=1)


def _handles(rows):
    """The entries of the legend."""
    names = {(r.program, r.method if r.method in MARKS else r.method.split(",")[0]) for r in rows}
    for program in PROGRAMS:
        for method in MARKS:
            if (program, method) in names:
                yield Line2D([], [], **_style(program, method), label=f"{program} {method}")
