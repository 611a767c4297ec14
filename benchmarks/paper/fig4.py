"""Fig. 4: bifurcation diagram of the SD oscillator with its harmonic balance.

Frequencies enter; the diagram leaves, with harmonic balance as circles on both one-sided period-1
orbits, x and its mirror image, and the periods of its windows. Below it are phase portraits of the
one-sided orbit on either side of the gap between the two values at which it grazes x = 0. Between
them there is no one-sided orbit.
"""

import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.lines import Line2D

import jaxfil as jf
from benchmarks.bifurcations import sd
from benchmarks.paper import canvas as paper
from benchmarks.paper.sweeps import sweep_of
from benchmarks.paper.table import Row

TITLE = "Fig. 4: bifurcation diagram of the SD oscillator, α = 0, f₀ = 0.25, ζ = 0.0141"
ENDS, STARTS = (0.6, 1.3), ((0.3, 0.1), (1.4, 0.0))
# The last of the lower and the first of the upper ones are six digits short of grazing.
LOWER, UPPER = (0.6, 0.7, 0.8, 0.866716), (1.117143, 1.15, 1.2, 1.3)
# Exact: the amplitude f₀/√((1−Ω²)² + (2ζΩ)²) is 1.
GRAZING = {0.84: ("0.86672", 0.866716581971234), 1.15: ("", 1.117142393133526)}
CRISIS_IN_PAPER = 1.145
# At most so many windows of another period are labelled in the diagram, the widest first, so far
# apart, and of so many values at least.
WINDOWS, ROOM, FEWEST = 8, 0.03, 4
TITLES = ("(b) added: up to grazing at Ω = 0.866717", "(c) added: from grazing at Ω = 1.117142")
HARMONICS, CIRCLES = 3, 24
# From far away to grazing, which is black here and there.
COLORS = (paper.PURPLE, paper.GREEN, paper.ORANGE, paper.BLACK)


def response(omega, f0=0.25, zeta=0.0141):
    """The complex amplitude of the linear motion about x = 1."""
    return f0 / (1 - omega**2 + 2j * zeta * omega)


@eqx.filter_jit
@eqx.filter_vmap
def orbits(omega, amplitude):
    """By harmonic balance: circles (k, 2); by integration of one period from its x(0), and the
    distance between the two there; the series' largest amplitude in x."""
    system = jf.systems.SDOscillator(omega=omega)

    def guess(t):
        turn = omega * t
        return jnp.stack([1 + amplitude * jnp.cos(turn), -amplitude * omega * jnp.sin(turn)])

    series = jf.harmonic_balance(system, guess, HARMONICS, throw=False)
    ts = jnp.linspace(0, system.period, 8 * CIRCLES + 1)
    sol = jf.solve(
        system,
        series.evaluate(0.0),
        0.0,
        system.period,
        system.period / 40,
        saveat=diffrax.SaveAt(ts=ts),
        throw=False,
    )
    circles = jax.vmap(series.evaluate)(ts)
    distance = jnp.max(abs(circles - sol.xs))
    return circles[:-1:8], sol.xs, distance, series.amplitudes[1, 0], series.result


def diagrams(points, transient=300, followed_transient=100, samples=60):
    """Frequencies, and x once a period from the first of `STARTS` at each, and followed up; and the
    periods after which the followed motion repeats, 0 where it does not."""
    values = np.linspace(*ENDS, points)
    free, one_sided = map(np.array, STARTS)
    system = jf.systems.SDOscillator
    settled = sweep_of(system, values, free, transient, samples)
    run = {"transient": followed_transient, "samples": samples, "follow": "up"}
    followed = jf.bifurcation_diagram(system(), "omega", values, one_sided, progress=False, **run)
    assert followed.successful.all()
    periods = followed.periods()
    return values, settled[..., 0], followed.xs[..., 0], periods


def make(points=1000, circles=17):
    """The figure and the rows of its table."""
    values = np.array(LOWER + UPPER)
    # Circles of the diagram: evenly spaced, and short of grazing.
    grazing = [v for _, v in GRAZING.values()]
    even = np.concatenate([np.linspace(ENDS[0], grazing[0] - 1e-6, circles),
                           np.linspace(grazing[1] + 1e-6, ENDS[1], circles)])  # fmt: skip
    both = np.concatenate([values, even])
    size = response(both).real  # in phase below resonance, against it above
    rings, lines, distance, amplitude, result = orbits(jnp.asarray(both), jnp.asarray(size))
    assert np.all(result == jf.RESULTS.successful)
    figure = paper.canvas(paper.PAGE, 150)
    axes = figure.subplot_mosaic("aa;bc", height_ratios=(1.15, 1))
    frequencies, settled, followed, periods = diagrams(points)
    heights = np.asarray(rings[len(values) :, 0, 0])
    diagram(axes["a"], frequencies, settled, followed, even, heights)
    windows(axes["a"], frequencies, followed, periods)
    for i, omega in enumerate(values):
        ax, color = axes["bc"[int(i >= len(LOWER))]], (COLORS + COLORS[::-1])[i]
        ax.plot(*lines[i].T, color=color, label=f"Ω = {omega:.7g}")
        ax.plot(*rings[i].T, "o", ms=3, mfc="none", mew=0.7, color=color)
    for name, text in zip("bc", TITLES, strict=True):
        ax = axes[name]
        ax.axvline(0, color=paper.BLACK, lw=0.8, ls=":")
        ax.legend(loc="center right", frameon=False)
        ax.set(xlabel="x", ylabel="dx/dτ", xlim=(-0.1, 3.7), ylim=(-1.2, 1.2))
        paper.entitle(ax, text)
    last = float(frequencies[(periods == 0) & (frequencies > GRAZING[1.15][1])].max())
    return figure, table(values, amplitude[: len(values)], distance, last)


def windows(ax, values, followed, periods):
    """The periods of the one-sided orbits and of the widest windows between them."""
    edges = np.flatnonzero(np.diff(periods, prepend=-1, append=-1))
    runs = [(i, j) for i, j in itertools.pairwise(edges) if periods[i] > 0]
    inside = [run for run in runs if 0.87 < values[run[0]] < 1.13 and run[1] - run[0] >= FEWEST]
    shown = []  # the widest, as far as their labels have room
    for i, j in sorted(inside, key=lambda run: run[0] - run[1])[:WINDOWS]:
        if all(abs(values[i] - values[k]) > ROOM for k, _ in shown):
            shown.append((i, j))
    for i, j in [runs[0], *shown, runs[-1]]:
        middle, n = values[(i + j - 1) // 2], periods[i]
        top = 2.35 if (i, j) in shown else followed[(i + j - 1) // 2, 0] + 0.5
        ax.annotate(f"P{n}", (middle, top), ha="center", color=paper.VERMILLION)


def diagram(ax, values, settled, followed, even, heights):
    """The diagram from one state, that of the one-sided orbit followed up, and the circles."""
    before = values < GRAZING[0.84][1]
    paper.dots(ax, values[before], settled[before], color=paper.SKY)
    paper.dots(ax, values, followed)
    circle = {"ls": "none", "marker": "o", "ms": 4, "mfc": "none", "mew": 0.8}
    ax.plot(even, heights, mec=paper.BLUE, clip_on=False, **circle)
    # The mirror image −x(t + T/2) of 1 + A cos Ωt is −1 + A cos Ωt.
    ax.plot(even, heights - 2, mec=paper.GREEN, clip_on=False, **circle)
    for _, value in GRAZING.values():
        ax.axvline(value, color=paper.BLACK, lw=0.8, ls=":")
    ax.axvline(CRISIS_IN_PAPER, **paper.PAPER)
    ax.set(xlim=ENDS, xlabel="Ω", ylabel="x once a period")
    dot = {"ls": "none", "marker": "o", "ms": 3, "mew": 0}
    ax.legend(
        handles=[
            Line2D([], [], color=paper.BLACK, label="one-sided orbit followed up", **dot),
            Line2D([], [], color=paper.SKY, label="from (0.3, 0.1) at every Ω", **dot),
            Line2D([], [], mec=paper.BLUE, label="harmonic balance", **circle),
            Line2D([], [], mec=paper.GREEN, label="its mirror image", **circle),
            Line2D([], [], color=paper.BLACK, lw=0.8, ls=":", label="the orbit grazes x = 0"),
            Line2D([], [], label="the paper's end of chaos", **paper.PAPER),
        ],
        loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3, frameon=False,
    )  # fmt: skip
    paper.entitle(ax, "(a) the one-sided orbit followed up; P: its period in periods of the force")


def table(values, amplitude, distance, last):
    """The rows of its table."""
    rows = []
    for near, (printed, exact) in GRAZING.items():
        why = "the paper also prints 0.8667 and 0.86667; the last is a misprint" * (near < 1)
        found = float(sd(near).value)
        rows.append(Row("grazing Ω", printed, found, exact, why or "not in the paper", 15))
    why = "chaos is a transient above 1.13: here each Ω goes on for 160 periods from the one before"
    rows.append(Row("chaos, followed up: ends at", "1.145", last, 1.13, why, 5))
    for omega, found in zip(values, np.asarray(amplitude), strict=True):
        exact = float(abs(response(omega)))
        rows.append(Row(f"amplitude in harmonic balance, Ω = {omega:.7g}", "", found, exact))
    what, why = "harmonic balance to integration", "largest distance; rounding: the series is exact"
    return [*rows, Row(what, "", float(distance.max()), 0.0, why, 1)]
