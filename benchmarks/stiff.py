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
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import jaxfil as jf
from benchmarks import stiff_peers
from benchmarks.linear_pieces import Mode, follow
from benchmarks.texts import table
from jaxfil.results import outcome_names

RESULTS = pathlib.Path(__file__).parent / "results"
REPEATS = 5
# The real stability interval of Dopri8: |R(−z)| ≤ 1 up to here.
STABLE = 5.17
X0, T1, FRICTION = (0.5, 2.0), 12.0, 0.4


class DampedRelay(jf.System):
    """x'' = 2 cos 1.3t − x − F sgn w − d max(w, 0), w = x' − v: a contact damped on one side."""

    damping: jax.Array
    v: jax.Array

    def vector_field(self, t, x, side):
        w = x[1] - self.v
        damper = 0.5 * (1 + side) * self.damping * w
        return jnp.stack([x[1], 2 * jnp.cos(1.3 * t) - x[0] - FRICTION * side - damper])

    def switching(self, t, x):
        return x[1] - self.v


class TwoRates(jf.System):
    """x' = −k(x − cos t) above zero, −(x − cos t) below: a stiff side and a soft one."""

    k: jax.Array

    def vector_field(self, t, x, side):
        return -jnp.where(side > 0, self.k, 1.0) * (x - jnp.cos(t))

    def switching(self, t, x):
        return x[0]


class SoftFloor(jf.System):
    """y'' = −1 above a floor, −1 − ky − cy' in it."""

    k: jax.Array
    c: jax.Array

    def vector_field(self, t, x, side):
        inside = 0.5 * (1 - side)
        return jnp.stack([x[1], -1 - inside * (self.k * x[0] + self.c * x[1])])

    def switching(self, t, x):
        return x[0]


@ft.cache
def relay_exact(damping, v):
    """(x, x') at T1, by pieces in y = x − vt and w."""

    def push(t, z):
        return 2 * mp.cos(mp.mpf(1.3) * t) - z[0]

    pull, v = mp.mpf(FRICTION), mp.mpf(v)
    # On the damped side −d(x' − v): the damper's pull on the belt is a constant.
    modes = {
        1: Mode([[0, 1], [-1, -damping]], [0, damping * v - pull], [0, 2], lambda t, z: z[1] - v),
        -1: Mode([[0, 1], [-1, 0]], [0, pull], [0, 2], lambda t, z: v - z[1]),
        0: Mode([[0, 0], [0, 0]], [v, 0], [0, 0], lambda t, z: pull - abs(push(t, z))),
    }

    def after(mode, t, z):
        force = push(t, z)
        held = mode != 0 and abs(force) < pull
        return 0 if held else (1 if force > 0 else -1)

    return follow(modes, after, 1, X0, T1, 1.3)


@ft.cache
def rates_exact(k):
    """x at T1 from 2."""
    modes = {
        s: Mode([[-rate]], [0], [rate], lambda t, z, s=s: s * z[0]) for s, rate in ((1, k), (-1, 1))
    }
    return follow(modes, lambda mode, t, z: -mode, 1, [2.0], T1, 1.0)


@ft.cache
def floor_exact(k, c, t1):
    modes = {
        1: Mode([[0, 1], [0, 0]], [0, -1], [0, 0], lambda t, z: z[0]),
        -1: Mode([[0, 1], [-k, -c]], [0, -1], [0, 0], lambda t, z: -z[0]),
    }
    return follow(modes, lambda mode, t, z: -mode, 1, [1.0, 0.0], t1)


def timed(call, repeats=REPEATS):
    """What it returns, and the median of its run times after a first call."""
    out, spent = jax.block_until_ready(call()), []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        spent.append(time.perf_counter() - begun)
    return out, statistics.median(spent)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), None, 0, None, 0, None))
def lanes(system, x0, t1, stepper, dt, max_events):
    return jf.solve(system, x0, 0.0, t1, dt, stepper=stepper, max_events=max_events, throw=False)


def solve(systems, x0, t1, dt, stepper, max_events=None):
    """Lanes of `systems`: outcomes, states at the end, contacts."""
    dt = jnp.asarray(dt, float)
    t1 = jnp.broadcast_to(jnp.asarray(t1, float), dt.shape)
    sol = lanes(systems, jnp.asarray(x0, float), t1, stepper, dt, max_events)
    return sol


def relays(dampings, v):
    dampings = jnp.asarray(dampings, float)
    return DampedRelay(dampings, jnp.broadcast_to(jnp.asarray(v, float), dampings.shape))


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
        ["rigid", "Dopri8", "0.05", f"{int(rigid.stats['num_iterations'][0]):,}",
         f"{spent * 1e3:.2g}", f"{np.abs(np.asarray(rigid.xs[0, -1]) - wall).max():.1e}", ""]
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
                    SoftFloor(jnp.asarray(k), jnp.asarray(c)), jnp.array([1.0, 0.0]), 0.0, t1, dt,
                    stepper=stepper, max_events=64, throw=False, estimate_error=True,
                ).errors
                error += f", estimate_error {np.max(told):.0e}"
            cells = [f"{dt:.1e}", f"{int(sol.stats['num_iterations'][0]):,}", f"{spent * 1e3:.3g}"]
            gap = f"{np.abs(exact - wall).max():.1e}"
            rows.append([f"k = {k:.0e}", name, *cells, error, gap])
    head = ["floor", "stepper", "dt", "iterations", "ms", "error", "exact soft − exact rigid"]
    note = (
        "\nThe contact lasts π/√k: where dt is longer than that no fixed step resolves the motion in"
        "\nthe floor, and an L-stable method settles there instead of coming back."
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
        apart = [np.abs(x - exact).max() if n == "successful" else np.inf
                 for x, n in zip(xs, names, strict=True)]
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
        rows.append([name, setting, f"{error:.1e}" if error < 10 else "failed", f"{spent * 1e3:.3g}"])
    head = ["who", "setting", "error at t = 12", "ms"]
    return f"(d) One relay with damping {damping:.0e}, one lane", table(head, rows, right=(3,))


def stability_map():
    """(e) Errors over dt and damping: {name: (dts, dampings, errors)}."""
    dts, dampings = np.geomspace(1e-3, 0.3, 16), 10.0 ** np.arange(0, 8.25, 0.5)
    exact = np.array([relay_exact(float(d), 0.0)[0] for d in dampings])
    grid = [(d, h) for d in dampings for h in dts]
    found = {}
    for name, stepper in (("Dopri8 (explicit)", diffrax.Dopri8()), ("Rodas5P", jf.Rodas5P())):
        systems = relays([d for d, _ in grid], 0.0)
        sol = solve(systems, X0, T1, [h for _, h in grid], stepper, 256)
        xs = np.asarray(sol.xs[:, -1]).reshape(len(dampings), len(dts), 2)
        errors = np.abs(xs - exact[:, None]).max(axis=-1)
        told = (outcome_names(sol.result) != "successful").reshape(errors.shape)
        found[name] = dts, dampings, errors, told
    return found


def picture(found, path):
    """A panel a method: the error as colour, failures hatched."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Patch
    from matplotlib.patheffects import Normal, Stroke

    figure, axes = plt.subplots(
        1, len(found), figsize=(11, 5.2), sharey=True, layout="constrained"
    )
    drawn = None
    for ax, (name, (dts, dampings, errors, told)) in zip(axes, found.items(), strict=True):
        shown = np.ma.masked_where(told | ~(errors < 1), errors)
        drawn = ax.pcolormesh(
            dts, dampings, np.maximum(shown, 1e-14), norm=LogNorm(1e-14, 1), cmap="viridis",
            shading="nearest",
        )
        for where, hatch in ((told, "xx"), (~told & ~(errors < 1), "..")):
            marked = np.ma.masked_where(~where, np.ones_like(errors))
            ax.pcolor(dts, dampings, marked, cmap="Greys", vmin=0, vmax=4, hatch=hatch,
                      edgecolor="0.3", linewidth=0, shading="nearest")
        ax.set(xscale="log", yscale="log", title=name, xlabel="step dt")
    (limit,) = axes[0].plot(
        dts, STABLE / dts, color="white", lw=2, ls="--", label=f"stability limit d·dt = {STABLE}"
    )
    limit.set_path_effects([Stroke(linewidth=3.5, foreground="black"), Normal()])
    axes[0].set_ylim(dampings[0] / 1.8, dampings[-1] * 1.8)
    axes[0].set_ylabel("damping d of one side")
    figure.colorbar(drawn, ax=axes, label="error of the state at t = 12")
    marks = [Patch(facecolor="0.85", edgecolor="0.3", hatch="xx", label="told: not successful")]
    marks.append(Patch(facecolor="0.85", edgecolor="0.3", hatch="..", label="error above 1"))
    figure.legend(handles=[limit, *marks], loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle("A relay with one damped side: error over step and stiffness")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main():
    jax.config.update("jax_enable_x64", True)
    begun, texts = time.perf_counter(), []
    for part in (contact_damping, compliant_wall, smoothed_relay, who):
        started = time.perf_counter()
        title, text = part()
        texts += [title, text, ""]
        print(title, text, f"[{time.perf_counter() - started:.0f} s]\n", sep="\n", flush=True)
    found = stability_map()
    picture(found, RESULTS / "stability.png")
    texts.append("(e) results/stability.png: " + summary(found))
    (RESULTS / "stiff.txt").write_text("\n".join(texts) + "\n")
    print(texts[-1], f"{time.perf_counter() - begun:.0f} s", sep="\n")


def summary(found):
    parts = []
    for name, (_, _, errors, told) in found.items():
        wrong = int((~told & ~(errors < 1)).sum())
        parts.append(f"{name}: of {errors.size} pairs {int((~told & (errors < 1e-6)).sum())} below "
                     f"1e-6, {wrong} above 1, {int(told.sum())} told")
    return "; ".join(parts) + "."


if __name__ == "__main__":
    main()
