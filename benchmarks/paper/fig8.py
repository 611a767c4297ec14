"""Fig. 8: the largest velocity of the belt's period-1 orbit, case 1, and its nine bifurcations.

One call of `find_bifurcations` enters, that of `benchmarks.bifurcations`, and orbits of lower
frequency; the branch leaves, with the paper's letters at the paper's points.
"""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.lines import Line2D

import jaxfil as jf
from benchmarks.bifurcations import PRINTED, REFERENCE, belt_sequence, near
from benchmarks.paper import canvas as paper
from benchmarks.paper.table import Row
from jaxfil.plot.kinds import KINDS

TITLE = "Fig. 8: largest velocity of the belt's period-1 orbit, case 1, γ₁ = 10, γ₂ = 0"
# What the paper calls four of them; Roman numbers are what it does not have, or only draws a motion
# near.
NAMES = {
    0.917: "a",
    1.398: "i",
    1.403: "ii",
    1.549: "b",
    1.914: "iii",
    2.438: "iv",
    4.217: "v",
    7.952: "c",
    10.905: "d",
}
# Known to three decimals, by integration of closed forms.
LOCATED = {"i": 1.398, "ii": 1.403, "iii": 1.914, "iv": 2.438, "v": 4.217, "c": 7.952}
# Where names stand, in points from their marks: in the picture, and in its inset.
PLACES = {
    "a": (-9, 4),
    "b": (5, -11),
    "iii": (-15, -3),
    "iv": (-14, -3),
    "v": (7, -3),
    "c": (3, 6),
    "d": (2, 6),
}
CLOSE_PLACES = {"i": (-8, 7), "ii": (3, 7), "b": (-10, 6)}
PRINTED_C = 7.85


@eqx.filter_jit
@eqx.filter_vmap
def slow(omega):
    """The largest velocity of the orbit at a low frequency, at which a period is many steps long,
    and how far it is from closing after one."""
    belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=omega)
    ts = jnp.linspace(0.0, belt.period, 401)
    run = {"saveat": diffrax.SaveAt(ts=ts), "stepper": jf.RK4(), "throw": False}
    sol = jf.solve(belt, steady(omega), 0.0, belt.period, belt.period / 2000, **run)
    return jnp.max(sol.xs[:, 1]), jnp.max(abs(sol.xs[-1] - sol.xs[0]))


def steady(omega):
    """The state at t = 0 of the orbit that never sticks, x'' + 0.4905 x' + 10 x = 6.3765 +
    10 cos ωt; its velocity has the amplitude 10 ω/|10 − ω² + 0.4905 iω|."""
    size = 10 / (10 - omega**2 + 0.4905j * omega)
    return jnp.stack([0.63765 + size.real, -omega * size.imag])


def make(slowest=0.02):
    """The figure and the rows of its table."""
    found = belt_sequence()
    branch = found.branch
    largest = branch.extremes()[1][:, 1]
    order = np.argsort(branch.values)
    values, tops = branch.values[order], largest[order]
    low = np.linspace(slowest, values[0], 16)
    low_tops, apart = slow(jnp.asarray(low))
    assert apart.max() < 1e-6
    # Between points of the branch a tangent orbit lies on no straight line: of its own orbit.
    heights = [float(b.orbit.extremes()[1][1]) for b in found]
    curve = np.append(low, values), np.append(low_tops, tops)
    figure = paper.canvas(paper.PAGE, 105)
    ax = figure.subplots()
    inset = ax.inset_axes((0.57, 0.4, 0.41, 0.5))
    for axes, places in ((ax, PLACES), (inset, CLOSE_PLACES)):
        axes.plot(*curve, color=paper.BLACK)
        marks(axes, found, heights, places)
    ax.axhline(1, color=paper.BLACK, lw=0.8, ls=":")
    ax.axvline(PRINTED_C, **paper.PAPER)
    ax.set(xlabel="ω, rad/s", ylabel="largest velocity, m/s", xlim=(0, 20), ylim=(0, 6))
    inset.set(xlim=(1.38, 1.57), ylim=(0.96, 1.13), xlabel="ω, rad/s", ylabel="m/s")
    inset.set_title("where i, ii and b are")
    legend(figure, found)
    return figure, table(found, low, np.asarray(low_tops))


def marks(ax, found, heights, places):
    """Every bifurcation by its kind: filled where the paper has a letter, else hollow."""
    for b, height in zip(found, heights, strict=True):
        name = near(NAMES, float(b.value))
        marker, color = KINDS[b.kind]
        lettered = name in "abcd"
        face = color if lettered else paper.WHITE
        edge = paper.BLACK if lettered else color
        ax.plot(b.value, height, marker, mfc=face, mec=edge, ms=5, mew=0.8 if lettered else 1.2)
        if name in places:
            weight = {"weight": "bold"} if lettered else {"style": "italic"}
            at = (float(b.value), height)
            ax.annotate(name, at, places[name], textcoords="offset points", **weight)


def legend(figure, found):
    """The kinds, and the two styles."""
    style = {"ls": "none", "ms": 5, "mew": 0.8}
    handles = [
        Line2D([], [], marker=marker, color=color, mec=paper.BLACK, label=kind, **style)
        for kind, (marker, color) in KINDS.items()
        if kind in {b.kind for b in found}
    ]
    grey = {"marker": "o", "mec": paper.GREY} | style
    handles += [
        Line2D([], [], mfc=paper.GREY, label="a–d: the paper's", **grey | {"mec": paper.BLACK}),
        Line2D([], [], mfc="none", label="i–v: not in the paper", **grey),
        Line2D([], [], label="where the paper has c, 7.85", **paper.PAPER),
        Line2D([], [], color=paper.BLACK, lw=0.8, ls=":", label="the belt's velocity"),
    ]
    paper.below(figure, handles, 4)


def table(found, low, tops):
    """The rows of its table."""
    rows = []
    for b in found:
        value = float(b.value)
        name = near(NAMES, value)
        printed, why = near(PRINTED, value) or ("", "")
        exact = near(REFERENCE, value) or LOCATED.get(name, "")
        rows.append(Row(f"{name}  {b.kind}", printed, value, exact, why))
    i = len(low) // 2
    what = f"largest velocity at ω = {low[i]:.2f}"
    exact = abs(10 * low[i] / (10 - low[i] ** 2 + 0.4905j * low[i]))
    return [*rows, Row(what, "", float(tops[i]), float(exact), "400 samples of a period", 6)]
