"""`python -m benchmarks.stiff`: stiff sides, compliant walls, smoothed relays, and who solves them.

Nothing enters. `results/stiff.txt` leaves, four tables and a sentence, and `results/stability.png`,
the error of an explicit and a linearly implicit method over step and stiffness. Exact answers are
sums of exponentials per piece in 40 digits. Run times are medians of repeated calls, compilation
left out.
"""

import functools as ft
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks import RESULTS, stability, stiff_peers
from benchmarks.stiff_scenes import (
    T1,
    X0,
    TwoRates,
    floor_exact,
    rates_exact,
    relay_exact,
    relays,
    solve,
)
from benchmarks.table import Column, table
from benchmarks.timing import timed
from jaxfil.model.outcomes import outcome_names
from tests.oracles.stiff_systems import FRICTION, SoftFloor

REPEATS = 5


def contact_damping():
    """(a) Stiff sides: error at t = 12, at one and the same step."""
    dampings, dt = [10.0**k for k in range(3, 9)], 0.025
    steps = [dt] * len(dampings)
    cases = [
        (name, relays(dampings, v), X0, [relay_exact(d, v) for d in dampings])
        for name, v in (("relay", 0.0), ("belt, v = 1", 1.0))
    ]
    rates = TwoRates(jnp.asarray(dampings))
    cases.append(("two rates, k : 1", rates, [2.0], [rates_exact(k) for k in dampings]))
    rows = []
    for name, systems, x0, answers in cases:
        found = [solve(systems, x0, T1, steps, s, 64) for s in (jf.Rodas5P(), diffrax.Dopri8())]
        for i, (d, (exact, contacts)) in enumerate(zip(dampings, answers, strict=True)):
            errors = [_error(sol, i, exact) for sol in found]
            rows.append([name, d, *errors, f"{found[0].num_events[i]}, {len(contacts)} exact"])
    columns = [Column("scene"), Column("damping", "<.0e"), Column(f"Rodas5P, dt = {dt}")]
    columns += [Column(f"Dopri8, dt = {dt}"), Column("contacts (Rodas5P)")]
    return table(columns, rows, "(a) A stiff side: error of the state at t = 12")


def _error(sol, i, exact):
    """The error of a lane as text, or its outcome where it failed."""
    name = str(outcome_names(sol.result)[i])
    if name != "successful":
        return name
    error = np.abs(np.asarray(sol.xs[i, -1]) - exact).max()
    return f"{error:.1e}" if error < 1e3 else f"unstable, {error:.0e}"


def compliant_wall(t1=6.0, e=0.8):
    """(b) A floor with a spring of stiffness k against x' → −e x'."""
    log = np.log(e)
    zeta = -log / np.hypot(np.pi, log)
    ball = jf.systems.BouncingBall(g=jnp.ones(1), restitution=jnp.full(1, e))
    fall = np.sqrt(2.0)
    since, speed = t1 - fall * (1 + 2 * e + 2 * e**2), fall * e**3
    wall = np.array([speed * since - since**2 / 2, speed - since])
    run = ft.partial(solve, ball, [1.0, 0.0], t1, [0.05], diffrax.Dopri8(), 64)
    rigid, spent = timed(run, REPEATS)
    error = np.abs(np.asarray(rigid.xs[0, -1]) - wall).max()
    rows = [["rigid", "Dopri8", "0.05", _iterations(rigid), f"{spent * 1e3:.2g}", error, None]]
    for k in (1e4, 1e6, 1e8, 1e10):
        rows += soft_floor(k, 2 * zeta * np.sqrt(k), t1, wall)
    return table(FLOORS, rows, f"(b) A soft floor and a rigid one: e = {e}, t = {t1:g}", UNRESOLVED)


def soft_floor(k, c, t1, wall):
    """The lines of one stiffness: at steps that resolve a contact, and at one that does not."""
    exact = np.array(floor_exact(k, c, t1)[0])
    system, contact = SoftFloor(jnp.full(1, k), jnp.full(1, c)), np.pi / np.sqrt(k)
    cases = [("Dopri8", diffrax.Dopri8(), contact / 3), ("Rodas5P", jf.Rodas5P(), contact / 8)]
    cases = [*cases[: 1 if k > 1e8 else 2], ("Rodas5P", jf.Rodas5P(), 0.05)]
    for name, stepper, dt in cases:
        run = ft.partial(solve, system, [1.0, 0.0], t1, [dt], stepper, 64)
        sol, spent = timed(run, 1 if contact < 1e-3 and dt < contact else REPEATS)
        error = _error(sol, 0, exact)
        if dt > contact:
            error += f", estimate_error {_estimate(k, c, t1, dt, stepper):.0e}"
        gap = np.abs(exact - wall).max()
        yield [f"k = {k:.0e}", name, dt, _iterations(sol), spent * 1e3, error, gap]


def _iterations(sol):
    """Iterations of the first lane."""
    return int(sol.stats["num_iterations"][0])


def _estimate(k, c, t1, dt, stepper):
    """The largest error that jaxfil itself estimates of a soft floor's motion."""
    system, x0 = SoftFloor(jnp.asarray(k), jnp.asarray(c)), jnp.array([1.0, 0.0])
    options = dict(max_events=64, throw=False, estimate_error=True)
    return np.max(jf.solve(system, x0, 0.0, t1, dt, stepper=stepper, **options).errors)


FLOORS = (
    Column("floor"),
    Column("stepper"),
    Column("dt", "<.1e"),
    Column("iterations", "<,"),
    Column("ms", "<.3g"),
    Column("error", "<.1e"),
    Column("exact soft − exact rigid", "<.1e"),
)
UNRESOLVED = """\
The contact lasts π/√k. Where dt is longer than that no step of its length resolves the
motion in the floor, where an L-stable method would settle: steps are halved there, until
their estimated error is a hundredth of what they do, or less."""


def smoothed_relay(t1=14.0):
    """(c) sgn → (2/π) arctan(·/width) in the Coulomb oscillator, which sticks at t = 4π."""
    widths, counts = 10.0 ** -np.arange(1, 11), [140, 1400, 14_000, 140_000]
    exact, rows = np.array([-0.2, 0.0]), []
    base = jf.systems.CoulombOscillator()
    for name, stepper in (("Dopri8", diffrax.Dopri8()), ("Rodas5P", jf.Rodas5P())):
        sol = solve(jax.tree.map(lambda v: v[None], base), [3.0, 0.0], t1, [t1 / 140], stepper, 64)
        rows.append([name, "exact sgn", _error(sol, 0, exact), *[None] * 4])
        pairs = [(w, n) for w in widths for n in counts]
        system = jax.vmap(lambda w: jf.smoothed(base, w))(jnp.asarray([w for w, _ in pairs]))
        sol = solve(system, [3.0, 0.0], t1, [t1 / n for _, n in pairs], stepper)
        apart = np.abs(np.asarray(sol.xs[:, -1]) - exact).max(axis=-1)
        apart = np.where(outcome_names(sol.result) == "successful", apart, np.inf)
        for w, errors in zip(widths, apart.reshape(len(widths), -1), strict=True):
            # What the width itself does is seven times its size.
            good = [n for n, error in zip(counts, errors, strict=True) if error < 10 * w]
            rows.append([name, w, *errors, good[0] if good else "more"])
    columns = [Column("stepper"), Column("width", "<.0e")]
    columns += [Column(f"{n:,} steps", "<.1e") for n in counts]
    columns += [Column("steps for error < 10 width", "<,")]
    return table(columns, rows, "(c) Smoothed sgn against the exact answer at t = 14")


def who(damping=1e6):
    """(d) Rodas5P, Kvaerno5 and Radau on the relay with damping 1e6."""
    exact, rows = np.array(relay_exact(damping, 0.0)[0]), []
    for name, setting, run in contestants(damping):
        x, spent = timed(run, 3 if "SciPy" in name else REPEATS)
        error = np.abs(np.asarray(x) - exact).max()
        rows.append([name, setting, error if error < 10 else "failed", spent * 1e3])
    columns = [Column("who"), Column("setting"), Column("error at t = 12", "<.1e")]
    columns += [Column("ms", ">.3g")]
    return table(columns, rows, f"(d) One relay with damping {damping:.0e}, one lane")


def contestants(damping):
    """(program, setting, a function of no arguments that gives the state at the end)."""
    system = relays([damping], 0.0)
    for dt in (0.2, 0.1, 0.05, 0.025, 0.0125):
        run = ft.partial(solve, system, X0, T1, [dt], jf.Rodas5P(), 64)
        yield "jaxfil Rodas5P", f"dt = {dt}", lambda run=run: run().xs[0, -1]
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        run = ft.partial(stiff_peers.kvaerno_events, damping, FRICTION, X0, T1, rtol)
        yield "diffrax Kvaerno5, Event in a loop", f"rtol = {rtol:.0e}", run
    for rtol in (1e-4, 1e-6, 1e-8):
        smooth = jf.smoothed(jax.tree.map(lambda v: v[0], system), 1e-11)
        run = ft.partial(stiff_peers.kvaerno_smooth, smooth, X0, T1, rtol)
        yield "diffrax Kvaerno5, smoothed 1e-11", f"rtol = {rtol:.0e}", run
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        run = ft.partial(stiff_peers.radau_events, damping, FRICTION, X0, T1, rtol)
        yield "SciPy Radau with events", f"rtol = {rtol:.0e}", run


def main():
    """Print and write all parts, and draw the picture."""
    jax.config.update("jax_enable_x64", True)
    begun, texts = time.perf_counter(), []
    for part in (contact_damping, compliant_wall, smoothed_relay, who):
        started = time.perf_counter()
        texts.append(part())
        print(texts[-1], f"[{time.perf_counter() - started:.0f} s]\n", sep="\n", flush=True)
    found = stability.errors()
    stability.picture(found, RESULTS / "stability.png")
    texts.append("(e) results/stability.png: " + stability.summary(found))
    (RESULTS / "stiff.txt").write_text("\n\n".join(texts) + "\n")
    print(texts[-1], f"{time.perf_counter() - begun:.0f} s", sep="\n")


if __name__ == "__main__":
    main()
