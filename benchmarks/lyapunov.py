"""`python -m benchmarks.lyapunov`: what Lyapunov exponents cost, and what smoothing does to them.

Prints a table of lane-periods per second of each method and its cost relative to plain integration
of the same lanes at the same steps; then one of the exponents of each smoothed system as the width
goes to zero, with the steps they need. `--only` picks one part. Compilation is left out.
"""

import argparse
import functools as ft
import sys
import time

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.table import Column, table

# System, its frequencies, initial state, and couplings at which drive and response neither meet,
# which would end a lane, nor run away from each other without bound.
SCENES = {
    "belt": (jf.systems.BeltFriction, (4.2, 4.7), (0.0, 0.0), (-1.0, -0.9)),
    "sd": (jf.systems.SDOscillator, (0.6, 1.3), (0.3, 0.1), (-0.014, -0.0139)),
}
# Vectors as wide as the machine has them, as `jaxfil.bifurcation_diagram` uses them.
OPTIONS = {"xla_cpu_prefer_vector_width": "512"} if jax.default_backend() == "cpu" else None
RATES = (
    Column("scene"),
    Column("method"),
    Column("lane-periods/s", ">,.0f"),
    Column("µs each", ">.2f"),
    Column("of plain", ">.2f"),
    Column("first call s", ">.0f"),
)
WIDTHS = (
    Column("width", ">"),
    Column("λ1"),
    Column("steps a period", ">"),
    Column("µs a lane-period", ">.2f"),
)
# System, frequency, a factor of the steps, and the widths of its layer.
STUDIES = (
    ("sd", 0.87, 8.0, (0.3, 0.1, 0.03, 0.01, 0.003)),
    ("belt", 4.6, 4.0, (0.1, 0.03, 0.01)),
)


def over(function, make, values):
    """`function(make(value))` for all values side by side, compiled for this machine's vectors."""
    compiled = eqx.filter_jit(
        lambda values: eqx.filter_vmap(lambda value: function(make(value)))(values),
        compiler_options=OPTIONS,
    )
    return ft.partial(compiled, values)


def measure(run, repeats):
    """Processor seconds of a later call (the least of several), and wall seconds of the first."""
    begun = time.perf_counter()
    jax.block_until_ready(run())
    first = time.perf_counter() - begun
    spent = []
    for _ in range(repeats):
        begun = time.process_time()
        jax.block_until_ready(run())
        spent.append(time.process_time() - begun)
    return min(spent), first


def plain(system, x0, periods, steps):
    """The state after some periods, and nothing else."""
    duration, dt = periods * system.period, system.period / steps
    sol = jf.solve(system, x0, 0.0, duration, dt, max_events=None, throw=False)
    return sol.x_final


def methods(x0, couplings, periods, steps):
    """Name -> (function of a system, lane-periods it runs)."""
    common = dict(steps=steps, transient=0)
    return {
        "plain integration": (lambda s: plain(s, x0, periods, steps), periods),
        "variational, all exponents": (
            lambda s: jf.lyapunov_spectrum(s, x0, periods=periods, **common),
            periods,
        ),
        "synchronisation, rate": (
            lambda s: jf.transverse_exponent(s, x0, coupling=0.2, periods=periods, **common),
            periods,
        ),
        "synchronisation, threshold": (
            lambda s: jf.synchronization_exponent(s, x0, couplings, periods=periods, **common),
            periods * couplings.size,
        ),
    }


def rates(args):
    """The table of what each method costs."""
    body = []
    for name, (system, ends, start, couplings) in SCENES.items():
        values, base = jnp.linspace(*ends, args.lanes), None
        x0, four = jnp.array(start), jnp.linspace(*couplings, 4)
        for method, (function, periods) in methods(x0, four, args.periods, args.steps).items():
            make = ft.partial(_at, system)
            spent, first = measure(over(function, make, values), args.repeats)
            each = spent / (periods * args.lanes)
            base = base or each
            body.append([name, method, 1 / each, each * 1e6, each / base, first])
            print(f"rates: {name}, {method}", file=sys.stderr, flush=True)
    size = f"{args.lanes} lanes, {args.periods} periods of {args.steps} steps of Dopri8, one core"
    return table(RATES, body, f"{COST}\n{size}")


COST = "Processor time of exponents; a threshold is that of one coupling of four."


def _at(system, omega):
    """The system at a frequency."""
    return system(omega=omega)


def finest(width, scale):
    """Steps a period that resolve a layer of that width, at which sides differ by `scale` per unit
    time: an explicit method needs dt < 3·width/scale, and accuracy somewhat less."""
    return int(max(40, np.ceil(scale / width)))


def widths(args, name, omega, scale, layers):
    """The table of one system smoothed over layers of several widths."""
    system, _, start, _ = SCENES[name]
    x0 = jnp.array(start) + 0.01 * jnp.arange(args.study_lanes)[:, None]
    exact = system(omega=omega)
    settings = [("exact", exact, 40)]
    settings += [(f"{w:g}", jf.smoothed(exact, w), finest(w, scale)) for w in layers]
    body = []
    for label, case, steps in settings:
        # Without OPTIONS: the times are those that a user's own jit has.
        run = ft.partial(eqx.filter_jit(spectra), case, x0, args.study_periods, steps)
        spent, _ = measure(run, 1)
        each = spent / (1.25 * args.study_periods * args.study_lanes)
        body.append([label, chaos(np.asarray(run().exponents[:, 0])), steps, each * 1e6])
        print(f"widths: {name}, {label}", file=sys.stderr, flush=True)
    periods = f"{args.study_periods} periods after {args.study_periods // 4}"
    size = f"{args.study_lanes} initial states, {periods}"
    return table(WIDTHS, body, f"{name} at ω = {omega}: sgn H is (2/π) arctan(H/width), {size}")


def chaos(found):
    """The mean of the largest exponents of those lanes that are chaotic: a periodic orbit
    coexists."""
    chaotic = found[found > 0]
    if chaotic.size < 2:
        return f"largest is {found.max():.5f}: all lanes periodic"
    error = np.std(chaotic) / np.sqrt(chaotic.size - 1)
    return f"{np.mean(chaotic):.5f} ± {error:.5f}, {chaotic.size} lanes chaotic"


def spectra(system, x0, periods, steps):
    """Spectra from all initial states, a quarter of the periods left out before."""

    def one(x):
        return jf.lyapunov_spectrum(
            system,
            x,
            periods=periods,
            transient=periods // 4,
            steps=steps,
            stepper=diffrax.Dopri8(),
        )

    return jax.vmap(one)(x0)


def main():
    """Print the tables asked for."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lyapunov", description=__doc__)
    parser.add_argument("--only", choices=("rates", "widths"))
    parser.add_argument("--lanes", type=int, default=1024)
    parser.add_argument("--study-lanes", type=int, default=64, help="initial states of the study")
    parser.add_argument("--study-periods", type=int, default=400, help="periods of the study")
    parser.add_argument("--periods", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=2)
    args = parser.parse_args()
    if args.only != "widths":
        print(rates(args), end="\n\n")
    if args.only != "rates":
        print(*(widths(args, *study) for study in STUDIES), sep="\n\n")


if __name__ == "__main__":
    main()
