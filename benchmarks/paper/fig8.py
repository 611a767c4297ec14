"""Fig. 8: the largest velocity of the belt's period-1 orbit, case 1, and its nine bifurcations.

One call of `find_bifurcations` enters, that of `benchmarks.bifurcations`; the branch leaves.
"""

import numpy as np

from benchmarks.bifurcations import PRINTED, REFERENCE, belt_sequence, near
from benchmarks.paper.canvas import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILLION,
    canvas,
    entitle,
)
from benchmarks.paper.table import Row

TITLE = "Fig. 8: largest velocity of the belt's period-1 orbit, case 1, γ1 = 10, γ2 = 0"
# Known to three decimals, by integration of closed forms.
LOCATED = {"b": 1.398, "c": 1.403, "e": 1.914, "f": 2.438, "g": 4.217, "h": 7.952}
# Where letters stand, in points from their marks: in the picture, and in its inset.
PLACES = {
    "a": (-12, 4),
    "d": (4, -14),
    "e": (-13, -3),
    "f": (-12, -3),
    "g": (8, -2),
    "h": (2, 8),
    "i": (0, 8),
}
CLOSE_PLACES = {"b": (-12, 8), "c": (5, 8), "d": (-12, 8)}
MARKS = {
    "grazing-sliding": ("o", BLUE),
    "adding-sliding": ("s", ORANGE),
    "crossing-sliding": ("^", GREEN),
    "switching-sliding": ("D", VERMILLION),
}


def make():
    """The figure and the rows of its table."""
    found = belt_sequence()
    branch = found.branch
    largest = branch.extremes()[1][:, 1]
    order = np.argsort(branch.values)
    tops = np.interp([float(b.value) for b in found], branch.values[order], largest[order])
    figure = canvas(9, 5.2)
    ax = figure.subplots()
    inset = ax.inset_axes((0.54, 0.45, 0.43, 0.49))
    for axes, places in ((ax, PLACES), (inset, CLOSE_PLACES)):
        curve(axes, branch.values[order], largest[order], np.asarray(branch.stable)[order])
        marks(axes, found, tops, places)
    ax.axhline(1, color=BLACK, lw=0.6, ls=":")
    ax.text(19.9, 1.03, "belt, v = 1", ha="right", va="bottom", fontsize="small")
    ax.set(xlabel="forcing frequency ω", ylabel="largest velocity max ẋ", xlim=(0.5, 20))
    inset.set(xlim=(1.38, 1.58), ylim=(0.96, 1.16))
    inset.tick_params(labelsize="small")
    inset.set_title("b, c and d", fontsize="small")
    ax.axvline(7.85, color=VERMILLION, lw=0.8, ls="--", label="the paper's 7.85")
    ax.legend(fontsize="small", loc="upper left", bbox_to_anchor=(0.19, 0.98))
    entitle(ax, "Belt friction, case 1: the period-1 branch and its sliding bifurcations a to i")
    return figure, table(found)


def curve(ax, values, largest, stable):
    """The branch, dashed where its orbits are unstable."""
    ax.plot(values, np.where(stable, largest, np.nan), color=BLACK, lw=1.2)
    ax.plot(values, np.where(stable, np.nan, largest), color=BLACK, lw=1.2, ls="--")


def marks(ax, found, tops, places):
    """Every bifurcation by its kind, with a letter in ascending order."""
    named = set()
    for letter, b, top in zip("abcdefghi", found, tops, strict=True):
        marker, color = MARKS[b.kind]
        label = b.kind if b.kind not in named else None
        named.add(b.kind)
        ax.plot(b.value, top, marker, color=color, mec=BLACK, ms=6, label=label, clip_on=True)
        if letter in places:
            ax.annotate(letter, (b.value, top), places[letter], textcoords="offset points")


def table(found):
    """The rows of its table."""
    rows = []
    for letter, b in zip("abcdefghi", found, strict=True):
        value = float(b.value)
        printed, why = near(PRINTED, value) or ("", "")
        exact = near(REFERENCE, value) or LOCATED.get(letter, "")
        rows.append(Row(f"{letter}  {b.kind}", printed, value, exact, why))
    return rows
