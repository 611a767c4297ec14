"""Fig. 5: Lyapunov exponents of the SD oscillator against frequency, exact and smoothed.

The paper smooths sgn by arctan and follows Wolf's algorithm; the exact row has the saltation of
every crossing. In the same batch run lanes at Ω = 0.87, for one sharp number. Frequencies enter;
spectra leave.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.paper.canvas import BLACK, canvas, entitle
from benchmarks.paper.spectra import change_on_doubling, mean_of, spectra
from benchmarks.paper.table import Row

TITLE = "Fig. 5: Lyapunov exponents of the SD oscillator, α = 0, f0 = 0.25, ζ = 0.0141"
X0 = np.array([0.3, 0.1])
CHAOS = 0.87
# Periods averaged over and before.
LONG = {"periods": 500, "transient": 300}
# A smoothed system needs steps that resolve its layer. 300 do that for a layer of 0.05: see the
# table.
WIDTH = 0.05
SHORT = {"periods": 200, "transient": 150, "steps": 300}


def exact(omega):
    """The SD oscillator."""
    return jf.systems.SDOscillator(omega=omega)


def smooth(omega):
    """The same, smoothed."""
    return jf.smoothed(exact(omega), WIDTH)


def batch(system, values, chaotic, counts):
    """Spectra at all values from X0, and the largest exponents at CHAOS from other states, of
    which some lead to a periodic orbit."""
    starts = X0 + 0.01 * np.arange(chaotic)[:, None]
    states = np.append(np.tile(X0, (len(values), 1)), starts, axis=0)
    found = spectra(system, np.append(values, np.full(chaotic, CHAOS)), states, **counts)
    sharp = found.exponents[len(values) :, 0]
    return jax.tree.map(lambda a: a[: len(values)], found), sharp[sharp > 0.03]


def edges(values, found):
    """The least and the largest value with chaos."""
    chaotic = values[found.exponents[:, 0] > 0.02]
    return f"{chaotic.min():.4f} to {chaotic.max():.4f}"


def make(points=500, chaotic=76, long=LONG, short=SHORT):
    """The figure and the rows of its table."""
    values = np.linspace(0.6, 1.3, points)
    sharp = batch(exact, values, chaotic, long)
    blurred = batch(smooth, values, chaotic // 6, short)
    change = change_on_doubling(smooth, np.linspace(0.6, 1.3, 32), jnp.array(X0), short["steps"])
    figure = canvas(8.5, 6.4)
    axes = figure.subplots(2, 1, sharex=True, sharey=True)
    titles = (
        f"exact: {long['periods']} periods after {long['transient']}",
        f"sgn x → (2/π) arctan(x/{WIDTH}): {short['periods']} periods of {short['steps']} steps "
        f"after {short['transient']}",
    )
    for ax, text, (found, _) in zip(axes, titles, (sharp, blurred), strict=True):
        jf.plot.lyapunov_exponents(values, found, ax=ax)
        ax.axvline(0.866717, color=BLACK, lw=0.7, ls=":")
        ax.axvline(1.117142, color=BLACK, lw=0.7, ls=":")
        ax.set(xlabel="", ylabel="exponents per unit time", ylim=(-0.16, 0.13))
        entitle(ax, text)
    axes[-1].set_xlabel("forcing frequency Ω")
    figure.suptitle("SD oscillator from (0.3, 0.1); dotted: the one-sided orbit grazes")
    return figure, table(values, sharp, blurred, change, short["steps"])


def table(values, sharp, blurred, change, steps):
    """The rows of its table."""
    (found, chaos), (smoothed_found, smoothed_chaos) = sharp, blurred
    mean, error = mean_of(chaos)
    blurred_mean, blurred_error = mean_of(smoothed_chaos)
    sums = found.exponents.sum(axis=1)
    quiet = found.exponents[values < 0.7]
    held = "a transient below 0.8667 (10³ to 10⁵ periods) and above 1.13: see fig6"
    return [
        Row("λ1 at Ω = 0.87", "", f"{mean:.5f} ± {error:.5f}", "0.08889(4)"),
        Row("λ1 at Ω = 0.7 and below, median", "", float(np.median(quiet[:, 0])), -0.0141, "", 6),
        Row("λ2 there, median", "", float(np.median(quiet[:, 1])), -0.0141, "", 6),
        Row("λ1 + λ2, largest", "", float(sums.max()), -0.0282, "−2ζ at every Ω", 10),
        Row("λ1 + λ2, least", "", float(sums.min()), -0.0282, "", 10),
        Row("chaos, λ1 > 0.02", "0.8667 to 1.145", edges(values, found), "0.8667 to 1.13", held),
        Row(
            "the same, smoothed",
            "",
            edges(values, smoothed_found),
            "",
            "the one-sided orbit meets the layer before it would graze",
        ),
        Row(
            "λ1 at Ω = 0.87, smoothed",
            "",
            f"{blurred_mean:.4f} ± {blurred_error:.4f}",
            "",
            "chaos itself is the same within the error",
        ),
        Row(
            f"smoothed, {steps} against {2 * steps} steps",
            "",
            change,
            "",
            "change of the state after 2 periods: the steps resolve the layer",
            1,
        ),
    ]
