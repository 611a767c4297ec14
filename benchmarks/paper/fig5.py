"""Fig. 5: Lyapunov exponents of the SD oscillator against frequency, exact and smoothed.

The paper smooths sgn by arctan and uses Wolf's algorithm; it does not state the width of the arctan
nor the initial states. The exact exponents here have the saltation of every crossing. Assumed are a
start on the one-sided orbit where there is one, a start at (0.3, 0.1) elsewhere, and for the
smoothed system several widths: the Ω at which its one-sided orbit gives way to chaos depends on the
width. In the same batch run lanes at Ω = 0.87, for one sharp number. Frequencies enter; spectra
leave.
"""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.lines import Line2D

import jaxfil as jf
from benchmarks.paper import canvas as paper
from benchmarks.paper.fig4 import response
from benchmarks.paper.spectra import change_on_doubling, mean_of, spectra
from benchmarks.paper.table import Row

TITLE = "Fig. 5: Lyapunov exponents of the SD oscillator, α = 0, f₀ = 0.25, ζ = 0.0141"
X0 = np.array([0.3, 0.1])
CHAOS, GRAZING, GRAZING_ABOVE = 0.87, 0.866716581971234, 1.117142393133526
# Periods averaged over and before.
LONG = {"periods": 500, "transient": 300}
# A smoothed system needs steps that resolve its layer. 300 do that for a layer of 0.05: see the
# table.
WIDTH = 0.05
SHORT = {"periods": 200, "transient": 150, "steps": 300}
# Widths, in units of x, for which the jump from the one-sided orbit is looked for, with as many
# steps for each layer as above; the values of Ω.
WIDTHS = (0.1, 0.05, 0.02, 0.01, 0.005)
NEAR = np.linspace(0.8, 0.88, 81)
PRINTED = {"begins": 0.8667, "ends": 1.145}


def exact(omega):
    """The SD oscillator."""
    return jf.systems.SDOscillator(omega=omega)


def smooth(omega):
    """The same, smoothed."""
    return jf.smoothed(exact(omega), WIDTH)


def on_orbit(values):
    """The state of the one-sided orbit at t = 0, (p, 2), of a harmonic oscillator about x = 1."""
    size = response(values)
    return np.stack([1 + size.real, -values * size.imag], axis=1)


def batch(system, values, chaotic, counts, followed=()):
    """Spectra at all values from X0; the largest exponents at CHAOS from other states, of which
    some lead to a periodic orbit; spectra on the one-sided orbit at the values followed."""
    starts = X0 + 0.01 * np.arange(chaotic)[:, None]
    one_sided = on_orbit(np.asarray(followed)) if len(followed) else np.zeros((0, 2))
    states = np.concatenate([np.tile(X0, (len(values), 1)), starts, one_sided])
    lanes = np.concatenate([values, np.full(chaotic, CHAOS), followed])
    found = spectra(system, lanes, states, **counts)
    n = len(values)
    swept, kept = (
        jax.tree.map(lambda a, s=s: a[s], found) for s in (slice(n), slice(n + chaotic, None))
    )
    sharp = found.exponents[n : n + chaotic, 0]
    return swept, sharp[sharp > 0.03], kept  # fmt: skip


def jump(width, values, periods=100, transient=100):
    """The least of the values at which the smoothed motion from the exact one-sided orbit is
    chaotic; the largest change of the state as steps are doubled."""

    def system(omega):
        return jf.smoothed(exact(omega), width)

    steps = round(SHORT["steps"] * min(WIDTH / width, 4))
    counts = {"periods": periods, "transient": transient, "steps": steps}
    # Above grazing from the orbit at grazing.
    starts = on_orbit(np.minimum(values, GRAZING))
    found = spectra(system, values, starts, **counts).exponents[:, 0]
    change = change_on_doubling(system, values[::8], jnp.asarray(X0), steps)
    return float(values[found > 0.02].min()), change


def edges(values, largest):
    """The least and the largest value with chaos."""
    chaotic = values[largest > 0.02]
    return f"{chaotic.min():.4f} to {chaotic.max():.4f}"


def make(points=500, blurred_points=350, chaotic=76, long=LONG, short=SHORT, widths=WIDTHS):
    """The figure and the rows of its table."""
    values, coarse = np.linspace(0.6, 1.3, points), np.linspace(0.6, 1.3, blurred_points)
    below = values < GRAZING
    found, chaos, followed = batch(exact, values, chaotic, long, values[below])
    blurred = batch(smooth, coarse, chaotic // 6, short)
    change = change_on_doubling(smooth, np.linspace(0.6, 1.3, 32), jnp.array(X0), short["steps"])
    largest = np.concatenate([followed.exponents[:, 0], found.exponents[~below, 0]])
    jumps = {width: jump(width, NEAR) for width in widths}
    figure = paper.canvas(paper.PAGE, 215)
    upper, lower = figure.subfigures(2, 1, height_ratios=(165, 50))
    axes = upper.subplots(3, 1, sharex=True, height_ratios=(1, 1.15, 1.15))
    largest_panel(axes[0], values, largest, found.exponents[:, 0], below)
    for ax, v, one in ((axes[1], values, found), (axes[2], coarse, blurred[0])):
        jf.plot.lyapunov_exponents(v, one, ax=ax, ms=2)
        # λ₂ as a ring: where both are equal, λ₁ lies in it.
        for dots in ax.lines:
            if dots.get_color() == paper.VERMILLION:
                dots.set(markersize=2.8, fillstyle="none", markeredgewidth=0.6)
        ax.set(xlabel="", ylim=(-0.16, 0.13))
        ax.legend(loc="lower left", ncols=3, frameon=False, markerscale=2)
    paper.entitle(axes[1], "(b) λ₁ and λ₂ from (0.3, 0.1) at every Ω")
    paper.entitle(axes[2], f"(c) added: both, with sgn x smoothed to (2/π) arctan(x/{WIDTH})")
    for ax in axes:
        for value in (GRAZING, GRAZING_ABOVE):
            ax.axvline(value, color=paper.BLACK, lw=0.8, ls=":")
        ax.axvline(PRINTED["ends"], **paper.PAPER)
        ax.set_ylabel("exponent per unit of τ")
    axes[-1].set_xlabel("Ω")
    jump_panel(lower.subplots(), jumps)
    rows = table(values, largest, found, chaos, (coarse, *blurred[:2]), change, short["steps"])
    return figure, rows + [jump_row(width, *found) for width, found in jumps.items()]


def jump_panel(ax, jumps):
    """Where the smoothed one-sided orbit gives way to chaos, over the width."""
    values = [value for value, _ in jumps.values()]
    ax.semilogx(list(jumps), values, "o-", ms=4, lw=0.8, color=paper.BLUE)
    ax.axhline(GRAZING, color=paper.BLACK, lw=0.8, ls=":", label="exact orbit grazes, 0.866717")
    ax.set(xlabel="width of the arctan, units of x", ylabel="Ω of the jump", ylim=(0.795, 0.875))
    ax.legend(loc="lower left", frameon=False)
    paper.entitle(ax, "(d) added: smoothed, from the one-sided orbit: first Ω with λ₁ > 0.02")


def jump_row(width, value, change):
    """The row of one width."""
    why = f"a grid of 0.001; the state changes by {change:.0e} in 2 periods as steps are doubled"
    return Row(f"smoothed by {width:g}: one-sided orbit jumps", "0.8667", value, "", why, 4)


def largest_panel(ax, values, largest, free, below):
    """The paper's own: λ₁ of the one-sided orbit, and from (0.3, 0.1) where there is none; hollow
    where (0.3, 0.1) leads elsewhere."""
    ax.axhline(0, color=paper.BLACK, lw=0.5)
    apart = below & (abs(free - largest) > 5e-3)
    ax.plot(values[apart], free[apart], "o", ms=2.5, mfc="none", mew=0.6, color=paper.ORANGE)
    ax.plot(values, largest, ".", ms=2.5, color=paper.BLUE)
    dot = {"ls": "none", "marker": "o", "ms": 3}
    ax.legend(
        handles=[
            Line2D([], [], color=paper.BLUE, label="one-sided orbit followed", **dot),
            Line2D([], [], color=paper.ORANGE, mfc="none", label="from (0.3, 0.1)", **dot),
            Line2D([], [], color=paper.BLACK, lw=0.8, ls=":", label="the orbit grazes x = 0"),
            Line2D([], [], label="the paper's end of chaos, 1.145", **paper.PAPER),
        ],
        loc="upper left", frameon=False,
    )  # fmt: skip
    ax.set(ylim=(-0.03, 0.13), xlim=(values[0], values[-1]))
    paper.entitle(ax, "(a) the largest exponent, exact")


def table(values, largest, found, chaos, smoothed, change, steps):
    """The rows of its table."""
    coarse, smoothed_found, smoothed_chaos = smoothed
    mean, error = mean_of(chaos)
    blurred_mean, blurred_error = mean_of(smoothed_chaos)
    sums = found.exponents.sum(axis=1)
    quiet = found.exponents[values < 0.7]
    first = int(np.argmax(largest > 0.02))  # the jump is between this value and the one before
    jump = f"{values[first - 1 : first + 1].mean():.4f} ± {0.5 * (values[1] - values[0]):.4f}"
    held = "a transient below 0.8667 and above 1.13: see fig6"
    layer = "from (0.3, 0.1), as the row above: a layer of 0.05 is another system"
    resolved = "change of the state after 2 periods: the steps resolve the layer"
    smooth_edges = edges(coarse, smoothed_found.exponents[:, 0])
    smooth_told = f"{blurred_mean:.4f} ± {blurred_error:.4f}"
    return [
        Row("λ₁ jumps, one-sided orbit followed", "0.8667", jump, GRAZING, "a grid of 0.0014"),
        Row("chaos, λ₁ > 0.02, from (0.3, 0.1)", "0.8667 to 1.145",
            edges(values, found.exponents[:, 0]), "0.8667 to 1.13", held),
        Row("the same, smoothed", "", smooth_edges, "", layer),
        Row("λ₁ at Ω = 0.87", "", f"{mean:.5f} ± {error:.5f}", "0.08889(4)"),
        Row("λ₁ at Ω = 0.87, smoothed", "", smooth_told, "", "chaos is the same within the error"),
        Row("λ₁ at Ω = 0.7 and below, median", "", float(np.median(quiet[:, 0])), -0.0141, "", 6),
        Row("λ₂ there, median", "", float(np.median(quiet[:, 1])), -0.0141, "", 6),
        Row("λ₁ + λ₂, largest", "", float(sums.max()), -0.0282, "−2ζ at every Ω", 10),
        Row("λ₁ + λ₂, least", "", float(sums.min()), -0.0282, "", 10),
        Row(f"smoothed, {steps} against {2 * steps} steps", "", change, "", resolved, 1),
    ]  # fmt: skip
