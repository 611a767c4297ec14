"""Fig. 10: bifurcation diagram of the belt, case 2, and what its jump is.

Frequencies enter; the diagram from (0, 0) leaves, that of the orbit followed up, and that of the
chaotic attractor followed down: the two coexist. The jump in the first is where (0, 0) leaves the
orbit's basin, which two pictures of the basin show; it is located by bisection in ω.
"""

import functools as ft

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D

import jaxfil as jf
from benchmarks.bifurcations import cubic_grazing
from benchmarks.paper import canvas as paper
from benchmarks.paper.sweeps import sweep_of
from benchmarks.paper.table import Row

TITLE = "Fig. 10: bifurcation diagram of the belt, case 2, γ₁ = 0, γ₂ = 10000"
REST = np.zeros(2)
PRINTED = 4.565
ON_ORBIT = np.array([0.1483395597, 0.35818994986])  # at 4.56
ENDS, CLOSE = (4.2, 4.7), (4.45, 4.7)
JUMP, GRAZING = 4.56382205, 4.652570419201206
WINDOW = ((-0.06, 0.17), (-0.7, 0.7))
# The diagram and the search for its jump keep as many: one compiled program serves both.
SAMPLES = 60
# Samples (p, samples, 2) of the motion from x0.
sweep = ft.partial(sweep_of, jf.systems.BeltFriction)


def on_orbit(xs):
    """Which motions (…, samples, 2) are the orbit: once a period it has x near 0.15, the others
    have x near 0.08."""
    return xs[..., -1, 0] > 0.11


def chaotic(xs, longest=8):
    """Which motions do not repeat after `longest` periods or fewer."""
    x, k = xs[..., 0], xs.shape[-2]
    misses = [abs(x[..., p:] - x[..., : k - p]).max(axis=-1) for p in range(1, longest + 1)]
    return np.min(misses, axis=0) > 1e-5


def jump(lanes, transient, low=4.55, high=4.58, rounds=5):
    """The value at which the motion from (0, 0) ceases to end on the orbit: the first of a row of
    lanes that does not, again between its neighbours. Half of the last bracket is the error; 40
    steps a period would add 2e-8 to it."""
    for _ in range(rounds):
        values = np.linspace(low, high, lanes)
        xs = sweep(values, REST, transient - SAMPLES, SAMPLES, steps=80)
        first = int(np.argmin(on_orbit(xs)))
        assert first > 0
        low, high = values[first - 1], values[first]
    return 0.5 * (low + high), 0.5 * (high - low)


def basin(omega, side, transient):
    """Whether the motion from each state of a grid ends on the orbit, (side, side)."""
    x, y = np.meshgrid(*(np.linspace(*ends, side) for ends in WINDOW))
    states = np.stack([x.ravel(), y.ravel()], axis=1)
    xs = sweep(np.full(len(states), omega), states, transient, 1)
    return on_orbit(xs).reshape(side, side)


def make(points=600, close=250, side=240, lanes=64, held=400, settle=1500):
    """The figure and the rows of its table."""
    values, near = np.linspace(*ENDS, points), np.linspace(*CLOSE, close)
    rest = sweep(values, REST, held, SAMPLES)
    first = sweep(near[:1], ON_ORBIT, 200, 1)[0, -1]
    up = sweep(near, first, 150, 30, follow="up")
    last = rest[-1, -1]
    down = sweep(near, last, 150, 30, follow="down")
    bracket = jump(lanes, settle)
    basins = {omega: basin(omega, side, 120) for omega in (4.55, 4.58)}
    figure = paper.canvas(paper.PAGE, 160)
    axes = figure.subplots(2, 2)
    diagrams(axes[0], values, rest, near, up, down)
    for ax, (omega, inside), letter in zip(axes[1], basins.items(), "cd", strict=True):
        draw_basin(ax, omega, inside, letter)
    paper.below(figure, handles(), 3)
    return figure, table(near, rest, values, up, down, bracket)


def diagrams(axes, values, rest, near, up, down):
    """The diagram from rest, and beside it each attractor followed."""
    ax, zoom = axes
    kept = on_orbit(rest)
    paper.dots(ax, values[kept], rest[kept, :, 0], color=paper.BLUE)
    paper.dots(ax, values[~kept], rest[~kept, :, 0], color=paper.ORANGE)
    paper.entitle(ax, "(a) every ω from (0, 0)")
    kept = on_orbit(up)  # where it ends the motion jumps to the other one
    paper.dots(zoom, near, down[..., 0], color=paper.ORANGE)
    paper.dots(zoom, near[kept], up[kept, :, 0], color=paper.BLUE)
    paper.entitle(zoom, "(b) added: each motion followed, from 4.45 on")
    for each, ends in ((ax, ENDS), (zoom, CLOSE)):
        each.axvline(GRAZING, color=paper.BLACK, lw=0.8, ls=":")
        each.set(xlim=ends, xlabel="ω, rad/s", ylabel="x once a period, m", ylim=(0.06, 0.18))
    # 0.0012 apart: one line in (a), both in an enlargement.
    ax.axvline(PRINTED, **paper.PAPER)
    zoom.axvline(JUMP, color=paper.BLACK, lw=0.8)
    inset = ax.inset_axes((0.1, 0.12, 0.5, 0.5))
    paper.dots(
        inset, values[on_orbit(rest)], rest[on_orbit(rest), :, 0], color=paper.BLUE, markersize=2
    )
    other = ~on_orbit(rest)
    paper.dots(inset, values[other], rest[other, :, 0], color=paper.ORANGE, markersize=1)
    inset.axvline(PRINTED, **paper.PAPER)
    inset.axvline(JUMP, color=paper.BLACK, lw=0.8)
    inset.set(xlim=(4.56, 4.57), ylim=(0.06, 0.16), xticks=[4.56, 4.57], yticks=[])


def handles():
    """The entries of the legend."""
    dot = {"ls": "none", "marker": "o", "ms": 4, "mew": 0}
    white = {"mfc": paper.WHITE, "mec": paper.BLACK, "mew": 0.8, "ls": "none"}
    return [
        Line2D([], [], color=paper.BLUE, label="the orbit, and what leads to it", **dot),
        Line2D([], [], color=paper.ORANGE, label="sticking motion, mostly chaos", **dot),
        Line2D([], [], label="the paper's 4.565", **paper.PAPER),
        Line2D([], [], color=paper.BLACK, lw=0.8, label="jump from (0, 0), 4.5638"),
        Line2D([], [], color=paper.BLACK, lw=0.8, ls=":", label="the orbit grazes, 4.6526"),
        Line2D([], [], marker="*", ms=8, label="(0, 0)", **white),
        Line2D([], [], marker="o", ms=4, label="the orbit at t = 0", **white),
    ]


def draw_basin(ax, omega, inside, letter):
    """Which initial states lead to which attractor, at one frequency."""
    ax.imshow(
        inside,
        origin="lower",
        extent=(*WINDOW[0], *WINDOW[1]),
        aspect="auto",
        cmap=ListedColormap([paper.ORANGE, paper.BLUE]),
        interpolation="nearest",
        vmin=0,
        vmax=1,
    )
    ax.plot(0, 0, "*", color=paper.WHITE, mec=paper.BLACK, mew=0.8, ms=8)
    ax.plot(*ON_ORBIT, "o", color=paper.WHITE, mec=paper.BLACK, mew=0.8, ms=4)
    ax.set(xlabel="x at t = 0, m", ylabel="ẋ at t = 0, m/s")
    side = "in" if omega < JUMP else "out"
    paper.entitle(ax, f"({letter}) added: ω = {omega}, (0, 0) {side}side the basin")


def table(near, rest, values, up, down, found):
    """The rows of its table."""
    grazing = float(cubic_grazing().value)
    leaves = near[~on_orbit(up)].min()
    ends = near[chaotic(down)].min()
    seen = values[~on_orbit(rest)].min()
    why = "(0, 0) leaves the orbit's basin; the orbit itself stays stable"
    after = "past its grazing it sticks for a moment and is stable still; it ends in a jump"
    before = "below, the other attractor is periodic"
    return [
        Row("jump from (0, 0), by bisection", "4.565", found[0], JUMP, why, 11),
        Row("  half of the last bracket", "", found[1], "", "", 1),
        Row("  first value of the diagram past it", "4.565", seen, "", "the grid", 5),
        Row("grazing-sliding of the orbit", "4.565", grazing, GRAZING, "not what the paper saw"),
        Row("orbit followed up: ends at", "", leaves, "", after, 5),
        Row("the other followed down: chaotic from", "", ends, "about 4.53", before, 5),
    ]
