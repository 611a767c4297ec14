"""Fig. 9: phase portraits of the belt's orbit, case 1, where its sliding changes.

Frequencies enter; the orbits there leave, with the parts that stick to the belt.
"""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks.paper.canvas import BLACK, BLUE, ORANGE, VERMILLION, canvas, entitle
from benchmarks.paper.table import Row

TITLE = "Fig. 9: orbits of the belt, case 1, γ1 = 10, γ2 = 0, between their bifurcations"
# One between any two bifurcations of Fig. 8 where the portrait changes: a, b, c, d, f, h and i.
VALUES = (0.8, 1.3, 1.4, 1.6, 2.44, 7.9, 9.1, 17.0)
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
SIGNS = {-1: "−", 0: "stick", 1: "+"}


@eqx.filter_jit
@eqx.filter_vmap
def orbits(omega):
    """The orbit at a frequency, its extremes and multipliers, and a period of it step by step."""
    belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=omega)
    orbit = jf.periodic_orbit(
        belt, jnp.array([0.6, 0.02]), transient=200, steps=60, max_events=12, throw=False
    )
    ts = jnp.linspace(0, belt.period, 1201)
    saveat = diffrax.SaveAt(ts=ts)
    dt = belt.period / 60
    sol = jf.solve(belt, orbit.x0, 0.0, belt.period, dt, saveat=saveat, max_events=12, throw=False)
    return orbit, orbit.extremes()[1][1], orbit.multipliers, sol


def make():
    """The figure and the rows of its table."""
    values = np.array(VALUES)
    orbit, tops, multipliers, sol = orbits(jnp.asarray(values))
    assert np.all(orbit.result == jf.RESULTS.successful)
    figure = canvas(11, 5.6)
    axes = figure.subplots(2, 4)
    for i, (ax, omega) in enumerate(zip(axes.flat, values, strict=True)):
        portrait(ax, np.asarray(sol.xs[i]), np.asarray(sol.modes[i, :, 0]))
        entitle(ax, f"ω = {omega:g}: {described(orbit, i)}")
        ax.title.set_fontsize("small")
    for ax in axes[1]:
        ax.set_xlabel("displacement x")
    for ax in axes[:, 0]:
        ax.set_ylabel("velocity ẋ")
    handles, labels = axes[0, 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize="small")
    figure.suptitle("Belt friction, case 1: period-1 orbits")
    return figure, table(values, orbit, np.asarray(tops), np.asarray(multipliers))


def portrait(ax, xs, modes):
    """One orbit, coloured by its modes."""
    ax.axhline(1, color=BLACK, lw=0.7, ls=":", label="belt, ẋ = v")
    for mode, color, width, label in (
        (-1, BLUE, 1.2, "slips, ẋ < v"),
        (1, VERMILLION, 1.2, "slips, ẋ > v"),
        (0, ORANGE, 4, "sticks"),
    ):
        held = modes == mode
        held[:-1] |= held[1:]  # up to the contact with the next piece
        part = np.where(held[:, None], xs, np.nan)
        ax.plot(*part.T, color=color, lw=width, solid_capstyle="butt", label=label)


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


def table(values, orbit, tops, multipliers):
    """The rows of its table."""
    rows = []
    for i, omega in enumerate(values):
        known = REFERENCE.get(float(omega))
        state, top, multiplier = known or (("", ""), "", "")
        found = np.asarray(orbit.x0[i])
        rows.append(Row(f"ω = {omega:g}: x(0)", "", float(found[0]), state[0]))
        rows.append(Row("  ẋ(0)", "", float(found[1]), state[1]))
        rows.append(Row("  max ẋ", "", float(tops[i]), top))
        largest = multipliers[i][np.argmax(abs(multipliers[i]))]
        largest = largest if abs(largest.imag) > 0 else float(largest.real)
        rows.append(Row("  largest multiplier", "", largest, multiplier, "", 6))
        rows.append(Row("  modes", "", sequence(orbit, i)))
    return rows
