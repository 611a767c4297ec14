"""Fig. 6: motions of the SD oscillator at Ω = 0.7, at grazing and at 0.87; how long chaos lasts.

Frequencies enter; histories, phase portraits and a section leave, and below them the part of many
initial states whose motion is still chaotic after N periods. Where a diagram shows chaos to begin
and to end depends on N: it ends for good in a crisis near Ω = 1.13, and is a transient above.
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
    axes = figure.subplots(4, 2, width_ratios=(1.25, 1))
    motions(axes)
    attractor(axes[2])
    survivors(axes[3], ends, parts, holds, lanes)
    return figure, table(both, parts, holds, life)


def motions(axes):
    """Histories and phase planes at QUIET and at grazing."""
    (one,) = on_orbit(np.array([QUIET]))
    # A unit of rounding short of grazing: it touches x = 0, and goes through for the next double.
    (graze,) = on_orbit(np.array([GRAZING - 1e-9]))
    drawn = (
        (QUIET, "(a)", "(b)", (
            ("one-sided", one, {"color": paper.BLUE}),
            ("crossing: coexists", CROSSING, {"color": paper.GREY, "ls": "--"}),
        )),
        (GRAZING - 1e-9, "(c)", "(d)", (
            ("about x = 1", graze, {"color": paper.BLUE}),
            ("about x = −1", None, {"color": paper.VERMILLION}),
        )),
    )  # fmt: skip
    for (history, plane), (omega, left, right, several) in zip(axes[:2], drawn, strict=True):
        for label, x0, style in several:
            ts, xs = motion(omega, graze if x0 is None else x0, 4)
            if x0 is None:  # its image under x → −x, half a period later
                xs = -np.roll(xs[:-1], 100, axis=0)
                xs = np.append(xs, xs[:1], axis=0)
            history.plot(ts, xs[:, 0], label=label, **style)
            plane.plot(*xs[: len(xs) // 4 + 1].T, **style)
        where = f"Ω = {omega:.6g}" + (", grazing" if omega > QUIET else "")
        history.set(xlabel="t/T", ylabel="x", xlim=(0, 4))
        top = 1.3 * history.get_ylim()[1] - 0.3 * history.get_ylim()[0]
        history.set_ylim(top=top)  # room for the legend
        history.legend(loc="upper center", ncols=2, frameon=False)
        history.axhline(0, color=paper.BLACK, lw=0.8, ls=":")
        plane.axvline(0, color=paper.BLACK, lw=0.8, ls=":")
        plane.set(xlabel="x", ylabel="dx/dτ")
        paper.entitle(history, f"{left} {where}")
        paper.entitle(plane, f"{right} the same")


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
        ax.axvline((GRAZING, 1.13)[i], color=paper.BLACK, lw=0.8, ls=":")
        for hold, part, color in zip(holds, parts, COLORS, strict=True):
            part = part[i * around : (i + 1) * around]
            error = np.sqrt(part * (1 - part) / lanes)
            style = {"fmt": ".-", "lw": 0.8, "ms": 3, "elinewidth": 0.6, "color": color}
            ax.errorbar(ends[i], part, error, label=f"N = {hold}", **style)
        ax.set(xlabel="Ω", ylabel="part chaotic after N periods", ylim=(-0.05, 1.08))
        paper.entitle(ax, text)
    axes[0].legend(loc="upper left", frameon=False)
    axes[1].set_xticks([1.12, 1.13, 1.14, 1.15, 1.16])


def table(values, parts, holds, life):
    """The rows of its table."""
    low, high = values < 1, values > 1
    rows = []
    why = "chaos before grazing is a transient of 10³ to 10⁵ periods"
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
