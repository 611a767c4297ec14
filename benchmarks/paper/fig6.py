"""Fig. 6: bifurcation diagram of the SD oscillator, and how long its chaotic transients last.

Frequencies enter; the diagram from one initial state leaves, and below it the part of many initial
states whose motion is still chaotic after N periods. Where a diagram shows chaos to begin and to
end depends on N: it ends for good in a crisis near Ω = 1.13, and is a transient above.
"""

import functools as ft

import numpy as np

import jaxfil as jf
from benchmarks.paper.canvas import BLACK, BLUE, COLORS, ORANGE, canvas, dots, entitle
from benchmarks.paper.sweeps import sweep_of
from benchmarks.paper.table import Row

TITLE = "Fig. 6: bifurcation diagram of the SD oscillator, α = 0, f0 = 0.25, ζ = 0.0141"
X0, ONE_SIDED = np.array([0.3, 0.1]), np.array([1.4, 0.0])
GRAZING = 0.866716581971234
# Periods after which the lanes are looked at, and for how many periods then.
HOLDS = (50, 200, 800, 3200)
LOOK, LONGEST = 32, 12
MEAN_LIFE_AT = 1.145
# Samples (p, samples, 2) of the motion from x0.
sweep = ft.partial(sweep_of, jf.systems.SDOscillator)


def chaotic(xs):
    """Which motions (…, LOOK) change sides, and do not repeat after LONGEST periods or fewer. A
    settled one-sided or symmetric motion has x of one sign once a period."""
    sides = xs > 0
    changes = sides.any(axis=-1) & ~sides.all(axis=-1)
    last = xs[..., LONGEST:]
    misses = [
        abs(last - xs[..., LONGEST - p : LOOK - p]).max(axis=-1) for p in range(1, LONGEST + 1)
    ]
    return changes & (np.min(misses, axis=0) > 0.05)


def still_chaotic(values, lanes, holds, rng):
    """Which of the lanes, (h, p, lanes), are chaotic after each of h holds."""
    states = rng.uniform([-1.5, -1.0], [1.5, 1.0], (lanes, 2))
    grid, x = np.repeat(values, lanes), np.tile(states, (len(values), 1))
    found, gone = [], 0
    for hold in holds:
        xs = sweep(grid, x, hold - gone, LOOK)
        x, gone = xs[:, -1], hold + LOOK
        found.append(chaotic(xs[..., 0].reshape(len(values), lanes, LOOK)))
    return np.array(found)


def mean_life(lanes, rng, early=100, late=400):
    """Mean life in periods of chaos at MEAN_LIFE_AT, and its standard error: survivors decay as
    exp(−N/life)."""
    found = still_chaotic(np.array([MEAN_LIFE_AT]), lanes, (early, late), rng)
    before, after = found[:, 0].sum(axis=1)
    life = (late - early) / np.log(before / after)
    return life, life**2 / (late - early) * np.sqrt(1 / after - 1 / before)


def make(points=1000, around=36, lanes=48, holds=HOLDS, many=2048):
    """The figure and the rows of its table."""
    rng = np.random.default_rng(0)
    values = np.linspace(0.6, 1.3, points)
    settled = sweep(values, X0, 300, 60)
    followed = sweep(values, ONE_SIDED, 100, 60, follow="up")
    ends = np.linspace(0.83, 0.872, around), np.linspace(1.12, 1.16, around)
    both = np.concatenate(ends)
    found = still_chaotic(both, lanes, holds, rng)
    parts = found.mean(axis=-1)
    life = mean_life(many, rng)
    figure = canvas(9, 7.4)
    top, below = figure.subfigures(2, 1, height_ratios=(1.2, 1))
    diagram(top.subplots(), values, followed[..., 0], settled[..., 0])
    axes = below.subplots(1, 2, sharey=True)
    for ax, value, text in zip(
        axes, (GRAZING, 1.13), ("grazing, 0.8667", "crisis, 1.13"), strict=True
    ):
        ax.axvline(value, color=BLACK, lw=0.8, ls="--", label=text)
    for i, ax in enumerate(axes):
        here = slice(i * around, (i + 1) * around)
        for hold, part, color in zip(holds, parts, COLORS, strict=False):
            ax.plot(ends[i], part[here], ".-", color=color, lw=1, ms=4, label=f"N = {hold}")
        ax.set(xlabel="forcing frequency Ω", ylim=(-0.03, 1.03))
        ax.legend(fontsize="small", loc=("upper left", "lower left")[i])
    axes[0].set_ylabel("part still chaotic after N periods")
    axes[1].set_xticks([1.12, 1.13, 1.14, 1.15, 1.16])
    figure.suptitle("SD oscillator, α = 0, f0 = 0.25, ζ = 0.0141")
    entitle(axes[0], f"where chaos begins ({lanes} initial states)")
    entitle(axes[1], "where it ends")
    onset = values[chaotic(followed[:, -LOOK:, 0])].min()
    return figure, table(both, parts, holds, life, onset)


def diagram(ax, values, followed, settled):
    """The diagram from one state, and that of the one-sided orbit followed up."""
    before = values < GRAZING
    dots(ax, values[before], settled[before], color=ORANGE, label="from (0.3, 0.1)")
    dots(ax, values, followed, alpha=0.7, label="followed up from the one-sided orbit")
    ax.axvline(GRAZING, color=BLUE, lw=0.8, ls="--", label="grazing, 0.8667")
    ax.axvline(1.145, color=BLUE, lw=0.8, ls=":", label="the paper's end of chaos, 1.145")
    ax.set(xlim=(values[0], values[-1]), xlabel="forcing frequency Ω", ylabel="x once a period")
    ax.legend(fontsize="small", loc="upper right", markerscale=8)


def table(values, parts, holds, life, onset):
    """The rows of its table."""
    low, high = values < 1, values > 1
    why = "a step of the grid, which jolts the orbit, is 0.0007"
    rows = [Row("chaos begins, followed from the orbit", "0.8667", onset, GRAZING, why, 5)]
    why = "chaos before grazing is a transient of 10³ to 10⁵ periods"
    for hold, part in zip(holds, parts, strict=True):
        begins = f"{values[low & (part >= 0.5)].min():.4f}"
        rows.append(Row(f"half of the states chaotic, N = {hold}: from", "", begins, "", why))
    why = "chaos past the crisis is a transient: where it seems to end depends on N"
    for hold, part in zip(holds, parts, strict=True):
        ends = f"{values[high & (part >= 0.5)].max():.4f}"
        rows.append(Row(f"half of the states chaotic, N = {hold}: to", "1.145", ends, "1.13", why))
    what = f"mean life of chaos at Ω = {MEAN_LIFE_AT}, periods"
    why = (
        "here the rate at which survivors fall from N = 100 to 400, to any orbit: one of period 8 "
    )
    why += "with both signs of x takes a tenth of them"
    rows.append(Row(what, "", f"{life[0]:.0f} ± {life[1]:.0f}", "170", why))
    return rows
