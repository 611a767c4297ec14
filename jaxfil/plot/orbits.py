"""Branches of periodic orbits with their special points, and curves of bifurcations."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxfil.bifurcations.two_parameter import BifurcationCurve
from jaxfil.equilibria.equilibrium_branch import EquilibriumBranch
from jaxfil.equilibria.two_parameter import EquilibriumCurve
from jaxfil.model import check
from jaxfil.model.drawing import draws
from jaxfil.model.labels import labels_of
from jaxfil.orbits.branch import Branch
from jaxfil.plot.canvas import BLACK, VERMILLION, own_axes, styled
from jaxfil.plot.kinds import KINDS
from jaxfil.plot.legend import legend


@draws(Branch)
def branch(
    branch: Branch,
    ax: Axes | None = None,
    component: int = 0,
    extremes: bool = False,
    **style: Any,
) -> Axes:
    """Draw a branch of orbits against its parameter, unstable parts dashed, special points marked.

    **Arguments**

    - `branch`: a `Branch`.
    - `ax`: the axes to draw on; by default new ones.
    - `component`: the component of the state to draw, from 0.
    - `extremes`: draw its smallest and largest value on the orbit instead of its value at t0.
    - `style`: matplotlib's keywords of the lines, as `color` or `lw`.

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
    ax = own_axes(ax)
    curves, wording = curves_of(branch, component, extremes)
    for curve in curves:
        draw_stability(ax, branch, curve, style)
        for point in branch.points:
            marker, color = KINDS[point.kind]
            at = point.value, height(branch, curve, point.value, point.index)
            ax.plot(*at, marker, color=color, markeredgecolor=BLACK, label=point.kind)
    labels = labels_of(branch.orbits.system, branch.orbits.x0.shape[-1])
    ax.set_xlabel(labels.parameter(branch.parameter))
    ax.set_ylabel(labels.component(component, wording))
    legend(ax)
    return ax


def curves_of(branch: Branch, component: int, extremes: bool) -> tuple[list[np.ndarray], str]:
    """One curve or two to draw above the parameter, and their label."""
    check.component("component", component, branch.orbits.x0.shape[-1])
    if extremes:
        return [column[:, component] for column in branch.extremes()], "least and largest {}"
    return [np.asarray(branch.orbits.x0)[:, component]], "{} at t0"


def draw_stability(
    ax: Axes, branch: Branch | EquilibriumBranch, curve: np.ndarray, style: dict[str, Any]
) -> None:
    """One curve along a branch, unstable parts dashed."""
    # A line for each style, NaN where the other applies; matplotlib breaks lines at NaN.
    values, heights, stable = _pieces(branch, curve)
    for solid, dash in ((True, "-"), (False, "--")):
        keep = np.append(stable == solid, False)
        if not keep.any():
            continue
        keep[1:] |= keep[:-1]
        label = "stable" if solid else "unstable"
        color = BLACK if solid else VERMILLION
        told = styled(style, color=color, linewidth=1.2, label=label)
        told["linestyle"] = dash
        ax.plot(values, np.where(keep, heights, np.nan), **told)


@draws(BifurcationCurve, EquilibriumCurve)
def bifurcation_curve(
    curve: BifurcationCurve | EquilibriumCurve, ax: Axes | None = None, **style: Any
) -> Axes:
    """Draw a curve of bifurcations in the plane of two parameters, each kind in its colour.

    Points of codimension two are marked.

    **Arguments**

    - `curve`: a `BifurcationCurve`, or an `EquilibriumCurve`.
    - `ax`: the axes to draw on; by default new ones.
    - `style`: matplotlib's keywords of the lines, as `color` or `lw`.

    **Returns** the matplotlib axes.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import jaxfil as jf
    >>> jax.config.update("jax_enable_x64", True)
    >>> system = jf.systems.SDOscillator(omega=0.84)
    >>> orbit = jf.periodic_orbit(system, jnp.array([1.9, 0.0]))
    >>> graze = jf.find_bifurcation(system, "omega", orbit, "grazing")
    >>> curve = jf.continue_bifurcation(system, ("omega", "f0"), graze, stop=(0.84, 0.9))
    >>> ax = jf.plot.bifurcation_curve(curve, jf.plot.page().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('Ω', 'f₀')
    """
    check.instance("curve", curve, BifurcationCurve, EquilibriumCurve)
    ax = own_axes(ax)
    kinds = np.array(curve.kinds)
    for kind in dict.fromkeys(curve.kinds):
        keep = kinds == kind
        keep[:-1] |= keep[1:]
        values = np.where(keep[:, None], curve.values, np.nan)
        color = KINDS.get(kind, ("", BLACK))[1]
        ax.plot(*values.T, **styled(style, color=color, linewidth=1.5, label=kind))
    for point in curve.points if isinstance(curve, BifurcationCurve) else ():
        ax.plot(*point.values, "o", color=BLACK, label=point.kind)
    ax.set_xlabel(curve.labels.parameter(curve.parameters[0]))
    ax.set_ylabel(curve.labels.parameter(curve.parameters[1]))
    legend(ax)
    return ax


def _pieces(
    branch: Branch | EquilibriumBranch, curve: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The corners of a curve along a branch, values and heights, its special points among them,
    and whether each piece between two of them is stable: up to the first special point as the
    orbit before it, then as the one after it."""
    values, heights, stable = [branch.values[0]], [curve[0]], []
    for i in range(1, len(branch.values)):
        between = [point for point in branch.points if point.index == i]
        for k, point in enumerate(between):
            values.append(point.value)
            heights.append(height(branch, curve, point.value, point.index))
            stable.append(branch.stable[i if k else i - 1])
        values.append(branch.values[i])
        heights.append(curve[i])
        stable.append(branch.stable[i])
    return np.array(values), np.array(heights), np.array(stable, bool)


def height(
    branch: Branch | EquilibriumBranch, curve: np.ndarray, value: float, index: int
) -> float:
    """The height of a curve at a value of the parameter between the orbits index − 1 and index."""
    pair = slice(max(index - 1, 0), index + 1)
    # `interp` needs ascending values, and a branch may go either way.
    values = np.asarray(branch.values)[pair]
    order = np.argsort(values)
    return float(np.interp(value, values[order], curve[pair][order]))
