"""Fig. 10: bifurcation diagram of the belt, case 2, and what its jump is.

Frequencies enter; the diagram from (0, 0) leaves, that of the orbit followed up, and that of the
chaotic attractor followed down: the two coexist. The jump in the first is where (0, 0) leaves the
orbit's basin, which two pictures of the basin show; it is located by bisection in ω.
"""

import functools as ft

import numpy as np
from matplotlib.colors import ListedColormap

import jaxfil as jf
from benchmarks.bifurcations import cubic_grazing
from benchmarks.paper.canvas import BLACK, BLUE, ORANGE, SKY, VERMILLION, canvas, dots, entitle
from benchmarks.paper.sweeps import sweep_of
from benchmarks.paper.table import Row

TITLE = "Fig. 10: bifurcation diagram of the belt, case 2, γ1 = 0, γ2 = 10000"
REST = np.zeros(2)
ON_ORBIT = np.array([0.1483395597, 0.35818994986])  # at 4.56
ENDS, CLOSE = (4.2, 4.7), (4.45, 4.7)
JUMP, GRAZING = 4.56382205, 4.652570419201206
WINDOW = ((-0.06, 0.17), (-0.7, 0.7))
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
        first = int(np.argmin(on_orbit(sweep(values, REST, transient, 1, steps=80))))
        assert first > 0
        low, high = values[first - 1], values[first]
    return 0.5 * (low + high), 0.5 * (high - low)


def basin(omega, side, transient):
    """Whether the motion from each state of a grid ends on the orbit, (side, side)."""
    x, y = np.meshgrid(*(np.linspace(*ends, side) for ends in WINDOW))
    states = np.stack([x.ravel(), y.ravel()], axis=1)
    xs = sweep(np.full(len(states), omega), states, transient, 1)
    return on_orbit(xs).reshape(side, side)


def make(points=600, close=250, side=90, lanes=64, held=400, settle=1500):
    """The figure and the rows of its table."""
    values, near = np.linspace(*ENDS, points), np.linspace(*CLOSE, close)
    rest = sweep(values, REST, held, 60)
    first = sweep(near[:1], ON_ORBIT, 200, 1)[0, -1]
    up = sweep(near, first, 150, 30, follow="up")
    last = rest[-1, -1]
    down = sweep(near, last, 150, 30, follow="down")
    bracket = jump(lanes, settle)
    basins = {omega: basin(omega, side, 120) for omega in (4.55, 4.58)}
    figure = canvas(10, 8)
    upper, lower = figure.subfigures(2, 1)
    diagrams(upper.subplots(1, 2), values, rest, near, up, down)
    for ax, (omega, inside) in zip(lower.subplots(1, 2), basins.items(), strict=True):
        draw_basin(ax, omega, inside)
    figure.suptitle(
        "Belt friction, case 2: a diagram shows the attractor its initial state leads to"
    )
    return figure, table(near, rest, values, up, down, bracket)


def diagrams(axes, values, rest, near, up, down):
    """The diagram from rest, and beside it each attractor followed."""
    ax, zoom = axes
    dots(ax, values, rest[..., 0])
    entitle(ax, "every ω from (0, 0)")
    dots(zoom, near, down[..., 0], color=ORANGE, label="the other one followed down from 4.7")
    dots(zoom, near, up[..., 0], color=BLUE, label="orbit followed up from 4.45")
    entitle(zoom, "each attractor followed: they coexist")
    for each, ends in ((ax, ENDS), (zoom, CLOSE)):
        each.axvline(JUMP, color=VERMILLION, lw=0.9, ls="--", label="jump from (0, 0), 4.5638")
        each.axvline(GRAZING, color=BLACK, lw=0.9, ls=":", label="the orbit grazes, 4.6526")
        each.set(xlim=ends, xlabel="forcing frequency ω", ylabel="x once a period")
        each.set_ylim(0.06, 0.21)
        each.legend(fontsize="small", loc="upper left", markerscale=8, framealpha=1)


def draw_basin(ax, omega, inside):
    """Which initial states lead to which attractor, at one frequency."""
    ax.imshow(
        inside,
        origin="lower",
        extent=(*WINDOW[0], *WINDOW[1]),
        aspect="auto",
        cmap=ListedColormap([ORANGE, SKY]),
        interpolation="nearest",
        vmin=0,
        vmax=1,
    )
    ax.plot(0, 0, "*", color="white", mec=BLACK, mew=0.8, ms=11, label="(0, 0)")
    ax.plot(*ON_ORBIT, "o", color="white", mec=BLACK, ms=6, label="the orbit")
    ax.plot([], [], "s", color=SKY, label="leads to the orbit")
    ax.plot([], [], "s", color=ORANGE, label="leads to chaos")
    ax.set(xlabel="initial displacement x", ylabel="initial velocity ẋ")
    ax.legend(fontsize="small", loc="lower right", framealpha=1)
    entitle(ax, f"ω = {omega}: (0, 0) is {'in' if omega < JUMP else 'out'}side the orbit's basin")


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
