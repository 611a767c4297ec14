"""`python -m benchmarks.paper fig5`: figures of Santhosh, Narayanan and Padmanabhan (2016), anew.

*Discontinuity induced bifurcations in nonlinear systems*, Procedia IUTAM 19 (2016) 219–227. Each
figure is one function of the arguments that returns a
matplotlib figure; `FIGURES` names them. A picture is written to `--out`, by default into
`benchmarks/results`.
"""

import argparse
import functools as ft
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxfil as jf

RESULTS = Path(__file__).parent / "results"
# Lanes of one call; calls run on all cores.
CHUNK = 64
# Periods averaged over and before. A smoothed system needs many more steps in each: its layer must
# be resolved.
LONG = {"periods": 600, "transient": 400}
SHORT = {"periods": 200, "transient": 150}
OPTIONS = {"xla_cpu_prefer_vector_width": "512"} if jax.default_backend() == "cpu" else None


def spectra(make, values, x0, **counts):
    """`jf.lyapunov_spectrum` of `make(value)` for all values, in chunks over the cores."""
    size = min(CHUNK, len(values))

    def lane(value):
        return jf.lyapunov_spectrum(make(value), x0, **counts)

    run = eqx.filter_jit(ft.partial(jax.vmap(lane)), compiler_options=OPTIONS)
    starts = range(0, len(values), size)
    padded = np.append(values, np.full(size, values[-1]))
    pieces = [jnp.asarray(padded[i : i + size]) for i in starts]
    done = [jax.block_until_ready(run(pieces[0]))]
    with ThreadPoolExecutor() as pool:
        done += pool.map(lambda piece: jax.block_until_ready(run(piece)), pieces[1:])
    return jax.tree.map(lambda *a: np.concatenate(a)[: len(values)], *done)


def exponents(title, rows):
    """A figure with one row for each of (label, values, spectrum)."""
    figure = Figure(figsize=(8, 3 * len(rows)), dpi=110, layout="constrained")
    axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (label, values, found) in zip(axes, rows, strict=True):
        jf.plot.lyapunov_exponents(values, found, ax=ax)
        ax.set_title(label, fontsize="medium", loc="left")
    for ax in axes[:-1]:
        ax.set_xlabel("")
    figure.suptitle(title, fontsize="medium")
    return figure, axes


def fig5(points):
    """Exponents of the discontinuous SD oscillator, ω 0.6–1.3: exact, and arctan for sgn."""
    values = np.linspace(0.6, 1.3, points)

    def exact(omega):
        return jf.systems.SDOscillator(omega=omega)

    x0 = jnp.array([0.3, 0.1])
    rows = [
        ("exact", values, spectra(exact, values, x0, **LONG)),
        (
            "sgn x → (2/π) arctan(x/0.05), 600 steps a period",
            values,
            spectra(lambda w: jf.smoothed(exact(w), 0.05), values, x0, steps=600, **SHORT),
        ),
    ]
    figure, axes = exponents("SD oscillator, f₀ = 0.25, ζ = 0.0141, from (0.3, 0.1)", rows)
    axes[-1].set_xlabel("Ω")
    return figure


def fig11c(points):
    """Exponents of belt friction, case 2, ω 4.2–4.7: exact, and arctan for sgn."""
    values = np.linspace(4.2, 4.7, points)

    def exact(omega):
        return jf.systems.BeltFriction(omega=omega)

    x0 = jnp.zeros(2)
    rows = [
        ("exact: λ₂ = −∞ wherever the motion sticks", values, spectra(exact, values, x0, **LONG)),
        (
            "sgn w → (2/π) arctan(w/0.03), 400 steps a period: λ₂ where rounding resolves it",
            values,
            spectra(lambda w: jf.smoothed(exact(w), 0.03), values, x0, steps=400, **SHORT),
        ),
    ]
    figure, axes = exponents("Belt friction, case 2, from (0, 0)", rows)
    for ax in axes:
        ax.set_ylim(-1.0, 0.7)
    axes[-1].set_xlabel("ω")
    return figure


FIGURES = {"fig5": fig5, "fig11c": fig11c}


def main():
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=__doc__)
    parser.add_argument("figure", choices=FIGURES)
    parser.add_argument("--points", type=int, default=500, help="parameter values (default 500)")
    parser.add_argument("--out", type=Path, help="default: benchmarks/results/FIGURE.png")
    args = parser.parse_args()
    begun = time.perf_counter()
    out = args.out or RESULTS / f"{args.figure}.png"
    FIGURES[args.figure](args.points).savefig(out)
    print(f"{out}: {time.perf_counter() - begun:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
