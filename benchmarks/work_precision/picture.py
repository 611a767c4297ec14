"""Error against run time as a picture: contacts located on the left, smoothed on the right.

A problem and its rows enter; a file leaves. A colour is a program, a mark a method, a line how the
lanes ran.
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
    "Taylor8": "$8$",
    "Taylor12": "$12$",
    "Taylor16": "$16$",
    "Radau": "D",
    "Kvaerno5": "D",
    "LSODA": "v",
    "tolerance": "P",
}
LINES = {
    "one lane": {"ls": "-"},
    "one lane, loop compiled whole": {"ls": "--", "mfc": "white"},
    f"a lane of a batch of {LANES}": {"ls": ":", "lw": 1.6},
}

# Where the name of a curve may be, beside one of its ends.
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
    """Both panels, or the left one alone where nothing was smoothed."""
    with paper.style():
        paper.save(_figure(problem, rows), path)


def _figure(problem, rows):
    """The figure of `draw`."""
    smooth = any(r.program == "smoothed" for r in rows)
    figure = paper.canvas(paper.PAGE, 140)
    axes = figure.subplots(1, 1 + smooth, sharex=True, sharey=True, squeeze=False)[0]
    for key, some in curves([r for r in rows if r.lanes == 1]).items():
        _curve(axes[-1 if key[0] == "smoothed" else 0], *key, some)
    for key, some in curves([r for r in rows if r.lanes > 1]).items():
        _curve(axes[0], *key, some)
    axes[0].set(xscale="log", yscale="log", ylabel="run time (ms)")
    axes[0].invert_xaxis()
    axes[0].set_ylim(top=2 * axes[0].get_ylim()[1])  # room for the names of the widths
    titles = ("contacts located", "sgn H smoothed to tanh(H/w); w at each curve")
    for ax, title in zip(axes, titles, strict=False):
        ax.set(xlabel="error at t1 (smaller to the right)")
        paper.entitle(ax, title)
        ax.grid(alpha=0.25)
    if smooth:
        _beside(axes[1], rows)
    figure.suptitle(problem.title)
    figure.get_layout_engine().set(wspace=0.06)  # the last tick of one panel, the first of the next
    figure.legend(handles=list(_handles(rows)), loc="outside lower center", ncols=3, frameon=False)
    if smooth:
        _name_widths(axes[1], [r for r in rows if r.program == "smoothed"])
    return figure


def _curve(ax, program, method, rows):
    """Points in the order of settings; a run that failed has none."""
    name = method.split(",")[0]
    kind = 2 if rows[0].lanes > 1 else 1 if NOTE in method else 0
    mark = MARKS["tolerance" if "tolerance" in method else name]
    style = {"color": PROGRAMS[program][0], "marker": mark, "ms": 3.5, "lw": 0.9}
    points = [(r.error, 1e3 * r.seconds) for r in rows if 0 < r.error < math.inf]
    ax.plot(*zip(*points, strict=True), **{**style, **list(LINES.values())[kind]})


def _name_widths(ax, rows):
    """The width of each smoothed curve at one of its ends, where neither curves nor other names
    are."""
    ax.figure.get_layout_engine().execute(ax.figure)
    points = np.concatenate([_between(ax.transData.transform(c.get_xydata())) for c in ax.lines])
    boxes = []
    for (_, method), some in curves(rows).items():
        found = [(r.error, 1e3 * r.seconds) for r in some if 0 < r.error < math.inf]
        if not found:
            continue
        power = round(math.log10(float(method.split("width ")[1])))
        for end, place in itertools.product((found[-1], found[0]), PLACES):
            name = ax.annotate(f"$10^{{{power}}}$", end, textcoords="offset points", **place)
            box = name.get_window_extent()
            if not (box.count_overlaps(boxes) or box.count_contains(points)):
                break
            name.remove()
        else:
            raise ValueError(f"no place for the width of {method}")
        boxes.append(box)


def _between(points, pieces=60):
    """Points along a polygon, its corners among them."""
    at = np.linspace(0, len(points) - 1, pieces * (len(points) - 1) + 1)
    return np.stack([np.interp(at, np.arange(len(points)), column) for column in points.T], axis=1)


def _beside(ax, rows):
    """The jaxfil curve that the smoothed ones are to be seen beside."""
    ours = curves([r for r in rows if r.lanes == 1])["jaxfil", "Dopri8"]
    _curve(ax, "jaxfil", "Dopri8", ours)


def _handles(rows):
    """The entries of the legend."""
    shown = {(r.program, r.method.split(",")[0]) for r in rows}
    shown |= {(r.program, "tolerance") for r in rows if "tolerance" in r.method}
    for program, (color, _) in PROGRAMS.items():
        for method, mark in MARKS.items():
            if (program, method) in shown:
                label = f"{program} {method}"
                yield Line2D([], [], color=color, marker=mark, ms=3.5, lw=0.9, label=label)
    for label, style in LINES.items():
        style = {"color": "0.4", "marker": "o", "ms": 3.5, "lw": 0.9, **style}
        yield Line2D([], [], **style, label=label)
