"""Fig. 11: the belt, case 2: its orbit at ω = 4.56, chaos at 4.565, and the exponents.

Panels a, b and c have the letters of the paper; the others are added. Exact exponents have λ₂ = −∞
wherever the motion sticks. Smoothed by arctan, as the paper's Fig. 5 is with a width that it does
not state, they are others: arctan(w/width) damps far from the belt too. In the same batches run
lanes at ω = 4.6 and 4.56, for sharp numbers. Frequencies enter; spectra leave.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import MaxNLocator

import jaxfil as jf
from benchmarks.paper import canvas as paper
from benchmarks.paper.spectra import change_on_doubling, mean_of, spectra
from benchmarks.paper.table import Row

TITLE = "Fig. 11: chaos of the belt, case 2, γ₁ = 0, γ₂ = 10000"
# The paper's chaos is at JUMPED; CHAOS is where the exponent is known.
JUMPED, CHAOS, QUIET = 4.565, 4.6, 4.56
ON_ORBIT = np.array([0.1483395597, 0.35818994986])  # at QUIET
TOP = 0.91797746369765  # the largest velocity of the orbit at QUIET
LONG = {"periods": 500, "transient": 300}
# 800 steps a period resolve a layer of 0.01: see the table. In it one direction contracts at a rate
# of 2μg/(π·width) = 375: orthonormalised 32 times a period, λ₂ stays above rounding.
WIDTH = 0.01
SHORT = {"periods": 100, "transient": 100, "steps": 800, "parts": 32}


def exact(omega):
    """The belt of case 2."""
    return jf.systems.BeltFriction(omega=omega)


def smooth(omega):
    """The same, smoothed."""
    return jf.smoothed(exact(omega), WIDTH)


def batch(system, values, chaotic, counts):
    """Spectra at all values from (0, 0); the largest exponents at CHAOS from states near it; and
    the spectrum of the orbit at QUIET."""
    near = np.array([0.001, 0.01]) * np.arange(chaotic)[:, None] / max(chaotic, 1)
    states = np.concatenate([np.zeros((len(values), 2)), near, ON_ORBIT[None]])
    lanes = np.concatenate([values, np.full(chaotic, CHAOS), [QUIET]])
    found = spectra(system, lanes, states, **counts)
    sharp = found.exponents[len(values) : -1, 0]
    swept, orbit = (jax.tree.map(lambda a, i=i: a[i], found) for i in (slice(len(values)), -1))
    return swept, sharp[sharp > 0.03], orbit


def make(points=500, blurred_points=119, chaotic=75, long=LONG, short=SHORT):
    """The figure and the rows of its table."""
    values, coarse = np.linspace(4.2, 4.7, points), np.linspace(4.2, 4.7, blurred_points)
    sharp = batch(exact, values, chaotic, long)
    blurred = batch(smooth, coarse, chaotic // 9, short)
    steps = short["steps"]
    change = change_on_doubling(smooth, np.linspace(4.2, 4.7, 32), jnp.zeros(2), steps)
    figure = paper.canvas(paper.PAGE, 222)
    top, below = figure.subfigures(2, 1, height_ratios=(1, 1.35))
    portraits(top.subplots(1, 3))
    exponents(below.subplots(3, 1, sharex=True), values, sharp[0], coarse, blurred[0])
    return figure, table(values, sharp, coarse, blurred, change, steps)


def exponents(axes, values, found, coarse, blurred):
    """The largest one as the paper has it, then both, exact and smoothed."""
    first = axes[0]
    first.axhline(0, color=paper.BLACK, lw=0.5)
    first.plot(values, found.exponents[:, 0], ".", ms=2.5, color=paper.BLUE)
    first.axvline(JUMPED, label="the paper's 4.565", **paper.PAPER)
    first.legend(loc="upper left", frameon=False)
    for ax, v, one in ((axes[1], values, found), (axes[2], coarse, blurred)):
        jf.plot.lyapunov_exponents(v, one, ax=ax, ms=2)
        for marks in ax.lines:
            if marks.get_marker() == "|":  # one in six, pointing down: no solid bar
                marks.set(marker="v", markersize=3, markevery=6)
        ax.set(xlabel="", ylim=(-1.0, 0.55))
        ax.legend(loc="lower left", ncols=4, frameon=False, markerscale=2)
    titles = (
        "(c) the largest exponent, from (0, 0)",
        "(e) added: both; λ₂ = −∞ where the motion sticks",
        f"(f) added: both, with sgn w smoothed to (2/π) arctan(w/{WIDTH}), w = ẋ − v; "
        "λ₂ of chaos is below",
    )
    for ax, text in zip(axes, titles, strict=True):
        ax.set_ylabel("exponent, 1/s")
        paper.entitle(ax, text)
    axes[-1].set_xlabel("ω, rad/s")


def motion(omega, x0, first, last):
    """States and modes from one period to another."""
    system = exact(omega)
    period = float(system.period)
    ts = jnp.linspace(first * period, last * period, 500 * (last - first) + 1)
    run = {"saveat": diffrax.SaveAt(ts=ts), "max_events": None}
    sol = jf.solve(system, jnp.asarray(x0), 0.0, last * period, period / 40, **run)
    return np.asarray(sol.xs), np.asarray(sol.modes[:, 0])


def portraits(axes, lanes=64, samples=60):
    """The orbit at QUIET, twelve periods of chaos at JUMPED, and its section of many motions."""
    drawn = ((QUIET, ON_ORBIT, 0, 1), (JUMPED, np.zeros(2), 200, 212))
    for ax, (omega, x0, first, last) in zip(axes, drawn, strict=False):
        xs, modes = motion(omega, x0, first, last)
        ax.axhline(1, color=paper.BLACK, lw=0.8, ls=":")
        for mode, color in paper.SLIPS.items():
            held = modes == mode
            if held.any():
                held[:-1] |= held[1:]  # up to the contact with the next piece
                width = 3 if mode == 0 else 0.6
                label = {-1: "slips", 1: "slips, ẋ > v", 0: "sticks"}[mode]
                part = np.where(held[:, None], xs, np.nan)
                ax.plot(*part.T, color=color, lw=width, label=label, solid_capstyle="butt")
    paper.entitle(axes[0], f"(a) period 1, ω = {QUIET}")
    axes[0].annotate(f"max ẋ = {TOP:.3f}", (-0.03, 0.92), (-0.1, 0.65))
    paper.entitle(axes[1], f"(b) chaos, ω = {JUMPED}")
    handles, labels = axes[1].get_legend_handles_labels()
    axes[0].legend(handles, labels, loc="center", bbox_to_anchor=(0.38, 0.48), frameon=False)
    axes[2].xaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5]))
    near = np.array([0.001, 0.01]) * np.arange(lanes)[:, None] / lanes
    values = np.full(lanes, JUMPED)
    run = {"transient": 300, "samples": samples, "progress": False}
    xs = jf.bifurcation_diagram(exact(JUMPED), "omega", values, near, **run).xs
    xs = xs[xs[:, -1, 0] < 0.11]  # those that are not on the orbit, which coexists
    axes[2].plot(*xs.reshape(-1, 2).T, color=paper.BLACK, ms=1, **paper.DOTS)
    axes[1].plot(*xs[:, -1].T, color=paper.BLACK, markersize=1.5, zorder=5, **paper.DOTS)
    paper.entitle(axes[2], "(d) added: its section")
    for ax in axes:
        ax.set(xlabel="x, m", ylabel="ẋ, m/s")


def top():
    """The largest velocity on the orbit at QUIET."""
    orbit = jf.periodic_orbit(exact(QUIET), jnp.asarray(ON_ORBIT), transient=0)
    return float(orbit.extremes()[1][1])


def onset(values, found):
    """The least value with chaos."""
    return float(values[found.exponents[:, 0] > 0.02].min())


def with_error(spectrum, i):
    """An exponent and its standard error."""
    value, error = float(spectrum.exponents[i]), float(spectrum.standard_error[i])
    return f"{value:.4f} ± {error:.4f}".replace("-", "−")


def table(values, sharp, coarse, blurred, change, steps):
    """The rows of its table."""
    (found, chaos, quiet), (blurred_found, blurred_chaos, blurred_quiet) = sharp, blurred
    mean, error = mean_of(chaos)
    sticking = found.exponents[found.exponents[:, 0] > 0.02, 1]
    lost = f"−∞ in {np.isneginf(sticking).sum()} of {len(sticking)}"
    damped = float(blurred_quiet.exponents.sum())
    layer = f"a layer of {WIDTH} is another system: its tail damps everywhere"
    turning = "a complex pair turns, which a finite average sees"
    below = "the belt has 1: a slight increase of ω makes no grazing; that is at 4.6526"
    after = "the jump of Fig. 10, where (0, 0) leaves the orbit's basin"
    rows = [
        Row("λ₁ at ω = 4.6", "", f"{mean:.4f} ± {error:.4f}", "0.3799(4)"),
        Row("λ₂ of chaotic values", "", lost, "−∞"),
        Row("max ẋ of the orbit at ω = 4.56", "", top(), TOP, below, 7),
        Row("λ₁ of the orbit at ω = 4.56", "", with_error(quiet, 0), -0.24525, turning),
        Row("λ₂ of it", "", with_error(quiet, 1), -0.24525, turning),
        Row("λ₁ + λ₂ of it", "", float(quiet.exponents.sum()), -0.4905, "αg exactly", 8),
        Row("chaos, λ₁ > 0.02, from", "4.565", onset(values, found), 4.56382205, after, 5),
        Row("the same, smoothed", "", onset(coarse, blurred_found), "", layer, 5),
        Row("λ₁ + λ₂ of the orbit, smoothed", "", damped, "", layer, 4),
    ]
    if len(blurred_chaos) > 2:
        mean, error = mean_of(blurred_chaos)
        rows.append(Row("λ₁ at ω = 4.6, smoothed", "", f"{mean:.3f} ± {error:.3f}", "", layer))
    chaotic = blurred_found.exponents[blurred_found.exponents[:, 0] > 0.02, 1]
    why = "−∞ as the width goes to 0"
    rows.append(Row("λ₂ of chaos, smoothed, median", "", float(np.median(chaotic)), "", why, 3))
    what = f"smoothed, {steps} against {2 * steps} steps"
    why = "change of the state after 2 periods: the steps resolve the layer"
    return [*rows, Row(what, "", change, "", why, 1)]
