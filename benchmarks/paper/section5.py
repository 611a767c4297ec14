"""Section 5: the largest exponent of the belt by chaos synchronisation, case 2 at ω = 4.6.

Couplings enter; leaves how near drive and response came at each of a grid, whose first one that
synchronises is the estimate, and the exponent from the rate at which a small distance grows.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.paper import canvas as paper
from benchmarks.paper.spectra import mean_of
from benchmarks.paper.table import Row

TITLE = "Section 5: largest exponent by synchronisation, belt friction, case 2, ω = 4.6"
REFERENCE, ERROR = 0.3799, 0.0004
RATES = {0.0: "0.3796(13)", 0.2: "0.3778(12)", 0.38: "0.3805(13)", 0.6: "0.3823(10)"}


def threshold(couplings, periods):
    """By the smallest coupling that synchronises within `periods` periods."""
    belt = jf.systems.BeltFriction(omega=4.6)
    return jf.synchronization_exponent(
        belt, jnp.zeros(2), jnp.asarray(couplings), periods=periods, transient=200
    )


def rates(couplings, lanes, periods):
    """From the rate at which a small distance grows, (couplings, lanes)."""
    belt = jf.systems.BeltFriction(omega=4.6)
    starts = np.array([0.001, 0.01]) * np.arange(lanes)[:, None] / lanes

    @eqx.filter_jit
    def run(strengths, starts):
        def lane(strength, x0):
            return jf.transverse_exponent(belt, x0, coupling=strength, periods=periods)

        return jax.vmap(lane)(strengths, starts).exponent

    grid = jnp.asarray(np.repeat(couplings, lanes))
    found = run(grid, jnp.asarray(np.tile(starts, (len(couplings), 1))))
    return np.asarray(found).reshape(len(couplings), lanes)


def make(couplings=None, periods=1500, lanes=16, rate_periods=1000):
    """The figure and the rows of its table."""
    couplings = np.round(np.arange(0.30, 0.505, 0.01), 2) if couplings is None else couplings
    by_threshold = threshold(couplings, periods)
    by_rate = [mean_of(row) for row in rates(list(RATES), lanes, rate_periods)]
    figure = paper.canvas(paper.PAGE, 84)
    left, right = figure.subplots(1, 2)
    distances, met = np.asarray(by_threshold.distances), np.asarray(by_threshold.synchronized)
    for keep, style, label in (
        (~met, {"marker": "o", "mfc": "none"}, "not synchronised"),
        (met, {"marker": "o"}, "synchronised"),
    ):
        marked = {"ls": "none", "color": paper.BLUE, **style}
        left.semilogy(couplings[keep], distances[keep], label=label, **marked)
    met_at = float(by_threshold.tolerance)
    left.axhline(
        met_at,
        color=paper.BLACK,
        lw=0.8,
        ls=":",
        zorder=1,
        label="tolerance: counts as synchronised",
    )
    known = f"λ₁ = {REFERENCE}({round(ERROR * 1e4)})"
    left.axvline(REFERENCE, color=paper.GREEN, zorder=1, label=known)
    left.set(xlabel="coupling ε, 1/s", ylabel="smallest distance")
    left.set_xticks([0.3, 0.35, 0.4, 0.45, 0.5])
    paper.below(figure, left.get_legend_handles_labels()[0], 4)
    paper.entitle(left, f"(a) by threshold: runs of up to {float(by_threshold.time):,.0f} s")
    means, errors = np.transpose(by_rate)
    right.axhspan(REFERENCE - ERROR, REFERENCE + ERROR, color=paper.GREEN, alpha=0.4, lw=0)
    right.errorbar(list(RATES), means, errors, fmt="o", color=paper.BLUE, capsize=2)
    right.set(xlabel="coupling ε, 1/s", ylabel="λ₁ = rate + ε, 1/s")
    right.set_ylim(REFERENCE - 0.01, REFERENCE + 0.016)
    paper.entitle(right, "(b) added: by the rate of growth")
    return figure, table(by_threshold, by_rate, couplings)


def deviation(mean, error):
    """How many standard errors a value lies from λ₁."""
    return f"{(mean - REFERENCE) / np.hypot(error, ERROR):+.1f} σ from {REFERENCE}".replace(
        "-", "−"
    )


def table(by_threshold, by_rate, couplings):
    """The rows of its table."""
    step, bias = float(couplings[1] - couplings[0]), float(by_threshold.bias)
    found = float(by_threshold.exponent)
    why = f"known to about ±0.02, and {bias:.3f} above λ₁ on average: a grid of {step:.2g}, a "
    why += "finite time; chaos decides which of its neighbours is the first, so nearer is luck"
    known = f"{REFERENCE}({round(ERROR * 1e4)})"
    rows = [Row("λ₁ by the smallest ε that synchronises", "", found, known, why, 4)]
    for (strength, reference), (mean, error) in zip(RATES.items(), by_rate, strict=True):
        what = f"λ₁ = rate + ε at ε = {strength:g}"
        rows.append(Row(what, "", f"{mean:.4f} ± {error:.4f}", reference, deviation(mean, error)))
    why = "the paper's eq. 16 has x1, x2 in the response's force: it must be x3, x4"
    return [*rows, Row("λ₁ by the variational equation", "", "0.3799, see fig11", known, why)]
