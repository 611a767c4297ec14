"""`python -m benchmarks.stiff`: stiff sides, compliant walls, smoothed relays, and who solves them.

Writes `results/stiff.txt`, five tables, and `results/stability.png`, the error of an explicit and a
linearly implicit method over step and stiffness. Exact answers are sums of exponentials per piece
in 40 digits. Run times are medians of repeated calls, compilation left out.
"""

import functools as ft
import pathlib
import statistics
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks import stability, stiff_peers
from benchmarks.stiff_scenes import (
    FRICTION,
    T1,
    X0,
    SoftFloor,
    TwoRates,
    floor_exact,
    rates_exact,
    relay_exact,
    relays,
    solve,
)
from benchmarks.texts import table
from jaxfil.model.outcomes import outcome_names

RESULTS = pathlib.Path(__file__).parent / "results"
REPEATS = 5


def timed(call, repeats=REPEATS):
    """What it returns, and the median of its run times after a first call."""
    out, spent = jax.block_until_ready(call()), []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        spent.append(time.perf_counter() - begun)
    return out, statistics.median(spent)


def contact_damping():
    """(a) Stiff sides: error at t = 12, at one and the same step."""
    rows, dt = [], 0.025
    dampings = [10.0**k for k in range(3, 9)]
    for name, v in (("relay", 0.0), ("belt, v = 1", 1.0)):
        found = []
        for stepper in (jf.Rodas5P(), diffrax.Dopri8()):
            sol = solve(relays(dampings, v), X0, T1, [dt] * len(dampings), stepper, 64)
            found.append((outcome_names(sol.result), np.asarray(sol.xs[:, -1]), sol.num_events))
        for i, d in enumerate(dampings):
            exact, contacts = relay_exact(d, v)
            cells = [_error(names[i], xs[i], exact) for names, xs, _ in found]
            rows.append([name, f"{d:.0e}", *cells, f"{found[0][2][i]}, {len(contacts)} exact"])
    found = []
    for stepper in (jf.Rodas5P(), diffrax.Dopri8()):
        system = TwoRates(jnp.asarray(dampings))
        found.append(solve(system, [2.0], T1, [dt] * len(dampings), stepper, 64))
    for i, k in enumerate(dampings):
        exact, contacts = rates_exact(k)
        cells = [_error(outcome_names(s.result)[i], np.asarray(s.xs[i, -1]), exact) for s in found]
        count = f"{found[0].num_events[i]}, {len(contacts)} exact"
        rows.append(["two rates, k : 1", f"{k:.0e}", *cells, count])
    head = ["scene", "damping", f"Rodas5P, dt = {dt}", f"Dopri8, dt = {dt}", "contacts (Rodas5P)"]
    return "(a) A stiff side: error of the state at t = 12", table(head, rows)


def _error(name, x, exact):
    if name != "successful":
        return name
    error = np.abs(x - exact).max()
    return f"{error:.1e}" if error < 1e3 else f"unstable, {error:.0e}"


def compliant_wall(t1=6.0, e=0.8):
    """(b) A floor with a spring of stiffness k against x' → −e x'."""
    log = np.log(e)
    zeta = -log / np.hypot(np.pi, log)
    ball = jf.systems.BouncingBall(g=jnp.ones(1), restitution=jnp.full(1, e))
    rigid, spent = timed(lambda: solve(ball, [1.0, 0.0], t1, [0.05], diffrax.Dopri8(), 64))
    fall = np.sqrt(2.0)
    third = fall * (1 + 2 * e + 2 * e**2)
    since, speed = t1 - third, fall * e**3
    wall = np.array([speed * since - since**2 / 2, speed - since])
    rows = [
        [
            "rigid",
            "Dopri8",
            "0.05",
            f"{int(rigid.stats['num_iterations'][0]):,}",
            f"{spent * 1e3:.2g}",
            f"{np.abs(np.asarray(rigid.xs[0, -1]) - wall).max():.1e}",
            "",
        ]
    ]
    for k in (1e4, 1e6, 1e8, 1e10):
        c = 2 * zeta * np.sqrt(k)
        exact = np.array(floor_exact(k, c, t1)[0])
        system, touch = SoftFloor(jnp.full(1, k), jnp.full(1, c)), np.pi / np.sqrt(k)
        cases = [("Dopri8", diffrax.Dopri8(), touch / 3), ("Rodas5P", jf.Rodas5P(), touch / 8)]
        cases = [*cases[: 1 if k > 1e8 else 2], ("Rodas5P", jf.Rodas5P(), 0.05)]
        for name, stepper, dt in cases:
            run = ft.partial(solve, system, [1.0, 0.0], t1, [dt], stepper, 64)
            sol, spent = timed(run, 1 if touch < 1e-3 and dt < touch else REPEATS)
            error = _error(str(outcome_names(sol.result)[0]), np.asarray(sol.xs[0, -1]), exact)
            if dt > touch:
                told = jf.solve(
                    SoftFloor(jnp.asarray(k), jnp.asarray(c)),
                    jnp.array([1.0, 0.0]),
                    0.0,
                    t1,
                    dt,
                    stepper=stepper,
                    max_events=64,
                    throw=False,
                    estimate_error=True,
                ).errors
                error += f", estimate_error {np.max(told):.0e}"
            cells = [f"{dt:.1e}", f"{int(sol.stats['num_iterations'][0]):,}", f"{spent * 1e3:.3g}"]
            gap = f"{np.abs(exact - wall).max():.1e}"
            rows.append([f"k = {k:.0e}", name, *cells, error, gap])
    head = ["floor", "stepper", "dt", "iterations", "ms", "error", "exact soft − exact rigid"]
    note = (
        "\nThe contact lasts π/√k: where dt is longer than that no fixed step resolves the motion"
        "\nin the floor: an L-stable method settles there instead of coming back, and at"
        "\nhalf the step it does the same, so that neither outcome nor estimate_error tells."
    )
    return f"(b) A soft floor and a rigid one: e = {e}, t = {t1:g}", table(head, rows) + note


def smoothed_relay(t1=14.0):
    """(c) sgn → (2/π) arctan(·/width) in the Coulomb oscillator, which sticks at t = 4π."""
    widths, counts = 10.0 ** -np.arange(1, 11), [140, 1400, 14_000, 140_000]
    exact, rows = np.array([-0.2, 0.0]), []
    base = jf.systems.CoulombOscillator()
    for name, stepper in (("Dopri8", diffrax.Dopri8()), ("Rodas5P", jf.Rodas5P())):
        sol = solve(jax.tree.map(lambda v: v[None], base), [3.0, 0.0], t1, [t1 / 140], stepper, 64)
        error = _error("successful", np.asarray(sol.xs[0, -1]), exact)
        rows.append([name, "exact sgn", error, "", "", "", ""])
        pairs = [(w, n) for w in widths for n in counts]
        system = jax.vmap(lambda w: jf.smoothed(base, w))(jnp.asarray([w for w, _ in pairs]))
        sol = solve(system, [3.0, 0.0], t1, [t1 / n for _, n in pairs], stepper)
        xs, names = np.asarray(sol.xs[:, -1]), outcome_names(sol.result)
        apart = [
            np.abs(x - exact).max() if n == "successful" else np.inf
            for x, n in zip(xs, names, strict=True)
        ]
        for i, w in enumerate(widths):
            here = apart[len(counts) * i : len(counts) * (i + 1)]
            cells = [f"{v:.1e}" for v in here]
            # What the width itself does is seven times its size.
            good = [n for n, v in zip(counts, here, strict=True) if v < 10 * w]
            rows.append([name, f"{w:.0e}", *cells, f"{good[0]:,}" if good else "more"])
    head = ["stepper", "width", *(f"{n:,} steps" for n in counts), "steps for error < 10 width"]
    return "(c) Smoothed sgn against the exact answer at t = 14", table(head, rows)


def who(damping=1e6):
    """(d) Rodas5P, Kvaerno5 and Radau on the relay with damping 1e6."""
    exact = np.array(relay_exact(damping, 0.0)[0])
    cases = []
    for dt in (0.2, 0.1, 0.05, 0.025, 0.0125):
        run = ft.partial(solve, relays([damping], 0.0), X0, T1, [dt], jf.Rodas5P(), 64)
        cases.append(("jaxfil Rodas5P", f"dt = {dt}", lambda run=run: run().xs[0, -1]))
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        run = ft.partial(stiff_peers.kvaerno_events, damping, FRICTION, X0, T1, rtol)
        cases.append(("diffrax Kvaerno5, Event in a loop", f"rtol = {rtol:.0e}", run))
    for rtol in (1e-4, 1e-6, 1e-8):
        system = jf.smoothed(relays(damping, 0.0), 1e-11)
        run = ft.partial(stiff_peers.kvaerno_smooth, system, X0, T1, rtol)
        cases.append(("diffrax Kvaerno5, smoothed 1e-11", f"rtol = {rtol:.0e}", run))
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        run = ft.partial(stiff_peers.radau_events, damping, FRICTION, X0, T1, rtol)
        cases.append(("SciPy Radau with events", f"rtol = {rtol:.0e}", run))
    rows = []
    for name, setting, run in cases:
        x, spent = timed(run, 3 if "SciPy" in name else REPEATS)
        error = np.abs(np.asarray(x) - exact).max()
        rows.append(
            [name, setting, f"{error:.1e}" if error < 10 else "failed", f"{spent * 1e3:.3g}"]
        )
    head = ["who", "setting", "error at t = 12", "ms"]
    return f"(d) One relay with damping {damping:.0e}, one lane", table(head, rows, right=(3,))


def main():
    jax.config.update("jax_enable_x64", True)
    begun, texts = time.perf_counter(), []
    for part in (contact_damping, compliant_wall, smoothed_relay, who):
        started = time.perf_counter()
        title, text = part()
        texts += [title, text, ""]
        print(title, text, f"[{time.perf_counter() - started:.0f} s]\n", sep="\n", flush=True)
    found = stability.errors()
    stability.picture(found, RESULTS / "stability.png")
    texts.append("(e) results/stability.png: " + stability.summary(found))
    (RESULTS / "stiff.txt").write_text("\n".join(texts) + "\n")
    print(texts[-1], f"{time.perf_counter() - begun:.0f} s", sep="\n")


if __name__ == "__main__":
    main()
