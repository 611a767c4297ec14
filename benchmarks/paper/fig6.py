"""Fig. 6: motions of the SD oscillator at Ω = 0.7, at grazing and at 0.87; how long chaos lasts.

Frequencies enter; histories of displacement and velocity, phase portraits and a section leave, and
below them the part of many initial states whose motion is still chaotic after N periods. Where a
diagram shows chaos to begin and to end depends on N: it ends for good in a crisis near Ω = 1.13,
and is a transient above. Panels a to f have the letters of the paper.
"""

import functools as ft

import diffrax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.paper import canvas as paper
from benchmarks.paper.fig5 import GRAZING, on_orbit
from benchmarks.paper.sweeps import sweep_of
from benchmarks.paper.table import Row

TITLE = "Fig. 6: motions of the SD oscillator, α = 0, f₀ = 0.25, ζ = 0.0141"
QUIET, CHAOS = 0.7, 0.87
# "Just before grazing" has no number in the paper: this one is ours.
BEFORE = 0.85
CRISIS, CRISIS_IN_PAPER = 1.13, 1.145
# The symmetric orbit that coexists with the one-sided ones at QUIET.
CROSSING = np.array([2.972909733954379342, 0.618617859127108525])
# Periods after which the lanes are looked at, and for how many periods then.
HOLDS = (50, 200, 800, 3200)
LOOK, LONGEST = 32, 12
MEAN_LIFE_AT = 1.145
# From the last crossing of each of 2,048 states by the closed forms of the two pieces, apart from
# jaxfil; nine in a hundred of them end on an orbit of period 8 that goes on crossing.
KNOWN_LIFE = "140 ± 6"
COLORS = (paper.BLUE, paper.ORANGE, paper.GREEN, paper.VERMILLION)
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


def motion(omega, x0, periods, samples=200):
    """Times in periods, and states, of a motion."""
    system = jf.systems.SDOscillator(omega=omega)
    period = float(system.period)
    ts = jnp.linspace(0.0, periods * period, periods * samples + 1)
    saveat = diffrax.SaveAt(ts=ts)
    end, dt = periods * period, period / 40
    run = {"saveat": saveat, "max_events": None, "throw": False}
    sol = jf.solve(system, jnp.asarray(x0), 0.0, end, dt, **run)
    return np.asarray(ts) / period, np.asarray(sol.xs)


def make(around=36, lanes=48, holds=HOLDS, many=2048):
    """The figure and the rows of its table."""
    rng = np.random.default_rng(0)
    ends = np.linspace(0.83, 0.872, around), np.linspace(1.12, 1.16, around)
    both = np.concatenate(ends)
    parts = still_chaotic(both, lanes, holds, rng).mean(axis=-1)
    life = mean_life(many, rng)
    figure = paper.canvas(paper.PAGE, 222)
    axes = figure.subplots(4, 2)
    at_rest(axes[0])
    at_grazing(axes[1])
    attractor(axes[2])
    survivors(axes[3], ends, parts, holds, lanes)
    return figure, table(both, parts, holds, life)


def histories(ax, omega, several, title):
    """Displacement, and thinner the velocity, of motions over four periods."""
    for label, x0, style in several:
        ts, xs = motion(omega, x0, 4)
        ax.plot(ts, xs[:, 0], label=f"x{label}", **style)
        ax.plot(ts, xs[:, 1], label=f"dx/dτ{label}", **style | {"lw": 0.7})
    low, high = ax.get_ylim()
    ax.set(xlabel="τ/T", ylabel="x, dx/dτ", xlim=(0, 4), ylim=(low, high + 0.45 * (high - low)))
    ax.legend(loc="upper center", ncols=2, frameon=False)
    ax.axhline(0, color=paper.BLACK, lw=0.8, ls=":")
    paper.entitle(ax, title)


def plane(ax, several, title):
    """One period of motions, each at its frequency, in the phase plane."""
    for label, omega, x0, style in several:
        ax.plot(*motion(omega, x0, 1)[1].T, label=label, **style)
    ax.axvline(0, color=paper.BLACK, lw=0.8, ls=":")
    ax.set(xlabel="x", ylabel="dx/dτ")
    paper.entitle(ax, title)


def at_rest(axes):
    """The motions at QUIET: the one-sided orbit, and the one that crosses and coexists."""
    (one,) = on_orbit(np.array([QUIET]))
    blue, grey = {"color": paper.BLUE}, {"color": paper.GREY, "ls": "--"}
    several = (("", one, blue), (", coexists", CROSSING, grey))
    histories(axes[0], QUIET, several, f"(a) Ω = {QUIET}: one-sided orbit")
    both = (("one-sided", QUIET, one, blue), ("crossing: coexists", QUIET, CROSSING, grey))
    plane(axes[1], both, "(b) the same")


def at_grazing(axes):
    """The one-sided orbit before and at grazing, its mirror image, and the histories."""
    # A unit of rounding short of grazing: it touches x = 0, and goes through for the next double.
    graze, before = GRAZING - 1e-9, BEFORE
    starts = on_orbit(np.array([before, graze]))
    mirror = on_orbit(np.array([graze]))[0] - np.array([2.0, 0.0])  # −1 + A cos for 1 + A cos
    red = {"color": paper.VERMILLION}
    several = (
        (f"Ω = {before}", before, starts[0], {"color": paper.BLACK}),
        (f"Ω = {GRAZING:.6g}, grazing", graze, starts[1], red),
        ("its mirror image", graze, mirror, {"color": paper.GREY, "ls": "--"}),
    )
    plane(axes[0], several, "(c) before grazing, and at grazing")
    axes[0].set_ylim(-1, 2.4)
    axes[0].legend(loc="upper left", frameon=True, framealpha=1, edgecolor="none")
    title = f"(d) Ω = {GRAZING:.6g}: x and dx/dτ are zero at once"
    histories(axes[1], graze, (("", starts[1], red),), title)


def attractor(axes, lanes=100, samples=100):
    """Sixty periods of chaos, and its section by many motions."""
    _, xs = motion(CHAOS, (0.3, 0.1), 160)
    axes[0].plot(*xs[100 * 200 :].T, color=paper.BLUE, lw=0.3, rasterized=True)
    starts = np.array([0.3, 0.1]) + np.linspace(0, 0.2, lanes)[:, None] * np.array([1.0, 0.0])
    points = sweep(np.full(lanes, CHAOS), starts, 300, samples)
    points = points[chaotic(points[:, -LOOK:, 0])]
    axes[1].plot(*points.reshape(-1, 2).T, **paper.DOTS, color=paper.BLACK, ms=0.7)
    for ax in axes:
        ax.axvline(0, color=paper.BLACK, lw=0.8, ls=":")
        ax.set(xlabel="x", ylabel="dx/dτ")
    paper.entitle(axes[0], f"(e) Ω = {CHAOS}: chaos, 60 periods")
    paper.entitle(axes[1], f"(f) its section, {points.size // 2:,} points")


def survivors(axes, ends, parts, holds, lanes):
    """The part of the states that are chaotic still, with its standard error."""
    titles = (f"(g) added: where chaos begins, {lanes} states", "(h) added: where it ends")
    around = len(ends[0])
    for i, (ax, text) in enumerate(zip(axes, titles, strict=True)):
        label = (f"grazing, {GRAZING:.6f}", f"crisis, {CRISIS}")[i]
        ax.axvline((GRAZING, CRISIS)[i], color=paper.BLACK, lw=0.8, ls=":", label=label)
        for hold, part, color in zip(holds, parts, COLORS, strict=True):
            part = part[i * around : (i + 1) * around]
            error = np.sqrt(part * (1 - part) / lanes)
            style = {"fmt": ".-", "lw": 0.8, "ms": 3, "elinewidth": 0.6, "color": color}
            ax.errorbar(ends[i], part, error, label=f"N = {hold}" * (i == 0) or None, **style)
        ax.set(xlabel="Ω", ylabel="part chaotic after N periods", ylim=(-0.05, (1.08, 1.4)[i]))
        paper.entitle(ax, text)
    axes[1].axvline(CRISIS_IN_PAPER, label=f"the paper's {CRISIS_IN_PAPER}", **paper.PAPER)
    axes[0].legend(loc="upper left", frameon=False)
    axes[1].legend(loc="upper right", frameon=True, framealpha=1, edgecolor="none")
    axes[1].set_xticks([1.12, 1.13, 1.14, 1.15, 1.16])


def table(values, parts, holds, life):
    """The rows of its table."""
    low, high = values < 1, values > 1
    rows = []
    why = "chaos before grazing is a transient: the longer one waits, the later it seems to begin"
    for hold, part in zip(holds, parts, strict=True):
        begins = f"{values[low & (part >= 0.5)].min():.4f}"
        rows.append(Row(f"half of the states chaotic, N = {hold}: from", "", begins, "", why))
    why = "chaos past the crisis is a transient: where it seems to end depends on N"
    for hold, part in zip(holds, parts, strict=True):
        last = values[high & (part >= 0.5)].max()
        ends = f"{'≥ ' if last == values.max() else ''}{last:.4f}"  # the grid may end before
        rows.append(Row(f"half of the states chaotic, N = {hold}: to", "1.145", ends, "1.13", why))
    what = f"mean life of chaos at Ω = {MEAN_LIFE_AT}, periods"
    why = (
        "by the decay of survivors from N = 100 to 400; the reference by closed forms of each piece"
    )
    rows.append(Row(what, "", f"{life[0]:.0f} ± {life[1]:.0f}", KNOWN_LIFE, why))
    return rows
