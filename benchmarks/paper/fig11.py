"""Fig. 11: chaos of the belt, case 2: its portrait and section at ω = 4.6, and the exponents.

Exact exponents have λ2 = −∞ wherever the motion sticks. The paper smooths sgn by arctan; a layer
displaces what it smooths, by its tail: arctan(w/width) damps far from the belt too. In the same
batches run lanes at ω = 4.6 and 4.56, for sharp numbers. Frequencies enter; spectra leave.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.paper.canvas import BLACK, BLUE, DOTS, VERMILLION, canvas, entitle
from benchmarks.paper.spectra import change_on_doubling, mean_of, spectra
from benchmarks.paper.table import Row

TITLE = "Fig. 11: chaos of the belt, case 2, γ1 = 0, γ2 = 10000"
CHAOS, QUIET = 4.6, 4.56
ON_ORBIT = np.array([0.1483395597, 0.35818994986])  # at QUIET
LONG = {"periods": 500, "transient": 300}
# 800 steps a period resolve a layer of 0.01: see the table. In it one direction contracts at a rate
# of 2μg/(π·width) = 375: orthonormalised 32 times a period, λ2 stays above rounding.
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
    figure = canvas(9.5, 9)
    top, below = figure.subfigures(2, 1, height_ratios=(1, 1.4))
    portrait_and_section(top.subplots(1, 2))
    axes = below.subplots(2, 1, sharex=True, sharey=True)
    titles = (
        f"(c) exact, {long['periods']} periods after {long['transient']}; λ2 = −∞ where it sticks",
        f"(d) sgn w → (2/π) arctan(w/{WIDTH}), w = ẋ − v: {short['periods']} periods of {steps} "
        f"steps after {short['transient']}; λ2 of chaos is below",
    )
    for ax, text, v, found in zip(
        axes, titles, (values, coarse), (sharp[0], blurred[0]), strict=True
    ):
        jf.plot.lyapunov_exponents(v, found, ax=ax)
        ax.set(xlabel="", ylabel="exponents per unit time", ylim=(-1.0, 0.55))
        ax.legend(fontsize="small", loc="upper left", bbox_to_anchor=(0.28, 1.0))
        entitle(ax, text)
    axes[-1].set_xlabel("forcing frequency ω")
    figure.suptitle("Belt friction, case 2, from (0, 0)")
    return figure, table(values, sharp, coarse, blurred, change, steps)


def portrait_and_section(axes, lanes=64, samples=60):
    """Twelve periods of chaos at CHAOS, and the section of many motions."""
    system = exact(CHAOS)
    period = float(system.period)
    ts = jnp.linspace(200 * period, 212 * period, 6001)
    sol = jf.solve(
        system,
        jnp.zeros(2),
        0.0,
        212 * period,
        period / 40,
        saveat=diffrax.SaveAt(ts=ts),
        max_events=None,
    )
    xs, sticks = np.asarray(sol.xs), np.asarray(sol.modes[:, 0]) == 0
    slips = np.where(sticks[:, None], np.nan, xs)
    sticks[1:] |= sticks[:-1]
    axes[0].plot(*slips.T, color=BLUE, lw=0.7, label="slips")
    axes[0].plot(
        *np.where(sticks[:, None], xs, np.nan).T, color=VERMILLION, lw=3, label="sticks, ẋ = v"
    )
    axes[0].set(xlabel="displacement x", ylabel="velocity ẋ")
    axes[0].legend(fontsize="small", loc="center", bbox_to_anchor=(0.3, 0.6))
    entitle(axes[0], f"(a) chaos at ω = {CHAOS}, 12 periods")
    near = np.array([0.001, 0.01]) * np.arange(lanes)[:, None] / lanes
    section = jf.bifurcation_diagram(
        system, "omega", np.full(lanes, CHAOS), near, transient=300, samples=samples, progress=False
    )
    axes[1].plot(*section.xs.reshape(-1, 2).T, color=BLACK, markersize=1.2, **DOTS)
    axes[1].set(xlabel="displacement x", ylabel="velocity ẋ")
    entitle(axes[1], f"(b) once a period, {lanes} motions")


def onset(values, found):
    """The least value with chaos."""
    return float(values[found.exponents[:, 0] > 0.02].min())


def with_error(spectrum, i):
    """An exponent and its standard error."""
    return f"{float(spectrum.exponents[i]):.4f} ± {float(spectrum.standard_error[i]):.4f}"


def table(values, sharp, coarse, blurred, change, steps):
    """The rows of its table."""
    (found, chaos, quiet), (blurred_found, blurred_chaos, blurred_quiet) = sharp, blurred
    mean, error = mean_of(chaos)
    sticking = found.exponents[found.exponents[:, 0] > 0.02, 1]
    lost = f"−∞ in {np.isneginf(sticking).sum()} of {len(sticking)}"
    damped = float(blurred_quiet.exponents.sum())
    layer = f"a layer of {WIDTH} is another system: its tail damps everywhere"
    turning = "a complex pair turns, which a finite average sees"
    after = "the jump of Fig. 10, where (0, 0) leaves the orbit's basin"
    rows = [
        Row("λ1 at ω = 4.6", "", f"{mean:.4f} ± {error:.4f}", "0.3799(4)"),
        Row("λ2 of chaotic values", "", lost, "−∞"),
        Row("λ1 of the orbit at ω = 4.56", "", with_error(quiet, 0), -0.24525, turning),
        Row("λ2 of it", "", with_error(quiet, 1), -0.24525, turning),
        Row("λ1 + λ2 of it", "", float(quiet.exponents.sum()), -0.4905, "αg exactly", 8),
        Row("chaos, λ1 > 0.02, from", "4.565", onset(values, found), 4.56382205, after, 5),
        Row("the same, smoothed", "", onset(coarse, blurred_found), "", layer, 5),
        Row("λ1 + λ2 of the orbit, smoothed", "", damped, "", layer, 4),
    ]
    if len(blurred_chaos) > 2:
        mean, error = mean_of(blurred_chaos)
        rows.append(Row("λ1 at ω = 4.6, smoothed", "", f"{mean:.3f} ± {error:.3f}", "", layer))
    chaotic = blurred_found.exponents[blurred_found.exponents[:, 0] > 0.02, 1]
    why = "−∞ as the width goes to 0"
    rows.append(Row("λ2 of chaos, smoothed, median", "", float(np.median(chaotic)), "", why, 3))
    what = f"smoothed, {steps} against {2 * steps} steps"
    why = "change of the state after 2 periods: the steps resolve the layer"
    return [*rows, Row(what, "", change, "", why, 1)]
