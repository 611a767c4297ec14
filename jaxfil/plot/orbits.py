"""Branches of periodic orbits with their special points, and curves of bifurcations.

A branch or a curve enters; the axes it was drawn on leave.
"""

import numpy as np
from matplotlib.axes import Axes

from jaxfil.bifurcations.two_parameter import BifurcationCurve
from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.model.labels import labels_of
from jaxfil.orbits.branch import Branch, SpecialPoint
from jaxfil.plot.canvas import BLACK, VERMILLION, own_axes

# The colour of each kind of bifurcation.
CURVES = {
    "grazing": "#0072B2",
    "grazing-sliding": "#D55E00",
    "adding-sliding": "#009E73",
    "crossing-sliding": "#CC79A7",
    "switching-sliding": "#E69F00",
}
# Marker and colour of each kind of special point.
POINTS = {
    "fold": ("s", "#0072B2"),
    "period-doubling": ("D", "#009E73"),
    "neimark-sacker": ("^", "#CC79A7"),
    "contacts": ("o", "#F0E442"),
}


@draws(Branch)
def branch(
    branch: Branch, ax: Axes | None = None, component: int = 0, extremes: bool = False
) -> Axes:
    """Draw a branch of orbits against its parameter, unstable parts dashed, special points marked.

    **Arguments**

    - `branch`: a `Branch`.
    - `ax`: the axes to draw on; by default those of a figure of their own.
    - `component`: which one of the state is drawn, from 0.
    - `extremes`: draw its smallest and largest value on the orbit in place of that at t0.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> belt = jf.systems.BeltFriction(gamma1=10.0, gamma2=0.0, omega=12.0)
    >>> orbit = jf.periodic_orbit(belt, jnp.array([0.1, 0.0]))
    >>> branch = jf.continue_orbit(belt, "omega", orbit, stop=10.0)
    >>> ax = jf.plot.branch(branch, jf.plot.page().add_subplot())
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['stable', 'contacts']
    """
    check.instance("branch", branch, Branch)
    check.component("component", component, branch.orbits.x0.shape[-1])
    ax = own_axes(ax)
    if extremes:
        curves = [column[:, component] for column in branch.extremes()]
        wording = "least and largest {}"
    else:
        curves, wording = [np.asarray(branch.orbits.x0)[:, component]], "{} at t0"
    # A line for each style, NaN where the other one is drawn: matplotlib breaks lines there.
    for curve in curves:
        values, heights, stable = _pieces(branch, curve)
        for solid, style in ((True, "-"), (False, "--")):
            keep = np.append(stable == solid, False)
            if not keep.any():
                continue
            keep[1:] |= keep[:-1]
            ax.plot(
                values,
                np.where(keep, heights, np.nan),
                style,
                color=BLACK if solid else VERMILLION,
                linewidth=1.2,
                label=("stable" if solid else "unstable") if curve is curves[0] else None,
            )
        for kind in dict.fromkeys(point.kind for point in branch.points):
            marker, color = POINTS[kind]
            shown = [point for point in branch.points if point.kind == kind]
            ax.plot(
                [point.value for point in shown],
                [_height(branch.values, curve, point) for point in shown],
                marker,
                color=color,
                markeredgecolor=BLACK,
                label=kind if curve is curves[0] else None,
            )
    ax.legend(fontsize="small")
    labels = labels_of(branch.orbits.system, branch.orbits.x0.shape[-1])
    ax.set_xlabel(labels.parameter(branch.parameter))
    ax.set_ylabel(labels.component(component, wording))
    return ax


@draws(BifurcationCurve)
def bifurcation_curve(curve: BifurcationCurve, ax: Axes | None = None) -> Axes:
    """Draw a curve of bifurcations in the plane of two parameters, each kind in its colour.

    Points of codimension two, where the kind changes, are marked.

    **Arguments**

    - `curve`: a `BifurcationCurve`.
    - `ax`: the axes to draw on; by default those of a figure of their own.

    **Returns** the matplotlib axes.

    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> system = jf.systems.SDOscillator(omega=0.84)
    >>> orbit = jf.periodic_orbit(system, jnp.array([1.9, 0.0]))
    >>> graze = jf.find_bifurcation(system, "omega", orbit, "grazing")
    >>> curve = jf.continue_bifurcation(system, ("omega", "f0"), graze, stop=(0.84, 0.9))
    >>> ax = jf.plot.bifurcation_curve(curve, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('Ω', 'f0')
    """
    check.instance("curve", curve, BifurcationCurve)
    ax = own_axes(ax)
    kinds = np.array(curve.kinds)
    for kind in dict.fromkeys(curve.kinds):
        keep = kinds == kind
        keep[:-1] |= keep[1:]
        values = np.where(keep[:, None], curve.values, np.nan)
        ax.plot(*values.T, color=CURVES.get(kind, BLACK), linewidth=1.5, label=kind)
    for point in curve.points:
        ax.plot(*point.values, "o", color=BLACK, label=f"{point.before} to {point.after}")
    ax.legend(fontsize="small")
    ax.set_xlabel(curve.labels.parameter(curve.parameters[0]))
    ax.set_ylabel(curve.labels.parameter(curve.parameters[1]))
    return ax


def _pieces(branch: Branch, curve: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The corners of a curve along a branch, values and heights, its special points among them,
    and whether each piece between two of them is stable: up to the first special point as the
    orbit before it, then as the one after it."""
    values, heights, stable = [branch.values[0]], [curve[0]], []
    for i in range(1, len(branch.values)):
        between = [point for point in branch.points if point.index == i]
        for k, point in enumerate(between):
            values.append(point.value)
            heights.append(_height(branch.values, curve, point))
            stable.append(branch.stable[i if k else i - 1])
        values.append(branch.values[i])
        heights.append(curve[i])
        stable.append(branch.stable[i])
    return np.array(values), np.array(heights), np.array(stable, bool)


def _height(values: np.ndarray, curve: np.ndarray, point: SpecialPoint) -> float:
    """Of a curve at a special point, which lies between the orbits index − 1 and index."""
    pair = slice(max(point.index - 1, 0), point.index + 1)
    # `interp` needs ascending values, and a branch may go either way.
    order = np.argsort(values[pair])
    return float(np.interp(point.value, values[pair][order], curve[pair][order]))
