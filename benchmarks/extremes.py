"""`python -m benchmarks.extremes`: parameters, scales and spans far outside the usual.

Nothing enters; `results/extremes.txt` leaves, a line for each extreme: what was run, how it ended,
the largest deviation from an answer in closed form, what is allowed, and a verdict. "right":
successful, and within what is allowed. "told": an outcome other than successful. "WRONG":
successful and outside.
"""

import dataclasses
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks import RESULTS
from benchmarks.pieces import motion
from benchmarks.table import Column, table
from jaxfil.model.outcomes import outcome_names
from tests.oracles.extreme_systems import Circle, Comb, Parabolas, Ring, Scaled, Spring, Turn

COLUMNS = (
    Column("scene"),
    Column("extreme"),
    Column("outcome"),
    Column("error", "<.1e"),
    Column("allowed", "<.0e"),
    Column("verdict"),
)
EPS = np.finfo(float).eps
PI = np.pi


@dataclasses.dataclass
class Row:
    """A line of the table. `note` says more where a verdict needs it."""

    scene: str
    setting: str
    outcome: str
    error: float
    allowed: float
    note: str = ""

    @property
    def verdict(self):
        """Right, told, or wrong."""
        if self.outcome != "successful":
            return "told"
        return "right" if self.error <= self.allowed else "WRONG"

    def cells(self):
        """The line's cells, in the order of `COLUMNS`."""
        error = self.error if self.outcome == "successful" else None
        verdict = f"{self.verdict}: {self.note}" if self.note else self.verdict
        return [self.scene, self.setting, str(self.outcome), error, self.allowed, verdict]


def run(make, x0, t0, t1, dt, dtype=np.float64, **options):
    """Lanes of `make(i)`, compiled together: names of the outcomes, final states, contacts."""

    @eqx.filter_jit
    @eqx.filter_vmap
    def lanes(system, x0, t0, t1, dt):
        options_ = dict(max_events=None, throw=False) | options
        return jf.solve(system, x0, t0, t1, dt, **options_)

    arrays = [np.broadcast_to(np.asarray(v, dtype), (len(x0),)) for v in (t0, t1, dt)]
    sol = lanes(make, jnp.asarray(x0, dtype), *map(jnp.asarray, arrays))
    xs = np.asarray(sol.xs[:, -1], float)
    return outcome_names(sol.result), xs, np.asarray(sol.num_events), sol


def apart(xs, exact):
    """Largest deviation of each lane."""
    return np.abs(xs - exact).max(axis=-1)


def rows_of(scene, settings, names, errors, allowed, notes=None):
    """The lines of one scene, a lane each; `allowed` may be one number for all."""
    notes = notes if notes is not None else [""] * len(settings)
    allowed = np.broadcast_to(allowed, (len(settings),))
    return [Row(scene, *row) for row in zip(settings, names, errors, allowed, notes, strict=True)]


# setting, friction, ω, t0, span
DRY = [
    *((f"ω = {w:g}", 0.3, w, 0.0, max(30.0, 2 * PI / w)) for w in 10.0 ** np.arange(-3, 4)),
    *((f"F = {f:g}", f, 0.8, 0.0, 30.0) for f in (0.0, 1e-12, 1e-6, 0.9, 2.9, 1e3, 1e6)),
    *((f"t0 = {t:g}", 0.3, 0.8, t, 16.0) for t in (1e6, 1e9, 1e12, 1e15)),
]
DRY = [row for row in DRY if row[2] != 1.0]  # at resonance the closed form is another one


def dry_friction():
    """x'' + x = cos ωt − F sgn x' from (3, 0.1)."""
    names, frictions, omegas, t0, spans = (np.array(v) for v in zip(*DRY, strict=True))
    system = jf.systems.DenHartog(friction=jnp.asarray(frictions), omega=jnp.asarray(omegas))
    dt = np.minimum(0.1, 2 * PI / omegas / 25)
    x0 = np.tile([3.0, 0.1], (len(DRY), 1))
    results, xs, counts, _ = run(system, x0, t0, t0 + spans, dt)
    exact = [
        motion("friction", f, w, (3.0, 0.1), t + s, t)
        for f, w, t, s in zip(frictions, omegas, t0, spans, strict=True)
    ]
    notes = [
        f"{n} contacts" if n == want else f"{n} contacts, {want} exact"
        for n, (_, want) in zip(counts, exact, strict=True)
    ]
    # Times near t0 have the rounding eps·t0, so has the phase of the forcing. A stick is what two
    # forces ±F leave of each other: it creeps by their rounding.
    allowed = 1e-11 + 16 * EPS * t0 + EPS * frictions * dt * spans
    errors = apart(xs, np.array([x for x, _ in exact]))
    return rows_of("dry friction", names, results, errors, allowed, notes)


def snap_through():
    """x'' + x − sgn x = cos(ωt)/4 from (2.5, 0.1), and from subnormal states without force."""
    omegas = np.array([1e-3, 1e-2, 0.1, 0.8, 10.0, 100.0, 1e3, 1.0, 1.0, 1.0])
    forces = np.where(omegas == 1, 0.0, 0.25)
    x0 = np.array([(2.5, 0.1)] * 7 + [(1e-310, 0.0), (-1e-310, 0.0), (1e-310, 1e-310)])
    system = jf.systems.SDOscillator(
        f0=jnp.asarray(forces), zeta=jnp.zeros(10), omega=jnp.asarray(omegas)
    )
    dt = np.minimum(0.1, 2 * PI / omegas / 25)
    spans = np.where(omegas == 1, 3.0, 100.0)
    results, xs, _, _ = run(system, x0, 0.0, spans, dt)
    exact = [
        motion("snap", 1.0, w, x, 100.0, force=0.25)[0]
        for w, x in zip(omegas[:7], x0[:7], strict=True)
    ]
    exact += [s * np.array([1 - np.cos(3.0), np.sin(3.0)]) for s in (1, -1, 1)]
    settings = [f"ω = {w:g}" for w in omegas[:7]]
    settings += [f"x0 = ({a:g}, {b:g})" for a, b in x0[7:]]
    return rows_of("snap-through", settings, results, apart(xs, np.array(exact)), 1e-11)


# setting, time scale, state scale, friction, t0 in units of time
SCALES = [
    *((f"time {a:g}, state {b:g}", a, b, 0.4, 0.0) for a in (1e-12, 1e12) for b in (1e-12, 1e12)),
    *((f"state {b:g}", 1.0, b, 0.4, 0.0) for b in (1e-290, 1e-306, 1e-310, 1e290, 1e307)),
    ("state 1e-310, F = 0", 1.0, 1e-310, 0.0, 0.0),
    *((f"t0 = {t:g}, autonomous", 1.0, 1.0, 0.4, t) for t in (1e9, 1e12, 1e15, 1e18)),
]


def scaled():
    """The Coulomb oscillator from (3, 0.1) in units, to t = 7 of them; numbers near both ends."""
    settings, times, states, frictions, t0 = (np.array(v) for v in zip(*SCALES, strict=True))
    system = Scaled(*(jnp.asarray(v) for v in (frictions, times, states)))
    x0 = np.array([3.0, 0.1]) * states[:, None]
    results, xs, _, _ = run(system, x0, t0, t0 + 7.0 * times, 0.05 * times)
    exact = [
        motion("friction", f, 0.5, (3.0, 0.1), 7.0, force=0.0)[0] if t < 1e17 else (3.0, 0.1)
        for f, t in zip(frictions, t0, strict=True)
    ]
    tiny = np.finfo(float).tiny  # below it numbers are zeros here
    errors = apart(xs / states[:, None], np.array(exact))
    allowed = 1e-11 + 16 * EPS * t0 + np.where(states < 1e-300, 1e3 * tiny / states, 0)
    return rows_of("Coulomb", settings, results, errors, allowed)


def grazing():
    """The circle |x| = 1, which misses the line by `gap`, or crosses it and is gone."""
    gaps = np.array([1e-9, 1e-12, 1e-13, 1e-14, -1e-14, -1e-13, -1e-12, -1e-9])
    gaps = (1 + gaps) - 1
    t1 = PI / 2 + 1
    results, xs, counts, _ = run(Circle(jnp.asarray(gaps)), [[1.0, 0.0]] * 8, 0.0, t1, 0.04)
    exact, allowed = [], []
    for gap in gaps:
        if gap > 0:
            exact.append([np.cos(t1), np.sin(t1)])
            allowed.append(1e-13)
            continue
        half = np.sqrt(-gap * (2 + gap))  # x₁ where it crosses, half before the top
        left, (a, b) = 1 + np.arcsin(half), (half + 1, 1 + gap)
        cos, sin = np.cos(left), np.sin(left)
        exact.append([a * cos - b * sin - 1, a * sin + b * cos])
        allowed.append(1e-13 + 16 * EPS / half)  # rounding of x₂ over its speed there
    settings = [f"misses by {g:.0e}" if g > 0 else f"crosses by {-g:.0e}" for g in gaps]
    notes = [f"{n} contacts" for n in counts]
    errors = apart(xs, np.array(exact))
    return rows_of("circle and line", settings, results, errors, np.array(allowed), notes)


def many_contacts():
    """One step with hundreds of contacts; a step that cannot see them."""
    rows = []
    g, e, h, t1 = 9.8, 0.99, 0.1, 28.0
    first, speed = np.sqrt(2 * h / g), np.sqrt(2 * h * g)
    n = np.arange(1, 10_000)
    impacts = first + np.concatenate([[0.0], np.cumsum(2 * speed * e**n / g)])
    last = np.searchsorted(impacts, t1) - 1
    since, v = t1 - impacts[last], speed * e ** (last + 1)
    exact = np.array([[v * since - g * since**2 / 2, v - g * since]] * 2)
    ball = jf.systems.BouncingBall(g=jnp.full(2, g), restitution=jnp.full(2, e))
    names, xs, counts, _ = run(ball, [[h, 0.0]] * 2, 0.0, t1, [28.0, 0.01])
    notes = [f"{c} contacts, {last + 1} exact" for c in counts]
    rows += rows_of(
        "ball, e = 0.99", ["one step", "2,800 steps"], names, apart(xs, exact), 1e-10, notes
    )
    pulls = np.array([10.3, 1.03e3, 1.03e4])
    names, xs, counts, _ = run(Spring(jnp.asarray(pulls)), [[0.0, 1.0]] * 3, 0.0, 0.1, 0.1)
    half = 2 / pulls
    k = np.floor(0.1 / half)
    since, sign = 0.1 - k * half, 1 - 2 * (k % 2)
    exact = np.stack([sign * (since - pulls * since**2 / 2), sign * (1 - pulls * since)], axis=1)
    notes = [f"{c} contacts, {w:.0f} exact" for c, w in zip(counts, k, strict=True)]
    settings = [f"one step, pull {p:g}" for p in pulls]
    # The rounding of a contact's time, 8 eps t, moves the velocity after it by that times the pull.
    allowed = 1e-14 + 8 * EPS * 0.1 * pulls * k
    rows += rows_of("fast relay", settings, names, apart(xs, exact), allowed, notes)
    dts = np.array([0.001, 0.3])
    names, xs, counts, sol = run(
        Comb(jnp.full(2, 200.0)), [[0.0]] * 2, 0.0, 1.5, dts, estimate_error=True
    )
    exact = PI / 200 - abs(np.mod(1.5, 2 * PI / 200) - PI / 200)
    error, told = apart(xs, exact), np.asarray(sol.errors)[:, -1, 0]
    rows.append(Row("x' = sgn sin 200t", "dt = 0.001", names[0], error[0], 1e-12))
    # A step of ten periods of H is no step for this scene: what is asked is that it is told.
    note = f"outside the promise; estimate_error tells {told[1]:.0e}"
    rows.append(Row("x' = sgn sin 200t", "dt = 0.3", names[1], error[1], 3 * told[1], note))
    return rows


def long_runs(periods=1_000_000):
    """A million periods: what is left of what is conserved."""
    # scene, system, x0, steps a period, what is conserved, and what is allowed of eps for each step
    cases = [
        # The rounding of the method's coefficients is the same at every step, and so adds up.
        ("parabolas", Parabolas(jnp.asarray(2.1)), (0.0, 1.0), 4, "of the energy", energy, 16),
        # Put back onto the circle at every step.
        ("slide on a circle", Ring(jnp.asarray(1.0)), (1.0, 0.0), 8, "of H", height, 0),
        # At 80 steps the method leaves 1e-17 of the amplitude a period, and rounding as much.
        ("oscillator", Turn(jnp.asarray(0.0)), (1.0, 0.3), 80, "of the amplitude", amplitude, 1),
    ]
    rows = []
    for scene, system, x0, steps, note, drift, units in cases:
        period = float(system.period)
        t1 = period * periods
        # One solution outside of any jit is one kernel.
        sol = jf.solve(
            system, jnp.asarray(x0), 0.0, t1, period / steps, max_events=None, throw=False
        )
        x, outcome = np.asarray(sol.x_final), str(outcome_names(sol.result))
        setting = f"{periods:,} periods of {steps} steps"
        allowed = 1e-14 + units * EPS * periods * steps
        rows.append(Row(scene, setting, outcome, abs(drift(x)), allowed, note))
    # Its phase too: what rounding leaves out of the times of two million contacts is not lost.
    rows.append(Row(scene, setting, outcome, apart(x, np.array(x0)), allowed, "of the state"))
    return rows


def energy(x):
    """What the motion on parabolas has gained."""
    return x[1] ** 2 / 2 + 2.1 * abs(x[0]) - 0.5


def height(x):
    """H on the unit circle."""
    return x[0] ** 2 + x[1] ** 2 - 1


def amplitude(x):
    """What the oscillator has gained."""
    return np.hypot(*x) - np.hypot(1.0, 0.3)


def broken_lanes(lanes=1000):
    """One lane in ten is broken; the others are those of a clean batch, bit for bit."""
    rows = []
    omegas, tenth = np.linspace(0.5, 0.9, lanes), np.arange(lanes) % 10 == 3
    broken = np.where(tenth, np.array([np.nan, np.inf, 0.0, -np.inf])[np.arange(lanes) % 4], omegas)
    x0 = np.tile([0.5, 0.1], (lanes, 1))
    pushed = np.where((tenth & (np.arange(lanes) % 3 == 0))[:, None], np.nan, x0)

    def solve(omegas, x0):
        system = jf.systems.DenHartog(friction=jnp.full(lanes, 0.3), omega=jnp.asarray(omegas))
        return run(system, x0, 0.0, 30.0, 0.1)[:2]

    def diagram(omegas, x0):
        options = dict(transient=5, samples=3, steps=40, progress=False)
        system = jf.systems.DenHartog()
        d = jf.bifurcation_diagram(system, "omega", omegas, jnp.asarray(x0), **options)
        return outcome_names(d.results), d.xs

    for scene, call in (("jf.solve under vmap", solve), ("bifurcation_diagram", diagram)):
        names, xs = call(omegas, x0)
        names_, xs_ = call(broken, pushed)
        same = np.array_equal(xs[~tenth], xs_[~tenth]) and set(names[~tenth]) == {"successful"}
        bad = [n for n in names_[tenth] if n == "successful"]
        told = dict(zip(*np.unique(names_[tenth], return_counts=True), strict=True))
        note = "the broken: " + ", ".join(f"{n} {k}" for k, n in told.items())
        error = 0.0 if same and len(bad) == 0 else np.inf
        rows.append(
            Row(scene, f"{tenth.sum()} of {lanes} lanes broken", "successful", error, 0.0, note)
        )
    return rows


def single_precision():
    """float32: the same scenes, errors in its own eps."""
    cases = [
        ("ω = 0.1", 0.3, 0.1, 0.0),
        ("ω = 10", 0.3, 10.0, 0.0),
        ("F = 0", 0.0, 0.8, 0.0),
        ("F = 1e6", 1e6, 0.8, 0.0),
        ("t0 = 1e3", 0.3, 0.8, 1e3),
        ("t0 = 1e7", 0.3, 0.8, 1e7),
    ]
    settings, frictions, omegas, t0 = (np.array(v) for v in zip(*cases, strict=True))
    single = [np.asarray(v, np.float32) for v in (frictions, omegas)]
    system = jf.systems.DenHartog(*map(jnp.asarray, single))
    dt = np.minimum(0.1, 2 * PI / omegas / 25)
    x0 = np.tile(np.array([3.0, 0.1], np.float32), (len(cases), 1))
    results, xs, _, _ = run(system, x0, t0, t0 + 16, dt, np.float32)
    exact = [
        motion("friction", f, w, x, t + 16.0, t)[0]
        for f, w, x, t in zip(*single, x0, t0, strict=True)
    ]
    eps = np.finfo(np.float32).eps
    errors = apart(xs, np.array(exact))
    allowed = (1e3 + 16 * t0 + frictions * dt * 16) * eps
    return rows_of("dry friction, float32", settings, results, errors, allowed)


PARTS = (
    dry_friction,
    snap_through,
    scaled,
    grazing,
    many_contacts,
    long_runs,
    broken_lanes,
    single_precision,
)


def main():
    """Run all parts; print and write the table."""
    jax.config.update("jax_enable_x64", True)
    begun, rows = time.perf_counter(), []
    for part in PARTS:
        started = time.perf_counter()
        rows += part()
        print(f"{part.__name__}: {time.perf_counter() - started:.1f} s", flush=True)
    verdicts = [row.verdict for row in rows]
    tally = ", ".join(f"{verdicts.count(v)} {v}" for v in ("right", "told", "WRONG"))
    text = table(COLUMNS, map(Row.cells, rows), note=f"{len(rows)} rows: {tally}.") + "\n"
    (RESULTS / "extremes.txt").write_text(text)
    print(text, f"{time.perf_counter() - begun:.0f} s", sep="\n")


if __name__ == "__main__":
    main()
