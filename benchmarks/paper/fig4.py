"""Fig. 4: one-sided orbits of the SD oscillator, harmonic balance against integration.

Frequencies enter; phase portraits leave, on either side of the gap between the two values at which
the orbit grazes x = 0. Between them there is no one-sided orbit.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.bifurcations import sd
from benchmarks.paper.canvas import BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILLION, canvas, entitle
from benchmarks.paper.table import Row

TITLE = "Fig. 4: one-sided period-1 orbits of the SD oscillator, α = 0, f0 = 0.25, ζ = 0.0141"
# The last of the lower and the first of the upper ones are six digits short of grazing.
LOWER, UPPER = (0.6, 0.7, 0.8, 0.866716), (1.117143, 1.15, 1.2, 1.3)
# Exact: the amplitude f0/√((1−Ω²)² + (2ζΩ)²) is 1.
GRAZING = {0.84: ("0.86672", 0.866716581971234), 1.15: ("1.1172", 1.117142393133526)}
TITLES = ("up to grazing at Ω = 0.866717", "down to grazing at Ω = 1.117142")
HARMONICS, CIRCLES = 3, 24
COLORS = (BLUE, GREEN, ORANGE, VERMILLION, PURPLE)


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


def make():
    """The figure and the rows of its table."""
    values = np.array(LOWER + UPPER)
    size = response(values).real  # in phase below resonance, against it above
    circles, lines, distance, amplitude, result = orbits(jnp.asarray(values), jnp.asarray(size))
    assert np.all(result == jf.RESULTS.successful)
    figure = canvas(9, 4.6)
    axes = figure.subplots(1, 2, sharey=True)
    for i, omega in enumerate(values):
        ax, color = axes[int(i >= len(LOWER))], COLORS[i % len(LOWER)]
        ax.plot(*lines[i].T, color=color, lw=1.2, label=f"Ω = {omega:.7g}")
        ax.plot(*circles[i].T, "o", ms=4.5, mfc="none", color=color)
    for ax, text in zip(axes, TITLES, strict=True):
        ax.axvline(0, color=BLACK, lw=0.8, ls="--")
        ax.legend(fontsize="small", loc="upper right")
        ax.set(xlabel="displacement x", xlim=(-0.1, 2.75), ylim=(-1.2, 1.7))
        entitle(ax, text)
    axes[0].set_ylabel("velocity dx/dτ")
    figure.suptitle("SD oscillator about x = 1: harmonic balance (circles) on integration (lines)")
    return figure, table(values, amplitude, distance)


def table(values, amplitude, distance):
    """The rows of its table."""
    rows = []
    for near, (paper, exact) in GRAZING.items():
        why = "the paper also prints 0.8667 and 0.86667; the last is a misprint" * (near < 1)
        found = float(sd(near).value)
        rows.append(Row("grazing Ω", paper, found, exact, why, 15))
    for omega, found in zip(values, np.asarray(amplitude), strict=True):
        exact = float(abs(response(omega)))
        rows.append(Row(f"amplitude in harmonic balance, Ω = {omega:.7g}", "", found, exact))
    what = "harmonic balance to integration"
    rows.append(
        Row(
            what,
            "",
            float(distance.max()),
            0.0,
            "largest distance; rounding, as the series is exact",
            1,
        )
    )
    return rows
