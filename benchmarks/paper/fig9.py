"""Fig. 9: phase portraits of the belt's orbit, case 1, at nine frequencies.

Frequencies enter; the orbits there leave, with the parts that stick to the belt, the point at which
a period begins, and two enlargements where the orbit only just passes the belt.
"""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.lines import Line2D

import jaxfil as jf
from benchmarks.paper import canvas as paper
from benchmarks.paper.table import Row

TITLE = "Fig. 9: period-1 orbits of the belt, case 1, γ₁ = 10, γ₂ = 0, where their sliding changes"
# Those in the caption of the paper's figure.
VALUES = (0.92, 1.3, 1.55, 1.95, 2.44, 7.85, 9.1, 10.9, 17.0)
# Where the motion passes the belt by less than can be seen.
ENLARGED = (1.55, 7.85)
# ω: x(0), max ẋ, largest multiplier, from closed forms per piece.
REFERENCE = {
    1.3: ((1.562680507274925516, 1.0), 1.0, -0.199459730884038),
    2.44: (
        (0.893154126723387260, 3.181072481841881173),
        3.781163696487915,
        0.0025495 + 0.0145254j,
    ),
    9.1: ((0.431566227111474261, 0.285460370360303195), 1.0, -0.161706955546901),
    17.0: (
        (0.601839693239804056, 0.018194523762144070),
        0.609047044980828,
        0.360329 + 0.839260j,
    ),
}
# Where the paper has the orbit just touch the belt, the orbit is past its grazing already.
GRAZES = {0.92: 0.917012578766336, 10.9: 10.904975822090772}
SIGNS = {-1: "−", 0: "stick", 1: "+"}


@eqx.filter_jit
@eqx.filter_vmap
def orbits(omega):
    """The orbit at a frequency, its extremes and multipliers, and a period of it step by step."""
    belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=omega)
    orbit = jf.periodic_orbit(
        belt, jnp.array([0.6, 0.02]), transient=200, steps=60, max_events=12, throw=False
    )
    ts = jnp.linspace(0, belt.period, 4801)
    saveat = diffrax.SaveAt(ts=ts)
    dt = belt.period / 60
    sol = jf.solve(belt, orbit.x0, 0.0, belt.period, dt, saveat=saveat, max_events=12, throw=False)
    return orbit, orbit.extremes()[1][1], orbit.multipliers, sol


def make():
    """The figure and the rows of its table."""
    values = np.array(VALUES)
    orbit, tops, multipliers, sol = orbits(jnp.asarray(values))
    assert np.all(orbit.result == jf.RESULTS.successful)
    figure = paper.canvas(paper.PAGE, 165)
    axes = figure.subplots(3, 3)
    for i, (ax, omega) in enumerate(zip(axes.flat, values, strict=True)):
        xs, modes = np.asarray(sol.xs[i]), np.asarray(sol.modes[i, :, 0])
        portrait(ax, xs, modes)
        ax.plot(*xs[0], "o", ms=4, mfc=paper.WHITE, mec=paper.BLACK, mew=0.9, zorder=5)
        if omega in ENLARGED:
            enlarge(ax, xs, modes)
        paper.entitle(ax, f"({'abcdefghi'[i]}) ω = {omega:g}: {described(orbit, i)}")
    for ax in axes[-1]:
        ax.set_xlabel("x, m")
    for ax in axes[:, 0]:
        ax.set_ylabel("ẋ, m/s")
    paper.below(figure, list(handles()), 5)
    return figure, table(values, orbit, np.asarray(tops), np.asarray(multipliers))


def portrait(ax, xs, modes):
    """One orbit, coloured by its modes."""
    ax.axhline(1, color=paper.BLACK, lw=0.8, ls=":")
    for mode, color in paper.SLIPS.items():
        held = modes == mode
        held[:-1] |= held[1:]  # up to the contact with the next piece
        part = np.where(held[:, None], xs, np.nan)
        ax.plot(*part.T, color=color, lw=3 if mode == 0 else 1.0, solid_capstyle="butt")


def enlarge(ax, xs, modes):
    """The excursion beyond the belt, in a window within the orbit."""
    beyond = xs[modes == 1]
    (left, _), (right, top) = beyond.min(axis=0), beyond.max(axis=0)
    margin, rise = 0.6 * (right - left), top - 1
    inset = ax.inset_axes((0.28, 0.28, 0.5, 0.32))
    portrait(inset, xs, modes)
    inset.set(xlim=(left - margin, right + margin), ylim=(1 - 1.2 * rise, 1 + 1.8 * rise))
    inset.set_xticks([round(float(x), 3) for x in (left, right)])
    inset.set_yticks([])  # 1.003 beside 1.000 would need more room than there is
    # On white, for the lines to the enlargement pass behind it.
    text = {"facecolor": paper.WHITE, "edgecolor": "none", "pad": 1}
    inset.set_title(f"{1e3 * rise:.2f} mm/s above", bbox=text)
    ax.indicate_inset_zoom(inset, edgecolor=paper.GREY, lw=0.8)


def handles():
    """The entries of the legend."""
    styles = paper.SLIPS
    yield Line2D([], [], color=paper.BLACK, lw=0.8, ls=":", label="belt, ẋ = v")
    yield Line2D([], [], color=styles[-1], label="slips, ẋ < v")
    yield Line2D([], [], color=styles[1], label="slips, ẋ > v")
    yield Line2D([], [], color=styles[0], lw=3, label="sticks")
    yield Line2D([], [], ls="none", marker="o", mfc=paper.WHITE, mec=paper.BLACK,
                 label="once a period")  # fmt: skip


def described(orbit, i):
    """How often the i-th orbit begins to stick, and crosses."""
    kinds = np.asarray(orbit.events.kinds[i])
    counts = [np.sum(kinds == kind) for kind in (jf.EventKind.stick, jf.EventKind.crossing)]
    parts = [
        f"{n} {name}{'s' if n > 1 else ''}"
        for n, name in zip(counts, ("stick", "crossing"), strict=True)
        if n
    ]
    return ", ".join(parts) or "no contact"


def sequence(orbit, i):
    """Contacts of the i-th orbit: the modes after them with their times."""
    events, count = orbit.events, int(orbit.num_events[i])
    parts = [SIGNS[int(orbit.first_mode[i, 0])]]
    for t, mode in zip(events.ts[i, :count], events.modes[i, :count, 0], strict=True):
        parts.append(f"{SIGNS[int(mode)]} at {float(t):.6f}")
    return ", ".join(parts)


def held(orbit, i, omega):
    """For how long the i-th orbit sticks in a period."""
    count = int(orbit.num_events[i])
    ts, modes = np.asarray(orbit.events.ts[i, :count]), orbit.events.modes[i, :count, 0]
    lasts = np.diff(ts, append=ts[0] + 2 * np.pi / omega)
    return float(np.sum(lasts[np.asarray(modes) == 0]))


def table(values, orbit, tops, multipliers):
    """The rows of its table."""
    rows = []
    for i, omega in enumerate(values):
        known = REFERENCE.get(float(omega))
        state, top, multiplier = known or (("", ""), "", "")
        found = np.asarray(orbit.x0[i])
        why = ""
        if graze := GRAZES.get(float(omega)):
            stuck = held(orbit, i, omega)
            why = f"it grazes at {graze:.6f}, and sticks for {stuck:.4f} s a period here"
        rows.append(Row(f"({'abcdefghi'[i]}) ω, rad/s", f"{omega:g}", float(omega), "", why, 4))
        rows.append(Row("  x(0)", "", float(found[0]), state[0]))
        rows.append(Row("  ẋ(0)", "", float(found[1]), state[1]))
        rows.append(Row("  max ẋ", "", float(tops[i]), top))
        largest = multipliers[i][np.argmax(abs(multipliers[i]))]
        largest = largest if abs(largest.imag) > 0 else float(largest.real)
        rows.append(Row("  largest multiplier", "", largest, multiplier, "", 6))
        rows.append(Row("  modes", "", sequence(orbit, i)))
    return rows
